"""What a policy's folder says of its training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.hub.cards import code
from cronos_lerobot.report.runs import TrainingRun, read_training_run
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.run_folder import MANIFEST, METRICS

SHOWN = ("env.", "protocol.", "algorithm.", "num_envs", "steps", "seed")
"""Flags that a card shows, by their beginning."""


@dataclass(frozen=True)
class Checkpoint:
    """A policy on disk."""

    model: Path
    """LeRobot's folder: config.json, model.safetensors, processors."""
    run: TrainingRun | None
    """What `cronos-train` logged up to this checkpoint; None without its run folder."""


def find_checkpoint(path: Path) -> Checkpoint:
    """The policy in a run folder (its last checkpoint), in a checkpoint, or in a model's folder.

    Raises:
        FileNotFoundError: there is no policy.
        ValueError: a link leads out of `path`, or its run is damaged or no longer has this checkpoint's step.
    """
    last = path / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
    for model in (last, path / PRETRAINED_MODEL_DIR, path):
        if (model / "config.json").is_file() and any(model.glob("*.safetensors")):
            break
    else:
        raise FileNotFoundError(
            f"--path={path} holds no policy: give a run folder, a checkpoint, or a folder with config.json and "
            "model.safetensors"
        )
    model = model.resolve()
    if not model.is_relative_to(path.resolve()):
        raise ValueError(f"a link in --path={path} leads out of it, to {model}: give that folder")
    checkpoint, folder = model.parent, model.parent.parent.parent
    if not (checkpoint.name.isdigit() and (folder / METRICS).is_file() and (folder / MANIFEST).is_file()):
        return Checkpoint(model, None)
    return Checkpoint(model, _read_until(folder, int(checkpoint.name)))


def _read_until(folder: Path, step: int) -> TrainingRun:
    """A run as it was at an interaction step."""
    run = read_training_run(folder)
    reached = {one.get("interaction_steps") for one in (*run.updates, *run.ends, *run.starts)}
    for records in (run.evaluations, run.updates, run.ends):
        records[:] = [record for record in records if record["interaction_steps"] <= step]
    run.starts[1:] = [start for start in run.starts[1:] if (start.get("interaction_steps") or 0) < step]
    if step not in reached or not [*run.updates, *run.ends]:
        raise ValueError(
            f"{folder / METRICS} has nothing at step {step}: the run resumed from an earlier checkpoint, and "
            "this one is not part of it"
        )
    return run


def changed_flags(flags: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Flags of `cronos-train` that differ from their defaults, as rows of a table.

    Args:
        flags: by name, such as `protocol.scene_reset_interval`; see `flatten`.
    """
    defaults = _defaults(flags.get("algorithm.type"))
    return [
        (code(f"--{name}"), code(value if isinstance(value, str) else json.dumps(value)))
        for name, value in flags.items()
        if name.startswith(SHOWN) and not name.startswith("env.features") and value != defaults.get(name)
    ]


def _defaults(algorithm: Any) -> dict[str, Any]:
    known = RLAlgorithmConfig.get_known_choices()
    choice = {"algorithm": known[algorithm]()} if isinstance(algorithm, str) and algorithm in known else {}
    config = draccus.encode(CronosTrainConfig(env=CronosEnvConfig(), **choice))
    return flatten(json.loads(json.dumps(config)))


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values of a config by their names on the command line."""
    flags: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, dict) and value:
            flags |= flatten(value, f"{prefix}{name}.")
        else:
            flags[f"{prefix}{name}"] = value
    return flags


def is_repository(name: Any) -> bool:
    """Whether a name can be a repository on the Hub: `<owner>/<name>`, and no folder here."""
    text = str(name or "")
    return text.count("/") == 1 and not text.startswith((".", "/", "~")) and not Path(text).exists()
