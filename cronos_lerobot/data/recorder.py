"""Records training streams as a LeRobotDataset: an observer that the training loop calls once per step."""

from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from lerobot.utils.constants import ACTION, DONE, REWARD

from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.data.origin import STREAMS, origin_of
from cronos_lerobot.data.schema import (
    EVENT,
    INTERVENED,
    LOG_PROB,
    POLICY_VERSION,
    SEGMENT_COLUMNS,
    SEGMENT_INDEX,
    SEGMENTS_SINCE_RESET,
    STEP,
    STREAM_ID,
    STREAM_INTERVENTIONS,
    SUCCESS,
    SUCCESS_FRAME,
    TOTAL_INTERVENTIONS,
    TRUNCATED,
    VALUE,
    frame_format,
    stream_features,
)
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.protocol.streams import Streams


class StreamRecorder:
    """Buffers the steps of each recorded stream and writes every finished segment as one episode.

    ```python
    recorder = StreamRecorder.open(env, "me/stream", root, segment_length=80, streams="all")
    for event in train(...):                                    # the main loop, `cronos_lerobot.protocol.rf_mtrl`
        if isinstance(event, Step):
            recorder.on_step(event)
    state = recorder.state_dict()                               # at a checkpoint: flushes to disk first
    recorder.close()
    # later: StreamRecorder.open(env, "me/stream", root, ..., state=state) drops what came after `state`
    ```
    """

    def __init__(
        self,
        writer: SegmentWriter,
        *,
        num_envs: int,
        segment_length: int,
        streams: int | str = "all",
    ) -> None:
        """Record into `writer` (see `open` for the usual way to make one).

        Args:
            writer: takes the segments; its features are those of `stream_features`.
            num_envs: streams the loop runs.
            segment_length: the most steps between two task switches (K), the buffers' capacity.
            streams: how many of the streams to record, the first ones, or "all".

        Raises:
            ValueError: `streams` is neither "all" nor between 1 and `num_envs`.
        """
        if streams == "all":
            streams = num_envs
        if isinstance(streams, str) or not 1 <= streams <= num_envs:
            raise ValueError(f"streams must be 'all' or from 1 to num_envs={num_envs}, got {streams!r}")
        self.writer = writer
        self.num_envs = num_envs
        self.num_streams = streams
        self.segment_length = segment_length
        self._written: deque[dict[str, np.ndarray]] = deque()
        self._lengths = np.zeros(streams, dtype=np.int64)
        self._tasks = [""] * streams
        self._buffers = [self._new_buffer() for _ in range(streams)]

    @classmethod
    def open(
        cls,
        env: Streams,
        repo_id: str,
        root: str | Path,
        *,
        segment_length: int,
        streams: int | str = "all",
        describes: Sequence[str] = ("log_prob", "value"),
        state: Mapping[str, Any] | None = None,
        flags: Mapping[str, Any] | None = None,
        **writer_options: Any,
    ) -> Self:
        """A recorder of `env`'s streams: into a new dataset, or on from a checkpoint.

        Args:
            env: whose streams will be recorded; only what it says of itself is read.
            repo_id: the dataset's name, "owner/name".
            root: its folder; must not exist for a new dataset and must for a resumed one.
            segment_length: the most steps between two task switches (K).
            streams: how many of the streams to record, or "all".
            describes: what the agent says of its actions, some of "log_prob" and "value".
            state: of `state_dict()`. Everything that was written after it is dropped from the dataset.
            flags: what the streams are made with, for `meta/cronos.json`.
            writer_options: passed on to `SegmentWriter`, which also says what is raised.
        """
        writer = SegmentWriter(
            repo_id,
            root,
            stream_features(env, describes=describes),
            round(env.fps),
            robot_type=env.robot_type,
            resume=None if state is None else state["num_episodes"],
            origin=origin_of(env, STREAMS, flags or {}),
            **writer_options,
        )
        recorder = cls(writer, num_envs=env.num_envs, segment_length=segment_length, streams=streams)
        if state is not None:
            recorder.load_partial_segments(state)
        return recorder

    def on_step(self, step: Step) -> None:
        """Take one step of all n streams. Everything is copied.

        Args:
            step: its observation may be that of the recorded streams alone. `preceded_by` is NONE inside a
                segment and anything else on its first frame; `cut` says where a switch or a reset follows.

        Raises:
            ValueError: an event inside a segment or none at its start; a segment that outgrows
                `segment_length` or changes its instruction.
        """
        same = partial(np.full, self.num_envs)
        columns = {
            ACTION: step.action.action,
            REWARD: step.reward,
            SUCCESS: step.success,
            DONE: same(False),
            TRUNCATED: step.cut,
            EVENT: step.preceded_by,
            STREAM_INTERVENTIONS: step.interventions,
            STEP: same(step.t),
            SEGMENT_INDEX: step.piece,
            SEGMENTS_SINCE_RESET: step.segments_since_reset,
            LOG_PROB: step.action.log_prob,
            VALUE: step.action.value,
            STREAM_ID: np.arange(self.num_envs),
            TOTAL_INTERVENTIONS: same(int(np.sum(step.interventions))),
            POLICY_VERSION: same(step.policy_version),
            INTERVENED: step.intervened,
        }
        columns |= observation_columns(step.observation)
        for stream in range(self.num_streams):
            self._append(stream, columns, step.instructions[stream])
            if step.cut[stream]:
                self._write_segment(stream)

    def state_dict(self) -> dict[str, Any]:
        """Flush, and return what `open(state=...)` needs to go on from here (numbers and numpy arrays)."""
        self.writer.flush()
        partial = {
            str(stream): {
                "task": self._tasks[stream],
                "frames": {key: frames[:length].copy() for key, frames in self._buffers[stream].items()},
            }
            for stream, length in enumerate(self._lengths)
            if length
        }
        return {
            "num_episodes": self.writer.num_episodes,
            "num_streams": self.num_streams,
            "partial_segments": partial,
        }

    def close(self) -> None:
        """Write the unfinished segments too (their last `next.truncated` is False) and finalize the dataset."""
        for stream in range(self.num_streams):
            if self._lengths[stream]:
                self._write_segment(stream)
        self.writer.finalize()

    def load_partial_segments(self, state: Mapping[str, Any]) -> None:
        """Take over the unfinished segments of `state_dict()`, for a writer that was resumed from it."""
        if state["num_streams"] != self.num_streams:
            raise ValueError(
                f"the state is of {state['num_streams']} recorded streams, this run records {self.num_streams}"
            )
        for name, segment in state["partial_segments"].items():
            stream = int(name)
            for key, frames in segment["frames"].items():
                self._buffers[stream][key][: len(frames)] = frames
                self._lengths[stream] = len(frames)
            self._tasks[stream] = segment["task"]

    def _append(self, stream: int, columns: Mapping[str, Any], task: str) -> None:
        length = self._lengths[stream]
        event = Intervention(int(columns[EVENT][stream]))
        place = f"stream {stream}, step {columns[STEP][stream]}"
        if (event == Intervention.NONE) == (length == 0):
            raise ValueError(
                f"{place}: event {event.name} on frame {length} of its segment; the first frame has one"
            )
        if length == self.segment_length:
            raise ValueError(f"{place}: segment longer than {self.segment_length} steps")
        if length and task != self._tasks[stream]:
            raise ValueError(f"{place}: the instruction changed from {self._tasks[stream]!r} to {task!r}")
        self._tasks[stream] = task
        for key, buffer in self._buffers[stream].items():
            buffer[length] = columns[key][stream]
        self._lengths[stream] += 1

    def _write_segment(self, stream: int) -> None:
        # The writer keeps the arrays until they are encoded, so the stream continues in another buffer.
        length, whole = self._lengths[stream], self._buffers[stream]
        frames = {key: buffer[:length] for key, buffer in whole.items()}
        self.writer.add_segment(
            frames,
            self._tasks[stream],
            episode_metadata=segment_row(frames),
            written=partial(self._written.append, whole),
        )
        self._buffers[stream] = self._new_buffer()
        self._lengths[stream] = 0

    def _new_buffer(self) -> dict[str, np.ndarray]:
        # To take fresh memory costs as much as to copy the pixels into it.
        if self._written:
            return self._written.popleft()
        buffer = {}
        for key, feature in self.writer.features.items():
            shape, dtype = frame_format(feature)
            buffer[key] = np.empty((self.segment_length, *shape), dtype=dtype)
        return buffer


def segment_row(frames: Mapping[str, Any]) -> dict[str, Any]:
    """What the row of a segment in `meta/episodes` says: SEGMENT_COLUMNS and SUCCESS_FRAME of its frames."""
    row: dict[str, Any] = {name: frames[name][0].item() for name in SEGMENT_COLUMNS}
    row |= {name: bool(frames[name].any()) for name in (SUCCESS, INTERVENED)}
    return row | {SUCCESS_FRAME: int(frames[SUCCESS].argmax()) if row[SUCCESS] else -1}
