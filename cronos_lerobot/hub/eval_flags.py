"""Flags with which a reader of a policy's card evaluates it: the environment that shows it what it takes."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.scenes import SCENES
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS

from cronos_lerobot.evaluation.policy_env import observations_of, task_observation_of
from cronos_lerobot.hub.cards import is_packaged

DEFAULTS = {field.name: field.default for field in fields(CronosEnvConfig)}


def lerobot_eval_flags(
    policy: dict[str, Any],
    env: dict[str, Any],
    scene: str | None,
    renderer: str | None = None,
    rename_map: Mapping[str, str] | None = None,
) -> list[str]:
    """For `lerobot-eval`, which knows nothing of the training.

    Args:
        policy: its config.json.
        env: what it was trained in, of its train_config.json; empty if no environment was.
        scene: of the training, if it is known.
        renderer: of the pictures that it learned from, if it is known.
        rename_map: what its training renamed of what the data show, of its train_config.json.
    """
    features = _features(policy, rename_map)
    wanted = _observations(features, env) | {"task_observation": _task_observation(features, env, scene)}
    wanted |= {"renderer": renderer} if renderer and "observation_height" in wanted else {}
    changed = {name: value for name, value in wanted.items() if value != DEFAULTS[name]}
    shown = ({"scene": scene} if scene else {}) | {"obs_type": wanted["obs_type"]} | changed
    flags = ["--env.type=cronos", *(_flag(name, value) for name, value in shown.items())]
    return [*_module_flags(scene), *flags, *_rename_flags(rename_map)]


def _rename_flags(rename_map: Mapping[str, str] | None) -> list[str]:
    return [f"--rename_map={shlex.quote(json.dumps(dict(rename_map)))}"] if rename_map else []


def _module_flags(scene: str | None) -> list[str]:
    """What a scene that does not come with the package takes."""
    return [] if scene is None or is_packaged(scene) else ["--env.discover_packages_path=<module of the scene>"]


def cronos_eval_flags(
    policy: dict[str, Any], env: dict[str, Any], scene: str | None, rename_map: Mapping[str, str] | None = None
) -> list[str]:
    """For `cronos-eval`, which takes the rest from the checkpoint; none if that is all."""
    features = _features(policy, rename_map)
    told = _task_observation(features, env, scene)
    shown = {"scene": scene} if scene and not env.get("scene") else {}
    if rename_map:
        # What the policy takes has names of its own, which say nothing of cameras.
        wanted = _observations(features, env)
        shown |= {name: value for name, value in wanted.items() if value != DEFAULTS[name]}
    shown |= {"task_observation": told} if told != DEFAULTS["task_observation"] else {}
    flags = ["--env.type=cronos", *(_flag(name, value) for name, value in shown.items())] if shown else []
    return [*_module_flags(scene), *flags, *_rename_flags(rename_map)]


def _flag(name: str, value: Any) -> str:
    return f"--env.{name}={str(value).lower() if isinstance(value, bool) else value}"


def _observations(features: Mapping[str, PolicyFeature], env: dict[str, Any]) -> dict[str, Any]:
    """Fields of the environment that show what the policy takes; a critic may have seen more in training."""
    recorded = {name: env[name] for name in ("obs_type", "camera_name") if env.get(name)}
    return {"obs_type": "environment_state_agent_pos"} | recorded | observations_of(features)


def _task_observation(features: Mapping[str, PolicyFeature], env: dict[str, Any], scene: str | None) -> str:
    """How the policy is told its task: as in training, or else as the size of its state says."""
    if env:
        return env.get("task_observation") or TASK_OBSERVATIONS[0]
    scenes = [scene] if scene in SCENES else SCENES
    told = {task_observation_of(features, CronosEnvConfig(scene=name)) for name in scenes}
    return max(told, key=TASK_OBSERVATIONS.index)


def _features(policy: dict[str, Any], rename_map: Mapping[str, str] | None = None) -> dict[str, PolicyFeature]:
    """Its `input_features`, by the environment's names of them.

    Without the configuration's class: a plugin's policy may not be installed here.
    """
    features = policy.get("input_features") or {}
    shown_as = {renamed: name for name, renamed in (rename_map or {}).items()}
    return {
        shown_as.get(name, name): PolicyFeature(FeatureType(feature["type"]), tuple(feature["shape"]))
        for name, feature in features.items()
    }
