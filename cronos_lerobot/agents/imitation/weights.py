"""How often the frames of a remembered segment are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from lerobot.utils.constants import REWARD

from cronos_lerobot.agents.imitation.memory import Segment, SegmentMemory
from cronos_lerobot.ranks import Ranks


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
    """exp(R / beta), (segments,), the largest 1: reward-weighted regression (Peters & Schaal, 2007).

    Args:
        returns: the discounted return R of each segment.
        beta: the smaller, the more the best segment counts.
    """
    return np.exp((returns - returns.max()) / beta)


def by_advantage(returns: np.ndarray, instructions: np.ndarray, beta: float, max_weight: float) -> np.ndarray:
    """min(exp(A / beta), max_weight), (segments,): advantage-weighted regression (Peng et al., 2019).

    A is the return less the mean return of all segments under the same instruction, in place of a critic's value.
    See `by_return`.
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
