"""Recorded streams of a loop whose every number says which stream and step it belongs to."""

import numpy as np
from synthetic_segments import FPS, STATE_DIM, images, observation_space

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.protocol.interventions import Intervention

K = 4
STREAMS = 3
STEPS = 8 * K
RESET = 4 * K
UPDATE = 2 * K
TASKS = ("put the cup on the plate", "put the can on the cloth")
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


def step(recorder: StreamRecorder, t: int) -> None:
    streams = np.arange(STREAMS)
    code = 1000 * streams + t
    resets = (t // RESET) * np.ones(STREAMS, int)
    recorder.on_step(
        {
            "pixels": {"front": PICTURES[(streams + t) % 7]},
            "agent_pos": np.repeat(code[:, None], STATE_DIM, axis=1).astype(np.float32),
        },
        [TASKS[(i + t // K) % 2] for i in streams],
        np.repeat(code[:, None], 7, axis=1).astype(np.float32) / 2,
        code / 4,
        np.array([success(i, t) for i in streams]),
        -code / 8,
        code / 16,
        t // UPDATE,
        interventions=np.full(STREAMS, intervention(t)),
        stream_interventions=resets,
        total_interventions=int(resets.sum()),
        steps=np.full(STREAMS, t),
        segments=np.full(STREAMS, t // K),
        segment_ends=np.full(STREAMS, t % K == K - 1),
    )


def record(root, *, flush_at=(), skip=(), steps=STEPS, repo_id="me/stream") -> None:
    """Record the streams; `skip` leaves out segments (stream, number)."""
    writer = SegmentWriter(repo_id, root, stream_features(observation_space(environment_state=None)), FPS)
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
