"""The LeRobotDataset (v3) features of demonstrations and of recorded training streams.

A frame is LeRobot's usual (observation, action, what followed): `observation.*` is what the policy saw, `action`
is what was executed, `next.*` is what followed. One LeRobot episode is one *segment* of a stream: contiguous in
time, under one instruction, without a teleport of any body or of the arm. The `cronos.*` columns put the stream
back together. LeRobot never takes them for inputs or outputs of a policy: they start with neither `observation`
nor `action`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_IMAGES, REWARD

from cronos_lerobot.agents.processing import VECTOR_KEYS
from cronos_lerobot.data.video import check_video_size
from cronos_lerobot.protocol.streams import Streams

FORMAT = 3
"""Of the columns below and of `meta/cronos.json`. Any other number is an error."""

SUCCESS = "next.success"
TRUNCATED = "next.truncated"
STREAM_ID = "cronos.stream_id"
STEP = "cronos.step"
SEGMENT_INDEX = "cronos.segment_index"
SEGMENTS_SINCE_RESET = "cronos.segments_since_reset"
EVENT = "cronos.event"
STREAM_INTERVENTIONS = "cronos.stream_interventions"
TOTAL_INTERVENTIONS = "cronos.total_interventions"
POLICY_VERSION = "cronos.policy_version"
LOG_PROB = "cronos.log_prob"
VALUE = "cronos.value"
INTERVENED = "intervention"
"""LeRobot's own name: a person or a script acted on this frame."""
SUCCESS_FRAME = "cronos.success_frame"
"""Of an episode's row in `meta/episodes`: the first frame after which the task was complete, -1 if none."""
CONFIGURATION = "cronos.configuration"
"""Of a demonstration's row in `meta/episodes`: the training configuration it began in, -1 for a drawn layout."""

Features = dict[str, dict[str, Any]]

STREAM_COLUMNS = {
    STREAM_ID: "int64",
    STEP: "int64",
    SEGMENT_INDEX: "int64",
    SEGMENTS_SINCE_RESET: "int64",
    EVENT: "int8",
    STREAM_INTERVENTIONS: "int64",
    TOTAL_INTERVENTIONS: "int64",
    POLICY_VERSION: "int64",
    INTERVENED: "bool",
}
"""Columns of every recorded stream, with their dtypes."""
DECISION_COLUMNS = (LOG_PROB, VALUE)
"""What the agent says of its actions. A recording lacks what the agent does not know."""
SEGMENT_COLUMNS = (
    STREAM_ID,
    SEGMENT_INDEX,
    SEGMENTS_SINCE_RESET,
    STEP,
    EVENT,
    POLICY_VERSION,
    SUCCESS,
    INTERVENED,
)
"""Columns that an episode's row in `meta/episodes` repeats, beside SUCCESS_FRAME: the value of its first frame;
of SUCCESS and INTERVENED whether any frame has it."""


def demonstration_features(env: Streams, *, video: bool = True) -> Features:
    """Features of a demonstration dataset of `env`.

    Args:
        env: whose spaces and names are read.
        video: store the pixels as mp4 (small); if False as PNG in the data files (exact, fast to read).

    Returns:
        LeRobot's feature dictionary: the observation, `action`, `next.reward`, `next.success`, `next.done`,
        `next.truncated`.

    Raises:
        ValueError: the observation is not in the raw format of `lerobot.envs`, or a list of names has the wrong
            length.
    """
    features: Features = {}
    for key, space in cast(gymnasium.spaces.Dict, env.single_observation_space).items():
        if key == "pixels":
            for camera, box in cast(gymnasium.spaces.Dict, space).items():
                features[f"{OBS_IMAGES}.{camera}"] = _camera_feature(box.shape or (), video)
        elif key in VECTOR_KEYS:
            names = env.state_names if key == "agent_pos" else None
            features[VECTOR_KEYS[key]] = _vector_feature(key, space.shape or (), names)
        else:
            raise ValueError(f"unknown observation {key!r}; valid: 'pixels', {sorted(VECTOR_KEYS)}")
    for name, details in getattr(env, "observation_details", {}).items():
        if name in features:
            features[name] |= details
    features[ACTION] = _vector_feature(ACTION, env.single_action_space.shape or (), env.action_names)
    return features | _scalar_features({REWARD: "float32", SUCCESS: "bool", DONE: "bool", TRUNCATED: "bool"})


def stream_features(
    env: Streams, *, video: bool = True, describes: Sequence[str] = ("log_prob", "value")
) -> Features:
    """Features of a recorded training stream of `env`: those of a demonstration and the annotations.

    No frame is `next.done`: a stream never ends. The last frame of a finished segment is `next.truncated`; the
    observation that followed it is not recorded.

    - `cronos.stream_id`: which of the parallel streams.
    - `cronos.step`: control steps of this stream before this one, from 0, without a gap.
    - `cronos.segment_index`: segments of this stream before this one; a task switch or a divergence ends one.
    - `cronos.segments_since_reset`: task switches since the stream's last scene reset.
    - `cronos.event`: an `Intervention`, what happened between the frame before and this one.
    - `cronos.stream_interventions`, `cronos.total_interventions`: interventions so far that count, those right
      before this frame included, of this stream and of all together.
    - `cronos.policy_version`: policy updates before this action.
    - `cronos.log_prob`: log-probability of the action under the policy that chose it, summed over the action's
      dimensions [nats].
    - `cronos.value`: that policy's value of the observation.
    - `intervention`: a person or a script acted on this frame.

    Args:
        env: as for `demonstration_features`.
        video: as there.
        describes: what the agent says of its actions, some of "log_prob" and "value".
    """
    own = STREAM_COLUMNS | {f"cronos.{name}": "float32" for name in describes}
    return demonstration_features(env, video=video) | _scalar_features(own)


def frame_format(feature: Mapping[str, Any]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and dtype of one frame of a feature as the writer takes it: pixels are uint8 (H, W, 3)."""
    shape = () if tuple(feature["shape"]) == (1,) else tuple(feature["shape"])
    return shape, np.dtype(np.uint8 if feature["dtype"] in ("image", "video") else feature["dtype"])


def _camera_feature(shape: tuple[int, ...], video: bool) -> dict[str, Any]:
    if len(shape) != 3 or shape[2] != 3:
        raise ValueError(f"pixels must have the shape (H, W, 3), got {shape}")
    if video:
        check_video_size("the pixels", shape[:2])
    names = ["height", "width", "channels"]
    return {"dtype": "video" if video else "image", "shape": tuple(shape), "names": names}


def _vector_feature(key: str, shape: tuple[int, ...], names: Sequence[str] | None) -> dict[str, Any]:
    names = [f"{key}_{i}" for i in range(shape[0])] if names is None else list(names)
    if len(shape) != 1 or len(names) != shape[0]:
        raise ValueError(f"{key} has the shape {shape} but {len(names)} names: {names}")
    return {"dtype": "float32", "shape": tuple(shape), "names": names}


def _scalar_features(dtypes: Mapping[str, str]) -> Features:
    return {key: {"dtype": dtype, "shape": (1,), "names": None} for key, dtype in dtypes.items()}
