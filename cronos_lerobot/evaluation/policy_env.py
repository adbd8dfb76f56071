"""The environment that a policy expects: what it observes, and where it was trained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES
from lerobot_env_cronos.scene.model import CAMERAS
from lerobot_env_cronos.scene.scenes import SCENES


def observations_of(policy: PreTrainedConfig) -> dict[str, Any]:
    """Fields of `CronosEnvConfig` that show a policy what it takes."""
    images = policy.image_features
    takes_state = OBS_ENV_STATE in (policy.input_features or {})
    if not images:
        return {"obs_type": "environment_state_agent_pos"} if takes_state else {}
    derived: dict[str, Any] = {"obs_type": "pixels_agent_pos", "privileged_state": takes_state}
    cameras = [name for name in CAMERAS if f"{OBS_IMAGES}.{name}" in images]
    if cameras:
        derived["camera_name"] = ",".join(cameras)
    # LeRobot passes images of another size on without a word.
    _, height, width = next(iter(images.values())).shape
    return derived | {"observation_height": height, "observation_width": width}


def trained_scene(path: Path | None) -> dict[str, str]:
    """The scene that a checkpoint of `cronos-train` was trained in."""
    file = Path(path or "") / TRAIN_CONFIG_NAME
    if not file.is_file():
        return {}
    scene = (json.loads(file.read_text()).get("env") or {}).get("scene")
    return {"scene": scene} if scene in SCENES else {}
