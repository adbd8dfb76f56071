"""A recorded stream whose progress and weights are worked out by hand, with every kind of boundary."""

import numpy as np
from synthetic_segments import FPS, STATE_DIM, images, observation_space, world
from synthetic_streams import ORIGIN, make_step

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.protocol.interventions import Intervention

K = 6
GAMMA = 0.5
CHUNK = 2

# What it began after; the reward level before each action and after the last one.
SEGMENTS = [
    (Intervention.INITIAL, [0, 0, 0.1, 0.1, 1, 1, 1]),
    (Intervention.TASK_SWITCH, [0, 0, 0.1, 0.1, 0, 0, 0]),  # lost what it had grasped
    (Intervention.END_EFFECTOR_RESET, [1, 1, 1, 1, 1, 1, 1]),  # found complete
    (Intervention.SCENE_RESET, [0, 0.1, 0.1, 0.1]),  # diverged in its third step
    (Intervention.DIVERGENCE, [0, 0, 0.1, 1]),  # complete with its last action
    (Intervention.TASK_SWITCH, [0.1, 0, 0]),  # began with a grasp; the recording stops in it
]
# gamma^n at n actions before the success, 0.1 gamma^n before a grasp alone; the last row is after the last action.
PROGRESS = [
    [0.0625, 0.125, 0.25, 0.5, 1, 1],
    [0.025, 0.05, 0.1, 0.1, 0, 0],
    [1, 1, 1, 1, 1, 1],
    [0.05, 0.1, 0.1],
    [0.125, 0.25, 1],
    [0.1, 0],
]
# Two frames on, or the last one, less the frame itself.
DIFFERENCES = [
    [0.1875, 0.375, 0.75, 0.5, 0, 0],
    [0.075, 0.05, -0.1, -0.1, 0, 0],
    [0, 0, 0, 0, 0, 0],
    [0.05, 0, 0],
    [0.875, 0.75, 0],
    [-0.1, 0],
]
# Their mean is 3.3125 / 26 = 0.12740, their mean square 2.35703 / 26, so sigma = 0.27281: a difference of 0 weighs
# (0 - (0.12740 - 2 * 0.27281)) / (4 * 0.27281).
SOFT = 0.38325
WEIGHTS = [
    [1, 1, 1, 1, SOFT, SOFT],
    [1, 1, 0, 0, SOFT, SOFT],
    [SOFT] * 6,
    [1, SOFT, SOFT],
    [1, 1, SOFT],
    [0, SOFT],
]


def rewards_of(levels: list[float], reward: str) -> np.ndarray:
    return np.diff(levels) if reward == "difference" else np.array(levels[1:], float)


def record_weighted(
    root,
    *,
    reward="difference",
    origin=ORIGIN,
    describes=("log_prob", "value"),
) -> None:
    """Record one stream with pictures; `describes` is what the agent knows."""
    features = stream_features(world(observation_space(environment_state=None)), describes=describes)
    writer = SegmentWriter("me/stream", root, features, FPS, origin=origin)
    recorder = StreamRecorder(writer, num_envs=1, segment_length=K)
    pictures = images(sum(len(levels) - 1 for _, levels in SEGMENTS))
    t = switches = resets = 0
    for piece, (intervention, levels) in enumerate(SEGMENTS):
        starts_anew = intervention in (Intervention.INITIAL, Intervention.SCENE_RESET, Intervention.DIVERGENCE)
        switches = 0 if starts_anew else switches + 1
        resets += intervention in (Intervention.SCENE_RESET, Intervention.DIVERGENCE)
        for k, paid in enumerate(rewards_of(levels, reward)):
            is_last = k == len(levels) - 2
            step = make_step(
                t,
                observation={
                    "pixels": {"front": pictures[t : t + 1]},
                    "agent_pos": np.full((1, STATE_DIM), t, np.float32),
                },
                actions=np.full((1, 7), t / 10, np.float32),
                log_prob=np.zeros(1),
                value=np.array([float(t)]),
                reward=np.array([paid]),
                success=np.array([levels[k + 1] == 1]),
                preceded_by=np.array([Intervention.NONE if k else intervention]),
                interventions=np.array([resets]),
                piece=np.array([piece]),
                segments_since_reset=np.array([switches]),
                cut=np.array([is_last and piece < len(SEGMENTS) - 1]),
            )
            recorder.on_step(step)
            t += 1
    recorder.close()
