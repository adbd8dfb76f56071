"""How often the frames of a remembered segment are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lerobot.utils.constants import REWARD

from cronos_lerobot.agents.imitation.memory import Segment


def by_task(segments: Sequence[Segment], lengths: np.ndarray) -> np.ndarray:
    """Weights of the segments' frames, (segments,), with which every instruction is drawn as often.

    Args:
        segments: of them.
        lengths: frames of each that can be drawn.
    """
    _, tasks = np.unique([segment.instruction for segment in segments], return_inverse=True)
    return 1.0 / np.bincount(tasks, weights=lengths)[tasks]


def by_return(segments: Sequence[Segment], gamma: float, beta: float) -> np.ndarray:
    """exp(R / beta), (segments,), the largest 1: reward-weighted regression (Peters & Schaal, 2007).

    Args:
        segments: of them, with the discounted return R of each from its first frame on.
        gamma: discount factor per control step.
        beta: the smaller, the more the best segment counts.
    """
    returns = _returns(segments, gamma)
    return np.exp((returns - returns.max()) / beta)


def by_advantage(segments: Sequence[Segment], gamma: float, beta: float, max_weight: float) -> np.ndarray:
    """min(exp(A / beta), max_weight), (segments,): advantage-weighted regression (Peng et al., 2019).

    A is the return less the mean return of all segments under the same instruction, in place of a critic's value.
    See `by_return`.
    """
    returns = _returns(segments, gamma)
    _, tasks = np.unique([segment.instruction for segment in segments], return_inverse=True)
    means = np.bincount(tasks, weights=returns) / np.bincount(tasks)
    return np.exp(np.minimum((returns - means[tasks]) / beta, np.log(max_weight)))


def effective_share(weights: np.ndarray, lengths: np.ndarray) -> float:
    """As how large a share of all frames, drawn alike, the weighted ones count (Kish's effective sample size)."""
    total = float((lengths * weights).sum())
    return total**2 / float((lengths * weights**2).sum()) / float(lengths.sum())


def _returns(segments: Sequence[Segment], gamma: float) -> np.ndarray:
    return np.array([(segment.columns[REWARD] * gamma ** np.arange(len(segment))).sum() for segment in segments])
