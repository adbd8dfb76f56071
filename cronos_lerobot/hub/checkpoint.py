"""A policy on disk: where it is, what its run logged, and how it is evaluated."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.scenes import SCENES
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS

from cronos_lerobot.evaluation.policy_env import task_observation_of, trained_observations
from cronos_lerobot.hub.cards import is_packaged
from cronos_lerobot.report.runs import TrainingRun, read_training_run
from cronos_lerobot.training.run_folder import MANIFEST, METRICS

CRONOS = "cronos"
"""`--env.type` of CRONOS scenes."""
DEFAULTS = {field.name: field.default for field in fields(CronosEnvConfig)}


def find_checkpoint(path: Path) -> tuple[Path, TrainingRun | None]:
    """The policy in a run folder (its last checkpoint), in a checkpoint, or in a model's folder.

    Returns:
        LeRobot's folder with config.json, model.safetensors and processors; and what `cronos-train` logged up to
        this checkpoint, None without its run folder.

    Raises:
        FileNotFoundError: there is no policy.
        ValueError: a link leads out of `path`, or its run is damaged or no longer has this checkpoint's step.
    """
    last = path / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
    places = (last, path / PRETRAINED_MODEL_DIR, path)
    found = [place for place in places if (place / "config.json").is_file() and any(place.glob("*.safetensors"))]
    if not found:
        raise FileNotFoundError(
            f"--path={path} holds no policy: give a run folder, a checkpoint, or a folder with config.json and "
            "model.safetensors"
        )
    model = found[0].resolve()
    if not model.is_relative_to(path.resolve()):
        raise ValueError(f"a link in --path={path} leads out of it, to {model}: give that folder")
    checkpoint, folder = model.parent, model.parent.parent.parent
    is_of_run = checkpoint.name.isdigit() and (folder / METRICS).is_file() and (folder / MANIFEST).is_file()
    return model, _read_until(folder, int(checkpoint.name)) if is_of_run else None


def _read_until(folder: Path, step: int) -> TrainingRun:
    """A run as it was at an interaction step."""
    run = read_training_run(folder)
    reached = {one.get("interaction_steps") for one in (*run.updates, *run.ends, *run.starts)}
    for records in (run.evaluations, run.updates, run.ends):
        records[:] = [record for record in records if record["interaction_steps"] <= step]
    if step not in reached or not [*run.updates, *run.ends]:
        raise ValueError(
            f"{folder / METRICS} has nothing at step {step}: the run resumed from an earlier checkpoint, and "
            "this one is not part of it"
        )
    return run


def is_repository(name: Any) -> bool:
    """Whether a name can be a repository on the Hub: `<owner>/<name>`, and no folder here."""
    text = str(name or "")
    return text.count("/") == 1 and not text.startswith((".", "/", "~")) and not Path(text).exists()


def environment_flags(
    policy: Mapping[str, Any], trained: Mapping[str, Any], scene: str | None, model: Path | None = None
) -> list[str]:
    """Flags with which `cronos-eval`, and in CRONOS scenes `lerobot-eval`, show a policy what it takes.

    Args:
        policy: its config.json. A plugin's config class may not be installed here.
        trained: its train_config.json; empty if there is none.
        scene: of the training, if it is known.
        model: its folder, which tells the renderer of the pictures that it learned from.
    """
    rename_map = dict(trained.get("rename_map") or {})
    renamed = [f"--rename_map={json.dumps(rename_map)}"] if rename_map else []
    if (kind := (trained.get("env") or {}).get("type", CRONOS)) != CRONOS:
        return ["--env.discover_packages_path=<module of the environment>", f"--env.type={kind}", *renamed]
    shown_as = {renamed: name for name, renamed in rename_map.items()}
    features = {
        shown_as.get(name, name): PolicyFeature(FeatureType(feature["type"]), tuple(feature["shape"]))
        for name, feature in (policy.get("input_features") or {}).items()
    }
    wanted = ({"scene": scene} if scene else {}) | trained_observations(features, model)
    wanted["task_observation"] = _task_observation(features, trained.get("env") or {}, scene)
    flags = [] if scene is None or is_packaged(scene) else ["--env.discover_packages_path=<module of the scene>"]
    flags.append("--env.type=cronos")
    for name, value in wanted.items():
        if name in ("scene", "obs_type") or value != DEFAULTS[name]:
            flags.append(f"--env.{name}={str(value).lower() if isinstance(value, bool) else value}")
    return flags + renamed


def _task_observation(features: Mapping[str, PolicyFeature], env: Mapping[str, Any], scene: str | None) -> str:
    """How the policy is told its task: as in training, or else as the size of its state says."""
    if env:
        return env.get("task_observation") or TASK_OBSERVATIONS[0]
    scenes = [scene] if scene in SCENES else SCENES
    told = {task_observation_of(features, CronosEnvConfig(scene=name)) for name in scenes}
    return max(told, key=TASK_OBSERVATIONS.index)
