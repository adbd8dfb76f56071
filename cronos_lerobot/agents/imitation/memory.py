"""The segments of reset-free streams that are remembered, as raw frames, and how often each is drawn."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, REWARD

from cronos_lerobot.agents.base import Columns
from cronos_lerobot.ranks import Ranks


@dataclass(frozen=True)
class Segment:
    """T successive frames of one stream under one instruction."""

    instruction: str
    columns: Columns
    """(T, ...) each: raw observations, `action` float32 in physical units, `next.reward` float32."""
    success: bool = True
    """Whether the task was complete at any of its steps."""

    def __len__(self) -> int:
        return len(self.columns[ACTION])

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return sum(column.nbytes for column in self.columns.values())


class OpenSegments:
    """What has happened in the segments that are not over.

    Args:
        num_streams: N of this process.
        kept: whether anything is; where demonstrations alone are cloned nothing would be drawn of it.
    """

    def __init__(self, num_streams: int, kept: bool = True) -> None:
        self.num_streams = num_streams
        self.kept = kept
        self.clear()

    def clear(self) -> None:
        """Begin a segment of every stream."""
        self._rows: list[Columns] = []
        self._success: list[np.ndarray] = []
        self._instructions: list[str] = []
        self._begin = np.zeros(self.num_streams, np.int64)

    def add(
        self,
        observation: Columns,
        instructions: list[str],
        action: np.ndarray,
        reward: np.ndarray,
        diverged: np.ndarray,
    ) -> None:
        """Copy one step of every stream, arrays (N, ...). What came before a divergence is forgotten."""
        if not self.kept:
            return
        row = observation | {ACTION: action.astype(np.float32), REWARD: reward.astype(np.float32)}
        self._rows.append({name: np.array(column) for name, column in row.items()})
        self._instructions = instructions
        self._begin[diverged] = len(self._rows)

    def note(self, success: np.ndarray) -> None:
        """Of the step last added: where the task was complete after it, (N,) bool."""
        if self.kept:
            self._success.append(np.array(success))

    def close(
        self,
        found_complete: np.ndarray,
        tail_steps: int,
        lead_steps: int | None = None,
        with_failed: bool = False,
    ) -> list[Segment]:
        """Return the successful segments, and begin new ones.

        They are kept from their last `lead_steps` up to the first success, or their beginning, to `tail_steps`
        after it. One that was found complete is none: nothing had to be done. Those that failed are returned
        whole, if they are asked for.
        """
        success = np.array(self._success).reshape(len(self._rows), self.num_streams)
        segments = []
        for i in range(self.num_streams):
            begin = int(self._begin[i])
            steps = np.flatnonzero(success[begin:, i])
            rows, success_i = self._rows[begin:], bool(len(steps))
            if found_complete[i] or not (success_i or (with_failed and rows)) or (success_i and steps[0] == 0):
                continue
            if success_i:
                end = int(steps[0]) + 1
                kept_from = 0 if lead_steps is None else max(0, end - lead_steps)
                rows = rows[kept_from : end + tail_steps]
            columns = {name: np.stack([row[name][i] for row in rows]) for name in rows[0]}
            segments.append(Segment(self._instructions[i], columns, success=success_i))
        self.clear()
        return segments


class SegmentMemory:
    """The newest segments, drawn from frame by frame.

    Args:
        max_bytes: the oldest segments go while there are more; the newest one always stays.
        drop_last: frames at the end of each segment that are never drawn, as LeRobot's sampler leaves out the
            last frames of an episode for policies that say `drop_n_last_frames`; they are in others' chunks.
    """

    def __init__(self, max_bytes: int, drop_last: int = 0) -> None:
        self.max_bytes = max_bytes
        self.drop_last = drop_last
        self.segments: deque[Segment] = deque()
        self._bytes = 0
        self._lengths: np.ndarray | None = None

    def __len__(self) -> int:
        """Segments."""
        return len(self.segments)

    @property
    def num_frames(self) -> int:
        """Frames that can be drawn."""
        return int(self.lengths.sum())

    @property
    def lengths(self) -> np.ndarray:
        """Frames of each segment that can be drawn, int64."""
        if self._lengths is None:
            self._lengths = np.array([len(segment) - self.drop_last for segment in self.segments], np.int64)
        return self._lengths

    def add(self, segment: Segment) -> None:
        """Keep a segment, unless no frame of it could be drawn."""
        if len(segment) <= self.drop_last:
            return
        self.segments.append(segment)
        self._bytes += segment.nbytes
        self._lengths = None
        while self._bytes > self.max_bytes and len(self.segments) > 1:
            self._bytes -= self.segments.popleft().nbytes

    def draw(
        self, count: int, rng: np.random.Generator, weights: np.ndarray | None = None
    ) -> list[tuple[Segment, int]]:
        """Return `count` draws of a segment and the index of a frame in it.

        Args:
            count: how many.
            rng: draws them.
            weights: (segments,), in proportion to which each frame of a segment is drawn; None draws all alike.
        """
        lengths = self.lengths
        if weights is None:
            ends = np.cumsum(lengths)
            picks = rng.integers(ends[-1], size=count)
            numbers = np.searchsorted(ends, picks, side="right")
            frames = picks - (ends - lengths)[numbers]
        else:
            mass = lengths * weights
            numbers = rng.choice(len(lengths), size=count, p=mass / mass.sum())
            frames = rng.integers(lengths[numbers])
        return [(self.segments[n], int(frame)) for n, frame in zip(numbers, frames, strict=True)]

    def state_dict(self) -> list[dict[str, Any]]:
        """Every segment, oldest first."""
        return [dict(vars(segment)) for segment in self.segments]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        """Go on from `state_dict`."""
        self.segments.clear()
        self._bytes, self._lengths = 0, None
        for segment in state:
            self.add(Segment(**segment))


def own_share(memories: list[list[Any]], rank: int, count: int) -> list[Any]:
    """What process `rank` of `count` continues with of the memories of all processes that made a checkpoint."""
    if len(memories) == count:
        return memories[rank]
    return [segment for memory in memories for segment in memory][rank::count]


@dataclass(frozen=True)
class Remembered:
    """The segments that all processes remember, in the order of the ranks, without their frames."""

    instructions: np.ndarray
    """(segments,) of str."""
    lengths: np.ndarray
    """(segments,) frames of each that can be drawn."""
    returns: np.ndarray
    """(segments,) discounted returns from the first frame on; 0 where no discount was given."""
    counts: np.ndarray
    """(processes,) segments of each."""

    @classmethod
    def of(cls, memory: SegmentMemory, ranks: Ranks, gamma: float | None = None) -> Remembered:
        """What this process remembers and the others; all call it, with the discount factor of the returns."""
        instructions = np.array([segment.instruction for segment in memory.segments], dtype=np.str_)
        returns = np.zeros(len(memory)) if gamma is None else discounted_returns(memory.segments, gamma)
        parts = ranks.gather((instructions, memory.lengths, returns))
        columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        return cls(*columns, counts=np.array([len(part[0]) for part in parts]))

    def split(self, weights: np.ndarray) -> list[np.ndarray]:
        """Of the segments' weights, those of each process."""
        return np.split(weights, np.cumsum(self.counts)[:-1])

    def masses(self, weights: np.ndarray) -> np.ndarray:
        """(processes,) the sum of the frames' weights of each, by which its loss counts."""
        return np.array([mass.sum() for mass in self.split(self.lengths * weights)])


def by_return(returns: np.ndarray, beta: float) -> np.ndarray:
    """exp(R / beta) of discounted returns R, (segments,), the largest 1 (Peters & Schaal, 2007)."""
    return np.exp((returns - returns.max()) / beta)


def by_advantage(returns: np.ndarray, instructions: np.ndarray, beta: float, max_weight: float) -> np.ndarray:
    """min(exp(A / beta), max_weight), (segments,): advantage-weighted regression (Peng et al., 2019).

    A is the return less the mean return of all segments under the same instruction, instead of a critic's value.
    """
    _, tasks = np.unique(instructions, return_inverse=True)
    means = np.bincount(tasks, weights=returns) / np.bincount(tasks)
    return np.exp(np.minimum((returns - means[tasks]) / beta, np.log(max_weight)))


def effective_share(weights: np.ndarray, lengths: np.ndarray) -> float:
    """As how large a share of all frames, drawn alike, the weighted ones count (Kish's effective sample size)."""
    total = float((lengths * weights).sum())
    return total**2 / float((lengths * weights**2).sum()) / float(lengths.sum())


def discounted_returns(segments: Sequence[Segment], gamma: float) -> np.ndarray:
    """(segments,) returns from the first frame on; `gamma` is the discount factor per control step."""
    return np.array([(segment.columns[REWARD] * gamma ** np.arange(len(segment))).sum() for segment in segments])
