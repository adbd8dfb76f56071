"""Flags with which a reader of a policy's card evaluates it: the environment that shows it what it takes."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.model import CAMERAS
from lerobot_env_cronos.scene.scenes import SCENES
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS, agent_pos_names

DEFAULTS = {field.name: field.default for field in fields(CronosEnvConfig)}


def lerobot_eval_flags(policy: dict[str, Any], env: dict[str, Any], scene: str | None) -> list[str]:
    """For `lerobot-eval`, which knows nothing of the training.

    Args:
        policy: its config.json.
        env: what it was trained in, of its train_config.json; empty if no environment was.
        scene: of the training, if it is known.
    """
    wanted = _observations(policy, env) | {"task_observation": _task_observation(policy, env, scene)}
    changed = {name: value for name, value in wanted.items() if value != DEFAULTS[name]}
    shown = ({"scene": scene} if scene else {}) | {"obs_type": wanted["obs_type"]} | changed
    return ["--env.type=cronos", *(_flag(name, value) for name, value in shown.items())]


def cronos_eval_flags(policy: dict[str, Any], env: dict[str, Any], scene: str | None) -> list[str]:
    """For `cronos-eval`, which takes the rest from the checkpoint; none if that is all."""
    told = _task_observation(policy, env, scene)
    shown = {"scene": scene} if scene and not env.get("scene") else {}
    shown |= {"task_observation": told} if told != DEFAULTS["task_observation"] else {}
    return ["--env.type=cronos", *(_flag(name, value) for name, value in shown.items())] if shown else []


def _flag(name: str, value: Any) -> str:
    return f"--env.{name}={str(value).lower() if isinstance(value, bool) else value}"


def _observations(policy: dict[str, Any], env: dict[str, Any]) -> dict[str, Any]:
    """Fields of the environment that show what the policy takes; a critic may have seen more in training."""
    features = policy.get("input_features") or {}
    images = {name: feature for name, feature in features.items() if feature.get("type") == "VISUAL"}
    if not images:
        fallback = env.get("obs_type") or "environment_state_agent_pos"
        return {"obs_type": "environment_state_agent_pos" if OBS_ENV_STATE in features else fallback}
    _, height, width = next(iter(images.values()))["shape"]
    cameras = [name for name in CAMERAS if f"{OBS_IMAGES}.{name}" in images]
    return {
        "obs_type": "pixels_agent_pos",
        "camera_name": ",".join(cameras) or env.get("camera_name") or DEFAULTS["camera_name"],
        "observation_height": height,
        "observation_width": width,
        "privileged_state": OBS_ENV_STATE in features,
    }


def _task_observation(policy: dict[str, Any], env: dict[str, Any], scene: str | None) -> str:
    """How the policy is told its task: as in training, or else as the size of its state says."""
    if env:
        return env.get("task_observation") or TASK_OBSERVATIONS[0]
    state = (policy.get("input_features") or {}).get(OBS_STATE)
    scenes = [SCENES[scene]] if scene in SCENES else list(SCENES.values())
    for known in TASK_OBSERVATIONS:
        if state and any(list(state["shape"]) == [len(agent_pos_names(each, known))] for each in scenes):
            return known
    return TASK_OBSERVATIONS[0]
