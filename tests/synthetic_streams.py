"""Recorded streams of a loop whose every number says which stream and step it belongs to."""

import numpy as np
from synthetic_segments import FPS, STATE_DIM, images, observation_space, world

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.data.origin import STREAMS as STREAMS_KIND
from cronos_lerobot.data.origin import Origin
from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import Step

K = 4
STREAMS = 3
STEPS = 8 * K
RESET = 4 * K
UPDATE = 2 * K
TASKS = ("put the ketchup bottle on the yellow plate", "put the kitchen shovel on the cloth")
PICTURES = images(7)


def intervention(t: int) -> Intervention:
    if t % K:
        return Intervention.NONE
    if t % RESET == 0:
        return Intervention.SCENE_RESET if t else Intervention.INITIAL
    return Intervention.END_EFFECTOR_RESET


def success(stream: int, t: int) -> bool:
    """Segment k of stream i succeeds if i + k is even: from its third frame on, in stream 2 from its first."""
    k = t // K
    return (stream + k) % 2 == 0 and (t % K >= 2 or stream == 2)


ORIGIN = Origin(STREAMS_KIND, "lerobot_env_cronos/kitchen_2x2-v1", "0123456789abcdef")


def make_step(t, *, actions, log_prob, value, **changes) -> Step:
    """A step of the main loop of n streams; what is not given is nothing in particular."""
    n = len(actions)
    action = ActionSample(actions, log_prob, value)
    zeros, no = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    rest = {
        "instructions": ["task"] * n, "reward": zeros, "success": no, "diverged": no, "cut": no, "piece": zeros,
        "segments_since_reset": zeros, "preceded_by": zeros, "interventions": zeros, "policy_version": 0,
        "intervened": no,
    }  # fmt: skip
    return Step(t, action=action, **(rest | changes))


def step(recorder: StreamRecorder, t: int, num_streams: int = STREAMS, **changes) -> None:
    streams = np.arange(num_streams)
    code = 1000 * streams + t
    columns = {
        "observation": {
            "pixels": {"front": PICTURES[(streams + t) % 7]},
            "agent_pos": np.repeat(code[:, None], STATE_DIM, axis=1).astype(np.float32),
        },
        "instructions": [TASKS[(i + t // K) % 2] for i in streams],
        "actions": np.repeat(code[:, None], 7, axis=1).astype(np.float32) / 2,
        "reward": code / 4,
        "success": np.array([success(i, t) for i in streams]),
        "log_prob": -code / 8,
        "value": code / 16,
        "policy_version": t // UPDATE,
        "preceded_by": np.full(num_streams, intervention(t)),
        "interventions": np.full(num_streams, t // RESET),
        "piece": np.full(num_streams, t // K),
        "segments_since_reset": np.full(num_streams, t % RESET // K),
        "cut": np.full(num_streams, t % K == K - 1),
    }
    recorder.on_step(make_step(t, **(columns | changes)))


def record(
    root, *, flush_at=(), skip=(), steps=STEPS, repo_id="me/stream", origin: Origin | None = ORIGIN
) -> None:
    """Record the streams; `skip` leaves out segments (stream, number)."""
    features = stream_features(world(observation_space(environment_state=None)))
    writer = SegmentWriter(repo_id, root, features, FPS, origin=origin)
    recorder = StreamRecorder(writer, num_envs=STREAMS, segment_length=K)
    add_segment = writer.add_segment

    def add_some(frames, task, *, episode_metadata, **options):
        if (episode_metadata["cronos.stream_id"], episode_metadata["cronos.segment_index"]) not in skip:
            add_segment(frames, task, episode_metadata=episode_metadata, **options)

    writer.add_segment = add_some
    for t in range(steps):
        step(recorder, t)
        if t in flush_at:
            writer.flush()
    recorder.close()
