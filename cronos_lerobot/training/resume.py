"""What may not change when a run resumes."""

from __future__ import annotations

import json
from typing import Any

from cronos_lerobot.training.run_folder import describe_environment

FIXED = (
    "seed", "num_envs", "peft", "rename_map", "env", "policy", "record.repo_id", "record.root", "record.streams",
    "record.filmed_streams", "protocol.task_switch_interval", "protocol.learned_reset", "protocol.reward",
    "algorithm.type", "algorithm.kl_base_coef", "algorithm.temperature", "algorithm.noise_std",
    "algorithm.noise_level", "algorithm.noise_steps", "algorithm.critic_observation",
)  # fmt: skip
"""What a resumed run keeps: flags, or groups of them. Every other flag is followed."""
FREE = (
    "env.num_threads", "policy.device", "policy.pretrained_path", "policy.push_to_hub", "policy.repo_id",
    "policy.private", "policy.tags", "policy.license",
)  # fmt: skip
"""Flags of those groups that may change: where a run computes, and where it is pushed to."""


def check_resumed(config: Any, saved: dict[str, Any]) -> None:
    """Check that `config` changes nothing that the run must keep.

    Args:
        config: of the resumed run.
        saved: what its checkpoint says of the run.

    Raises:
        ValueError: a fixed flag or the benchmark has changed, or the run is beyond the end that is asked for.
    """
    given, own = flatten(config.to_dict()), flatten(saved["config"])
    # Features follow from other flags, which are named first.
    for name in sorted(given.keys() | own.keys(), key=lambda name: "features" in name):
        if "features" in name and not given.get(name):
            # A config made in Python leaves them to the environment.
            continue
        if _is_fixed(name) and given.get(name) != own.get(name):
            raise ValueError(
                f"--{name}={_text(given.get(name))}, but the run that is resumed has {_text(own.get(name))} and "
                "keeps it: leave the flag out, or begin a new run with this one's checkpoint as --policy.path."
            )
    now, was = describe_environment(config.env)["benchmark"], saved["benchmark"]
    # The source names a release; the fingerprint says what it is.
    if (now and now["fingerprint"]) != (was and was["fingerprint"]):
        raise ValueError(f"the run began with the benchmark {was}, which now is {now}.")
    if config.total_steps < saved["interaction_steps"]:
        done = saved["interaction_steps"]
        raise ValueError(f"--steps={config.steps}, but the run has done {done} steps: give {done} or more.")


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested dicts by their flags' names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _is_fixed(flag: str) -> bool:
    return _is_in(flag, FIXED) and not _is_in(flag, FREE)


def _is_in(flag: str, names: tuple[str, ...]) -> bool:
    return any(flag == name or flag.startswith(f"{name}.") for name in names)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
