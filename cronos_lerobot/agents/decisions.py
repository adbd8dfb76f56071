"""Agents whose policy decides on n actions at once, which are then played without looking."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from cronos_lerobot.agents.base import ActionSample, Columns, LearningAgent, decision_steps, observation_steps
from cronos_lerobot.agents.chunk_player import ObservationHistory
from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.stopwatch import Stopwatch


@dataclass(frozen=True)
class Decision:
    """Decisions of k streams."""

    actions: np.ndarray
    """(k, n, A) float32 in physical units."""
    trace: np.ndarray
    """(k, ...), in the policy's own type: which decision it was."""
    log_prob: np.ndarray
    """(k,), or (k, L) by factor, float32 [nats]."""
    value: np.ndarray
    """(k,) float32."""
    inputs: Columns
    """What was decided on, (k, ...) each, as the agent learns from it."""


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
        intervened: (N,) bool, a person or a script acted at any of their steps.
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
        self.intervened = np.zeros(n, bool)

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
        intervened: np.ndarray | bool = False,
        before: Callable[[], np.ndarray],
        after: Callable[[], np.ndarray],
    ) -> bool:
        """Take in one control step; returns whether the decisions are over.

        Args:
            reward: (N,).
            cut: (N,) bool, the trace ends with it.
            diverged: (N,) bool, of those, where it has no outcome.
            gamma: discount factor per control step.
            intervened: (N,) bool or one for all, a person or a script acted.
            before: gives what is kept in `following`, (N, ...), of the observation before the step, for those that
                diverged; called only if there are any.
            after: the same of the observation after it, for the others that are cut.
        """
        self.reward += np.where(self._open, gamma**self.step * reward, 0.0)
        self.duration += self._open
        self.intervened |= self._open & intervened
        ends = self._open & cut
        for which, observed in ((ends & ~diverged, after), (ends & diverged, before)):
            if which.any():
                self.following[which] = observed()[which]
        self.cut |= ends
        self._open &= ~cut
        self.fresh = cut.copy()
        self.step = (self.step + 1) % self.num_steps
        return self.step == 0


class DecidingAgent(LearningAgent):
    """Decides, plays and takes in what comes of it; a subclass learns.

    When streams decide, and what is learned from: see `DecisionClock`. What a policy that looks back has seen of a
    stream is forgotten where its trace is cut.

    Args:
        decider: the policy, or what is around it, with its `decision_steps` and `observation_steps`.
        gamma: discount factor per control step.
        streams: of all N, those that this agent acts in; observations are of these, all else is of all N.
        stopwatch: told the time spent in `act` ("infer") and `update` ("update").
    """

    describes = ("log_prob", "value")

    def __init__(self, decider: Any, gamma: float, streams: slice, stopwatch: Stopwatch | None) -> None:
        self.gamma, self.streams, self.stopwatch = gamma, streams, stopwatch or Stopwatch()
        self.clock = DecisionClock(decision_steps(decider))
        self.history = ObservationHistory(observation_steps(decider))
        self._seen: Columns = {}
        self._decision: Decision | None = None

    @abstractmethod
    def decide(self, columns: Columns, tau: list[str]) -> Decision:
        """Decide for k streams on observations (k, ...) with their history."""

    @abstractmethod
    def look(self, columns: Columns, tau: list[str]) -> np.ndarray:
        """Return (k, ...) float32, what is kept of observations after which a trace is cut."""

    @abstractmethod
    def seen(self, decision: Decision) -> np.ndarray:
        """Return what `look` would, of the observations that were decided on."""

    @abstractmethod
    def keep(self, decision: Decision, tau: list[str]) -> None:
        """Take in decisions of all streams that are over; the clock says what came of them."""

    def begin(self, decision: Decision) -> None:
        """All streams have decided; the clock still has the decisions before these."""
        return

    @torch.inference_mode()
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """The next action of each of its streams; a decision where none is left."""
        tau = tau[self.streams]
        with self.stopwatch("infer"):
            self._seen = self.history.see(observation_columns(o_t), range(len(tau)))
            if self.clock.step == 0:
                self._decide_all(tau)
            elif self.clock.fresh.any():
                self._decide_anew(tau)
            return ActionSample(self.clock.action(), self._log_prob, self._value)

    def store(
        self,
        o_t: dict[str, Any],
        tau: list[str],
        a_t: ActionSample,
        r_t: np.ndarray,
        o_tp1: dict[str, Any],
        cut_t: np.ndarray,
        diverged_t: np.ndarray,
    ) -> None:
        """Take in one control step; with its last one a decision is kept.

        Where the trace is cut, it is followed by `o_tp1`, or by `o_t` if there is no outcome. A decision with help
        at any of its steps is marked: nothing is learned from it.
        """
        decision = self._decision
        assert decision is not None
        mine, is_first = self.streams, self.clock.step == 0
        tau, cut_t = tau[mine], cut_t[mine]
        is_over = self.clock.store(
            r_t[mine], cut_t, diverged_t[mine], self.gamma,
            intervened=False if a_t.intervened is None else a_t.intervened[mine],
            before=lambda: self.seen(decision) if is_first else self.look(self._seen, tau),
            after=lambda: self.look(self.history.followed_by(observation_columns(o_tp1), range(len(tau))), tau),
        )  # fmt: skip
        self.history.begin(np.flatnonzero(cut_t))
        if is_over:
            self.keep(decision, tau)

    def _decide_all(self, tau: list[str]) -> None:
        self._decision = decision = self.decide(self._seen, tau)
        self._log_prob, self._value = _total(decision.log_prob), decision.value
        self.begin(decision)
        self.clock.begin(decision.actions, self.seen(decision).shape[1:])

    def _decide_anew(self, tau: list[str]) -> None:
        """Streams whose decision ended too early decide on what they do until the others decide."""
        who = np.flatnonzero(self.clock.fresh)
        decision = self.decide({name: col[who] for name, col in self._seen.items()}, [tau[i] for i in who])
        # Copies: what is learned from, and steps that are being recorded, hold the numbers of the former decision.
        self._log_prob, self._value = self._log_prob.copy(), self._value.copy()
        self._log_prob[who], self._value[who] = _total(decision.log_prob), decision.value
        self.clock.begin_anew(decision.actions)


def _total(log_prob: np.ndarray) -> np.ndarray:
    """(k,) of (k,) or (k, L)."""
    return log_prob.reshape(len(log_prob), -1).sum(1)
