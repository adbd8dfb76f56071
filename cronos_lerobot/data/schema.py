"""The LeRobotDataset (v3) features of demonstrations and of recorded training streams.

A frame is LeRobot's usual (observation, action, what followed): `observation.*` is what the policy saw,
`action` what it chose, and `next.*` what came of that action. One LeRobot episode is one *segment* of a
stream: contiguous in time, under one instruction, crossing no teleport of any body or of the arm. The
`cronos.*` columns make the stream whole again. They start with neither `observation` nor `action`, so
LeRobot never takes them for an input or an output of a policy.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_IMAGES, REWARD
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS, agent_pos_names, environment_state_names
from lerobot_env_cronos.simulation.simulation import ACTION_NAMES

from cronos_lerobot.agents.processing import VECTOR_KEYS
from cronos_lerobot.data.video import check_video_size

SUCCESS = "next.success"
TRUNCATED = "next.truncated"
STREAM_ID = "cronos.stream_id"
STEP = "cronos.step"
SEGMENT_INDEX = "cronos.segment_index"
POSITION = "cronos.position"
INTERVENTION = "cronos.intervention"
STREAM_INTERVENTIONS = "cronos.stream_interventions"
TOTAL_INTERVENTIONS = "cronos.total_interventions"
POLICY_VERSION = "cronos.policy_version"
LOG_PROB = "cronos.log_prob"
VALUE = "cronos.value"
EXPERT = "intervention"
"""Whether an expert chose the action (a takeover), as LeRobot's DAgger recordings call it. Streams recorded
before there were takeovers lack it."""
SUCCESS_FRAME = "cronos.success_frame"
"""Of an episode's row in `meta/episodes`: the first frame after which the task was complete, -1 if none."""

Features = dict[str, dict[str, Any]]


_STREAM_COLUMNS: dict[str, str] = {
    STREAM_ID: "int64",
    STEP: "int64",
    SEGMENT_INDEX: "int64",
    POSITION: "int64",
    INTERVENTION: "int8",
    STREAM_INTERVENTIONS: "int64",
    TOTAL_INTERVENTIONS: "int64",
    POLICY_VERSION: "int64",
    LOG_PROB: "float32",
    VALUE: "float32",
}
STREAM_COLUMNS = tuple(_STREAM_COLUMNS)


def demonstration_features(
    observation_space: gymnasium.Space,
    *,
    video: bool = True,
    state_names: Sequence[str] | None = None,
    environment_state_names: Sequence[str] | None = None,
) -> Features:
    """Features of a demonstration dataset.

    Args:
        observation_space: of ONE environment, in the raw format of `lerobot.envs`: a Dict with any of
            "pixels" (a Dict of uint8 (H, W, 3) boxes by camera), "agent_pos", "environment_state".
        video: store the pixels as mp4 (small); if False as PNG in the data files (exact, fast to read).
        state_names: one name per dimension of `agent_pos`; numbered when None.
        environment_state_names: the same for `environment_state`.

    Returns:
        LeRobot's feature dictionary: the observation, `action`, `next.reward`, `next.success`, `next.done`,
        `next.truncated`.

    Raises:
        ValueError: the space is not such a Dict, or a list of names has the wrong length.
    """
    if not isinstance(observation_space, gymnasium.spaces.Dict):
        raise ValueError(f"the observation space must be a gymnasium Dict, got {observation_space}")
    features: Features = {}
    names = {"agent_pos": state_names, "environment_state": environment_state_names}
    for key, space in observation_space.items():
        if key == "pixels":
            cameras = cast(gymnasium.spaces.Dict, space)
            for camera, box in cameras.items():
                features[f"{OBS_IMAGES}.{camera}"] = _camera_feature(box.shape or (), video)
        elif key in VECTOR_KEYS:
            features[VECTOR_KEYS[key]] = _vector_feature(key, space.shape or (), names[key])
        else:
            raise ValueError(f"unknown observation {key!r}; valid: 'pixels', {sorted(VECTOR_KEYS)}")
    features[ACTION] = _vector_feature(ACTION, (len(ACTION_NAMES),), ACTION_NAMES)
    features[REWARD] = _scalar_feature("float32")
    features[SUCCESS] = _scalar_feature("bool")
    features[DONE] = _scalar_feature("bool")
    features[TRUNCATED] = _scalar_feature("bool")
    return features


def stream_features(
    observation_space: gymnasium.Space,
    *,
    state_names: Sequence[str] | None = None,
    environment_state_names: Sequence[str] | None = None,
) -> Features:
    """Features of a recorded training stream: those of `demonstration_features`, `STREAM_COLUMNS` and EXPERT.

    No frame is `next.done`: a stream never ends. The last frame of a finished segment is `next.truncated`; the
    observation that followed it is not recorded.

    - `cronos.stream_id`: which of the parallel streams.
    - `cronos.step`: control steps of this stream before this one, from 0, without a gap.
    - `cronos.segment_index`: pieces of this stream before this one; a task switch or a divergence ends one.
    - `cronos.position`: task switches since the stream's last scene reset.
    - `cronos.intervention`: an `Intervention`, what happened between the frame before and this one.
    - `cronos.stream_interventions`, `cronos.total_interventions`: interventions that count (scene and
      heuristic resets, takeovers at their price) so far, those right before this frame included, of this stream
      and of all together.
    - `cronos.policy_version`: policy updates before this action.
    - `cronos.log_prob`: log-probability of the action under the policy that chose it, summed over the
      action's dimensions [nats]; 0 where an expert did.
    - `cronos.value`: that policy's value of the observation.
    - `intervention`: an expert chose the action.
    """
    columns = {key: _scalar_feature(dtype) for key, dtype in _STREAM_COLUMNS.items()}
    observation_and_action = demonstration_features(
        observation_space, state_names=state_names, environment_state_names=environment_state_names
    )
    return observation_and_action | columns | {EXPERT: _scalar_feature("bool")}


def with_cameras(space: gymnasium.Space, cameras: Mapping[str, tuple[int, int]]) -> gymnasium.spaces.Dict:
    """An observation space with other pictures: uint8 (height, width, 3) by camera, in place of its own."""
    if not isinstance(space, gymnasium.spaces.Dict):
        raise ValueError(f"the observation space must be a gymnasium Dict, got {space}")
    spaces = {key: part for key, part in space.items() if key != "pixels"}
    boxes: dict[str, gymnasium.Space] = {
        name: gymnasium.spaces.Box(0, 255, (*size, 3), np.uint8) for name, size in cameras.items()
    }
    return gymnasium.spaces.Dict(spaces | {"pixels": gymnasium.spaces.Dict(boxes)})


def feature_names(env: CronosVectorEnv) -> dict[str, Sequence[str]]:
    """The names of `env`'s state dimensions, as keyword arguments of `demonstration_features`."""
    space = cast(gymnasium.spaces.Dict, env.single_observation_space)
    size = (space["agent_pos"].shape or (0,))[0]
    names = (agent_pos_names(env.scene, option) for option in TASK_OBSERVATIONS)
    return {
        "state_names": next(n for n in names if len(n) == size),
        "environment_state_names": environment_state_names(env.scene),
    }


def frame_format(feature: Mapping[str, Any]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and dtype of one frame of a feature as the writer takes it: pixels are uint8 (H, W, 3)."""
    shape = () if feature["shape"] == (1,) else tuple(feature["shape"])
    return shape, np.dtype(np.uint8 if feature["dtype"] in ("image", "video") else feature["dtype"])


def _camera_feature(shape: tuple[int, ...], video: bool) -> dict[str, Any]:
    if len(shape) != 3 or shape[2] != 3:
        raise ValueError(f"pixels must have the shape (H, W, 3), got {shape}")
    if video:
        check_video_size("the pixels", shape[:2])
    return {
        "dtype": "video" if video else "image",
        "shape": tuple(shape),
        "names": ["height", "width", "channels"],
    }


def _vector_feature(key: str, shape: tuple[int, ...], names: Sequence[str] | None) -> dict[str, Any]:
    if len(shape) != 1:
        raise ValueError(f"{key} must be a vector, got the shape {shape}")
    names = [f"{key}_{i}" for i in range(shape[0])] if names is None else list(names)
    if len(names) != shape[0]:
        raise ValueError(f"{key} has {shape[0]} dimensions but {len(names)} names: {names}")
    return {"dtype": "float32", "shape": tuple(shape), "names": names}


def _scalar_feature(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "shape": (1,), "names": None}
