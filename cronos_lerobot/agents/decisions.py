"""Decisions of several streams, control step by control step: what is played, summed and cut."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


class DecisionClock:
    """Plays decisions on n actions open loop, and takes in what comes of them.

    All streams decide at the same control steps. A stream that diverges in between has ended its decision there;
    it decides anew, and what it does until the others decide, at most n - 1 steps, is not learned from.

    Args:
        num_steps: n.

    Attributes, of the decisions that are being played or, after `store` said so, are over:
        step: control steps that were stored; 0 when everyone is to decide.
        fresh: (N,) bool, streams that have to decide anew before the others.
        reward: (N,) float64, their rewards, discounted and summed.
        duration: (N,) int64, control steps until their end, fewer than n where they were cut.
        cut: (N,) bool, the trace ends with them.
        following: (N, ...) float32, where they were cut: what `store` was told of the observation after them.
    """

    def __init__(self, num_steps: int) -> None:
        self.num_steps = num_steps
        self.step = 0

    def begin(self, actions: np.ndarray, following: tuple[int, ...] = ()) -> None:
        """All streams have decided.

        Args:
            actions: (N, n, A).
            following: the shape of `following` for one stream.
        """
        n = len(actions)
        self._actions = actions
        self._since = np.zeros(n, np.int64)
        self.reward, self.following = np.zeros(n), np.zeros((n, *following), np.float32)
        self.duration = np.zeros(n, np.int64)
        self.cut, self.fresh, self._open = np.zeros(n, bool), np.zeros(n, bool), np.ones(n, bool)

    def begin_anew(self, actions: np.ndarray) -> None:
        """The k fresh streams have decided, on `actions` (k, n, A)."""
        self._actions = self._actions.copy()
        self._actions[self.fresh] = actions
        self._since[self.fresh] = self.step

    def action(self) -> np.ndarray:
        """The actions (N, A) of this control step."""
        return self._actions[np.arange(len(self._actions)), self.step - self._since]

    def store(
        self,
        reward: np.ndarray,
        cut: np.ndarray,
        diverged: np.ndarray,
        gamma: float,
        *,
        before: Callable[[], np.ndarray],
        after: Callable[[], np.ndarray],
    ) -> bool:
        """Take in one control step; returns whether the decisions are over.

        Args:
            reward: (N,).
            cut: (N,) bool, the trace ends with it.
            diverged: (N,) bool, of those, where it has no outcome.
            gamma: discount factor per control step.
            before: gives what is kept in `following`, (N, ...), of the observation before the step, for those that
                diverged; called only if there are any.
            after: the same of the observation after it, for the others that are cut.
        """
        self.reward += np.where(self._open, gamma**self.step * reward, 0.0)
        self.duration += self._open
        ends = self._open & cut
        for which, observed in ((ends & ~diverged, after), (ends & diverged, before)):
            if which.any():
                self.following[which] = observed()[which]
        self.cut |= ends
        self._open &= ~cut
        self.fresh = cut.copy()
        self.step = (self.step + 1) % self.num_steps
        return self.step == 0
