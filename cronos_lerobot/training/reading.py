"""The config of a run from flags and files, and what of it may not change when the run resumes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.utils import flatten_dict

from cronos_lerobot.bases import official_base
from cronos_lerobot.command_line import parse_command_line
from cronos_lerobot.evaluation.policy_source import (
    PINNED,
    follow_last,
    load_policy_config,
    pin_policy,
)
from cronos_lerobot.training.config import AUTO, CronosTrainConfig
from cronos_lerobot.training.run_folder import last_checkpoint

FIXED = (
    "seed", "num_envs", "peft", "rename_map", "env", "policy", "record", "protocol", "algorithm", "eval",
)  # fmt: skip
"""What a resumed run keeps: flags, or groups of them. Every other flag is followed."""
FREE = (
    "env.num_threads", "policy.device", "policy.pretrained_path", "policy.push_to_hub", "policy.repo_id",
    "policy.private", "policy.tags", "policy.license", "record.flush_interval_s", "protocol.reset_budget",
    "eval.batch_size",
)  # fmt: skip
"""Flags of those groups that may change: where a run computes and how much at once, where it is pushed to, and
when it ends."""


def load(path: str | Path, flags: Sequence[str] = ()) -> CronosTrainConfig:
    """Read a saved config: a train_config.json, the folder that it lies in, or a YAML file.

    Args:
        path: of the file or folder.
        flags: `--name=value`, which override it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a flag does not exist.
    """
    file = Path(path) / TRAIN_CONFIG_NAME if Path(path).is_dir() else Path(path)
    return parse_command_line(
        CronosTrainConfig, [*parser.filter_arg("config_path", flags), f"--config_path={file}"]
    )


def read_config(arguments: Sequence[str]) -> CronosTrainConfig:
    """Return the config that flags of `cronos-train` describe; of a resumed run its own, which they override.

    Raises:
        ValueError: a flag does not exist, contradicts another one or the run that is resumed.
        OSError: a file that they name is not there.
    """
    arguments = list(arguments)
    resume = (parser.parse_arg("resume", arguments) or "").lower()
    if resume in ("true", AUTO) and (checkpoint := _find_checkpoint(resume, arguments)):
        return _resumed(checkpoint, arguments)
    file = parser.parse_arg("config_path", arguments)
    if file is None:
        config = parse_command_line(CronosTrainConfig, arguments, {"algorithm": "ppo"})
    else:
        config = load(file, arguments)
        if parser.parse_arg("wandb.run_id", arguments) is None:
            # The new run is logged as one of its own.
            config.wandb.run_id = None
    _load_policy_config(config, arguments)
    return config


def _load_policy_config(config: CronosTrainConfig, arguments: list[str]) -> None:
    """Read the config of the policy that `--policy.path` names, and say whether the run is pushed."""
    overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy", arguments) or [])
    given = {flag.removeprefix("--").split("=")[0] for flag in overrides}
    if path := parser.get_path_arg("policy", arguments):
        path, revision = pin_policy(path, parser.parse_arg(PINNED, overrides))
        config.policy = load_policy_config(path, overrides, revision)
        if "repo_id" not in given:
            # That of the policy's own, which is not to be pushed over.
            config.policy.repo_id = None
    if config.policy is not None and "repo_id" in given and "push_to_hub" not in given:
        config.policy.push_to_hub = True


def _find_checkpoint(resume: str, arguments: list[str]) -> Path | None:
    """The checkpoint that `--resume` means; None begins a run.

    Raises:
        ValueError: the flags do not say where it is, or it is not in the folder of its run.
    """
    output_dir, file = (parser.parse_arg(name, arguments) for name in ("output_dir", "config_path"))
    if resume == "true" and file is not None:
        folder = Path(file) if Path(file).is_dir() else Path(file).parent
        found = folder.absolute().parent
    elif output_dir is None:
        raise ValueError(f"--resume={resume} needs --output_dir=<run>.")
    else:
        found = last_checkpoint(Path(output_dir).absolute())
        if found is None and resume == "true":
            raise ValueError(f"--output_dir={output_dir} has no checkpoint to resume from.")
    if found is not None and found.resolve().parent.parent != found.parent.parent.resolve():
        raise ValueError(f"{found} leads out of its run's folder: give the real path of the checkpoint.")
    return found


def _resumed(checkpoint: Path, arguments: list[str]) -> CronosTrainConfig:
    """The config of a checkpoint's run, with the flags that override it."""
    run_folder = checkpoint.parent.parent
    output_dir = parser.parse_arg("output_dir", arguments)
    if output_dir is not None and Path(output_dir).resolve() != run_folder.resolve():
        raise ValueError(
            f"--output_dir={output_dir}, but the run that is resumed is {run_folder}, and stays there."
        )
    path = parser.parse_arg("policy.path", arguments)
    for flag in ("policy.path", f"policy.{PINNED}"):
        arguments = parser.filter_arg(flag, arguments)
    config = load(checkpoint / PRETRAINED_MODEL_DIR, arguments)
    began_with = None if config.policy is None else config.policy.pretrained_path
    if path is not None and follow_last(Path(official_base(path).partition("@")[0])) != Path(began_with or ""):
        raise ValueError(
            f"--policy.path={path}, but the run that is resumed began with {began_with} and keeps it."
        )
    root, is_given = config.record.root, parser.parse_arg("record.root", arguments) is not None
    if root is not None and not (is_given or root.resolve().is_relative_to(run_folder.resolve())):
        raise ValueError(f"The run records to {root}, out of its folder: give --record.root={root} to allow it.")
    config.output_dir, config.checkpoint_path = run_folder, checkpoint.resolve()
    return config


def check_resumed(config: CronosTrainConfig, saved: dict[str, Any]) -> None:
    """Check that `config` changes nothing that the run of a checkpoint, `saved`, must keep.

    Raises:
        ValueError: a fixed flag has changed, or the run is beyond the end that is asked for.
    """
    given, own = (flatten_dict(tree, sep=".") for tree in (config.to_dict(), saved["config"]))
    # What follows from other flags comes after them.
    for name in sorted(
        given.keys() | own.keys(), key=lambda name: ("features" in name, ".type" not in name, name)
    ):
        if "features" in name and not given.get(name):
            # A config made in Python leaves them to the environment.
            continue
        if _is_in(name, FIXED) and not _is_in(name, FREE) and given.get(name) != own.get(name):
            raise ValueError(
                f"--{name}={given.get(name)}, but the run that is resumed has {own.get(name)} and keeps it: leave "
                "the flag out, or begin a new run with this one's checkpoint as --policy.path."
            )
    if config.total_steps < (done := saved["interaction_steps"]):
        raise ValueError(f"--steps={config.steps}, but the run has done {done} steps: give {done} or more.")


def _is_in(flag: str, names: tuple[str, ...]) -> bool:
    return any(flag == name or flag.startswith(f"{name}.") for name in names)
