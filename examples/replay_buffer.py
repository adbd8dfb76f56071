"""Recorded streams as a replay buffer of `lerobot.rl`: every transition as it happened, cuts as truncations.

    streams = StreamDataset("me/stream", root="outputs/train/recorded/streams")
    buffer = to_replay_buffer(streams, ["observation.state", "observation.environment_state"])

LeRobot's own `ReplayBuffer.from_lerobot_dataset` knows no truncation: it stores none, and where an episode ends
without being done it takes a state for its own successor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch
from lerobot.utils.constants import ACTION, REWARD

from cronos_lerobot.data.schema import DECISION_COLUMNS, INTERVENED, STREAM_COLUMNS, TRUNCATED
from cronos_lerobot.data.streams import Segment, StreamDataset
from cronos_lerobot.protocol.interventions import Intervention

if TYPE_CHECKING:
    from lerobot.rl import ReplayBuffer


def to_replay_buffer(
    streams: StreamDataset, state_keys: Sequence[str], *, device: str = "cpu", **options: Any
) -> ReplayBuffer:
    """Fill a replay buffer with the transitions of recorded streams, stream by stream, in the order of time.

    No transition is `done`. The last frame of a segment is `truncated`, and there only if its successor is in the
    data: where the next segment began after a mere task switch, its first observation is what followed. After any
    reset it is not, and the frame is left out; so is the last frame of a recording, and every last frame where
    the observation itself names the task (`--env.task_observation`), which the switch changes.

    Args:
        streams: recorded ones, filtered or not.
        state_keys: columns of a state, vectors and cameras; these are float32 (3, H, W) in [0, 1].
        device: where samples go.
        options: of `ReplayBuffer`, such as `capacity` (by default all frames) and `storage_device`.

    Returns:
        The buffer, with `complementary_info` of each transition: the columns of the stream without `cronos.`, such
        as `policy_version`, `stream_id` and `step`, LeRobot's `task_index`, and `is_intervention`, as LeRobot's
        actor calls it.

    Raises:
        ValueError: there is no such column, or the buffer is to take successors from its next row
            (`optimize_memory`).
    """
    from lerobot.rl import ReplayBuffer

    if unknown := [key for key in state_keys if key not in streams.meta.features]:
        raise ValueError(f"{streams.repo_id} has no columns {unknown}; it has {list(streams.meta.features)}")
    if options.get("optimize_memory"):
        raise ValueError("optimize_memory=True takes the next row for a successor, and rows at cuts are left out")
    capacity = options.pop("capacity", streams.meta.total_frames)
    buffer = ReplayBuffer(capacity, device=device, state_keys=state_keys, **options)
    for transition in _transitions(streams, state_keys):
        buffer.add(**transition)
    return buffer


def _transitions(streams: StreamDataset, state_keys: Sequence[str]) -> Iterator[dict[str, Any]]:
    flags = streams.origin.flags
    names_task = not flags or flags.get("env.task_observation", "none") != "none"
    stored = [name for name in (*STREAM_COLUMNS, *DECISION_COLUMNS, "task_index") if name in streams.meta.features]
    info = {name: "is_intervention" if name == INTERVENED else name.removeprefix("cronos.") for name in stored}
    segments = streams.segments
    following = [*segments[1:], None]
    states = _states(streams, segments[0], state_keys)
    for segment, after in zip(segments, following, strict=True):
        after_states = None if after is None else _states(streams, after, state_keys)
        columns = streams.columns(segment, [ACTION, REWARD, TRUNCATED, *info])
        for t in range(segment.length):
            is_last = t == segment.length - 1
            if not is_last:
                successor = {key: value[t + 1] for key, value in states.items()}
            elif after_states is not None and not names_task and _goes_on(segment, after):
                successor = {key: value[0] for key, value in after_states.items()}
            else:
                continue
            yield {
                "state": {key: value[t][None] for key, value in states.items()},
                "action": torch.tensor(columns[ACTION][t])[None],
                "reward": float(columns[REWARD][t]),
                "next_state": {key: value[None] for key, value in successor.items()},
                "done": False,
                "truncated": bool(columns[TRUNCATED][t]),
                "complementary_info": {name: float(columns[column][t]) for column, name in info.items()},
            }
        states = after_states or {}


def _goes_on(segment: Segment, after: Segment | None) -> bool:
    """Whether the first observation of `after` is what followed the last frame of `segment`."""
    return (
        after is not None
        and after.stream == segment.stream
        and after.step == segment.step + segment.length
        and after.event == Intervention.TASK_SWITCH
    )


def _states(streams: StreamDataset, segment: Segment, keys: Sequence[str]) -> dict[str, torch.Tensor]:
    vectors = [key for key in keys if key not in streams.meta.video_keys]
    columns = streams.columns(segment, vectors) if vectors else {}
    states = {key: torch.tensor(column) for key, column in columns.items()}
    for key in set(keys) - set(vectors):
        states[key] = torch.from_numpy(streams.pixels(segment, key)).permute(0, 3, 1, 2) / 255
    return states
