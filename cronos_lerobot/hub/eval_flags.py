"""Flags with which a reader of a policy's card evaluates it: the environment that shows it what it takes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.scenes import SCENES
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS

from cronos_lerobot.evaluation.policy_env import task_observation_of, trained_observations
from cronos_lerobot.hub.cards import is_packaged

DEFAULTS = {field.name: field.default for field in fields(CronosEnvConfig)}


def environment_flags(
    policy: Mapping[str, Any], trained: Mapping[str, Any], scene: str | None, model: Path | None = None
) -> list[str]:
    """The flags, the same for `lerobot-eval` and `cronos-eval`.

    Args:
        policy: its config.json.
        trained: its train_config.json; empty if there is none.
        scene: of the training, if it is known.
        model: its folder, which tells the renderer of the pictures that it learned from.
    """
    rename_map = dict(trained.get("rename_map") or {})
    features = _features(policy, rename_map)
    wanted = ({"scene": scene} if scene else {}) | trained_observations(features, model)
    wanted["task_observation"] = _task_observation(features, trained.get("env") or {}, scene)
    always = ("scene", "obs_type")
    shown = [_flag(name, value) for name, value in wanted.items() if name in always or value != DEFAULTS[name]]
    module = [] if scene is None or is_packaged(scene) else ["--env.discover_packages_path=<module of the scene>"]
    renamed = [f"--rename_map={json.dumps(rename_map)}"] if rename_map else []
    return [*module, "--env.type=cronos", *shown, *renamed]


def _flag(name: str, value: Any) -> str:
    return f"--env.{name}={str(value).lower() if isinstance(value, bool) else value}"


def _task_observation(features: Mapping[str, PolicyFeature], env: Mapping[str, Any], scene: str | None) -> str:
    """How the policy is told its task: as in training, or else as the size of its state says."""
    if env:
        return env.get("task_observation") or TASK_OBSERVATIONS[0]
    scenes = [scene] if scene in SCENES else SCENES
    told = {task_observation_of(features, CronosEnvConfig(scene=name)) for name in scenes}
    return max(told, key=TASK_OBSERVATIONS.index)


def _features(policy: Mapping[str, Any], rename_map: Mapping[str, str]) -> dict[str, PolicyFeature]:
    """Its `input_features`, by the environment's names. A plugin's config class may not be installed here."""
    shown_as = {renamed: name for name, renamed in rename_map.items()}
    return {
        shown_as.get(name, name): PolicyFeature(FeatureType(feature["type"]), tuple(feature["shape"]))
        for name, feature in (policy.get("input_features") or {}).items()
    }
