"""In which ways scores are not of a policy as it is published, seen as it was in training, or of all episodes."""

from __future__ import annotations

import json
from typing import Any

from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.data.origin import MAYBE_FOLDERS
from cronos_lerobot.evaluation.policy_source import UNDECISIVE
from cronos_lerobot.hub.runs import is_repository

FILLED_IN = (
    "device", "input_features", "output_features", "use_peft", "checkpoint", "checkpoint_revision", "lora_rank",
    "lora_alpha", "lora_dropout", "lora_targets", "architecture", "action_statistics",
)  # fmt: skip
"""Fields of a policy's config that loading sets: by the machine, the environment, or what it is built from."""


def changes_of_policy(results: dict[str, Any], policy: dict[str, Any]) -> list[str]:
    """What `--policy.*` of an evaluation changed, such as `n_action_steps 1 in place of 100`.

    Args:
        results: of results.json; one that does not have the flags is taken at its word.
        policy: config.json as it is published. A field that an older one lacks is no change.
    """
    evaluated = (results.get("config") or {}).get("policy") or {}
    ignored = {*UNDECISIVE, *FILLED_IN}
    if results.get("temperature") is not None:
        # That of the evaluation held, which is told.
        ignored.add("temperature")
    return [
        f"{name} {_text(name, value)} in place of {_text(name, policy[name])}"
        for name, value in evaluated.items()
        if name in policy and name not in ignored and value != policy[name]
    ]


def describe_caveats(results: dict[str, Any], policy: dict[str, Any], trained_renderer: str | None) -> list[str]:
    """What a reader of scores on a policy's card would not expect, a sentence for each.

    Args:
        results: of results.json.
        policy: config.json as it is published.
        trained_renderer: of the pictures that the policy learned from, if it is known.
    """
    caveats = []
    if changes := changes_of_policy(results, policy):
        caveats.append(f"Flags changed the policy: {', '.join(changes)}.")
    usual = trained_renderer or CronosEnvConfig.renderer
    renderer = results.get("renderer") or CronosEnvConfig.renderer
    if results.get("obs_type") == "pixels_agent_pos" and {renderer, usual} != {CronosEnvConfig.renderer}:
        other = f", those that it learned from by `{usual}`" if renderer != usual else ""
        caveats.append(f"The renderer `{renderer}` drew the policy's pictures{other}.")
    if part := _describe_part(results):
        caveats.append(f"Evaluated on {part}.")
    if (repetitions := results.get("repetitions", 1)) != 1:
        caveats.append(f"Every configuration of the independent suite was run {repetitions} times.")
    return caveats


def _describe_part(results: dict[str, Any]) -> str:
    """What flags left of the configurations and orderings, in words; empty if none did."""
    config, identity = results.get("config") or {}, results.get("identity") or {}
    flags = config.get("eval") or {}

    def chosen(name: str) -> bool:
        return flags.get(name) is not None or config.get("quick", False)

    parts = []
    if chosen("n_episodes"):
        parts.append(f"the first {identity['n_episodes']} configurations of each split")
    if results.get("sequential") and chosen("orderings"):
        parts.append(f"the first {identity['orderings']} orderings")
    return " and ".join(parts)


def _text(name: str, value: Any) -> str:
    """A value as on the command line; a card is public, and names no folder."""
    if name in MAYBE_FOLDERS and value and not is_repository(str(value).partition("@")[0]):
        return "a folder"
    return value if isinstance(value, str) else json.dumps(value)
