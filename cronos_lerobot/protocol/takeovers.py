"""Takeovers: an expert does the next segment of a stream that has failed at its task again and again.

The paper has none. A takeover is an intervention of its own kind with a price of its own, so that it can be
weighed against resets (`protocol.takeover_price`). Who decides (`Takeover`) goes by the counters alone; who acts
(`AssistedAgent`) is told by the counters, too, so that nothing else is in a checkpoint.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cronos_lerobot.agents.base import ActionSample, Agent, LearningAgent
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.experts import EXPERTS, Expert, check_expert
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.resets import ResetStrategy


class Takeover(ResetStrategy):
    """Streams whose task has just been drawn, and that have failed at it often enough, get the expert.

    Those that have failed most often come first. The budget is paced: by the end of a segment no more of it has
    been spent than the run's share that is over then; nor does a takeover ever exceed `protocol.reset_budget`, nor
    the share of it that is over, where values ask for resets from the same budget.

    Args:
        protocol: of the run; `takeover_after` is a number.
        total_steps: interaction steps of the run, by which the budget is paced.
        capacity: the most streams at once; None is any number.
    """

    kind = Intervention.TAKEOVER

    def __init__(self, protocol: ProtocolConfig, total_steps: int, capacity: int | None = None) -> None:
        assert protocol.takeover_after is not None
        self.after, self.price = protocol.takeover_after, protocol.takeover_price
        self.budget, self.reset_budget = protocol.takeover_budget, protocol.reset_budget
        self.shares_budget = protocol.scene_reset == "critic"
        self.segment, self.total_steps, self.capacity = protocol.task_switch_interval, total_steps, capacity

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Of the streams that have failed at their task `takeover_after` times in a row, as many as may be."""
        failures = loop.failures[np.arange(loop.num_streams), loop.task]
        stuck = np.flatnonzero(failures >= self.after)
        most_failed_first = stuck[np.argsort(-failures[stuck], kind="stable")]
        return np.sort(most_failed_first[: self._num_affordable(loop)])

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """The scene stays as it is; `AssistedAgent` lets the expert act."""

    def count(self, loop: LoopState, ids: np.ndarray) -> None:
        """Count the takeovers and what they cost."""
        loop.begin_takeover(ids, self.price)

    def _num_affordable(self, loop: LoopState) -> int:
        """How many streams may be taken over now."""
        counts = [loop.num_streams if self.capacity is None else self.capacity]
        over = min(loop.n + loop.num_streams * self.segment, self.total_steps)
        if self.budget is not None:
            counts.append((self.budget * over // self.total_steps - int(loop.takeover_cost.sum())) // self.price)
        if self.reset_budget is not None:
            # Spent at once, it would end the run that the critic's resets were to last for.
            there = self.reset_budget * over // self.total_steps if self.shares_budget else self.reset_budget
            counts.append((there - loop.b) // self.price)
        return max(0, min(counts))


def make_expert(protocol: ProtocolConfig, env: Any, agent: LearningAgent, algorithm: str) -> Expert | None:
    """Return who takes over in the streams of `env`, or None in a run without takeovers.

    Args:
        protocol: of the run.
        env: of this process.
        agent: that acts otherwise.
        algorithm: its name.

    Raises:
        ValueError: there is no such expert, or the agent cannot learn beside one.
    """
    if protocol.takeover_after is None:
        return None
    check_expert(protocol.takeover_expert)
    if not agent.learns_beside_expert:
        raise ValueError(
            f"--algorithm.type={algorithm} cannot learn beside an expert: leave "
            f"--protocol.takeover_after={protocol.takeover_after} out, or choose another agent."
        )
    return EXPERTS[protocol.takeover_expert](env)


class AssistedAgent(Agent):
    """An agent in whose place an expert acts in the streams that are taken over.

    The agent decides there as well, is told the expert's action, and is told in `ActionSample.expert` that it was
    not its own. A takeover begins with a segment and ends with it, where all agents forget their plans.

    Args:
        agent: acts in all other streams.
        expert: acts in those that `loop.taken_over` names.
        loop: of the run.
        streams: of all N, those of this process.
    """

    def __init__(self, agent: Agent, expert: Expert, loop: LoopState, streams: slice = slice(None)) -> None:
        self._agent, self._expert, self._loop, self._streams = agent, expert, loop, streams
        self._segment, self._ids = -1, np.empty(0, np.int64)

    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """The agent's actions, and the expert's in their place; their log-probability is 0.

        Raises:
            ValueError: the expert did not return one action for each of its streams.
        """
        sample = self._agent.act(o_t, tau)
        if self._segment != self._loop.switches:
            self._segment = self._loop.switches
            self._ids = np.flatnonzero(self._loop.taken_over[self._streams])
            if len(self._ids):
                self._expert.begin(self._ids)
        # The same in every process, for those who collect what all of them did.
        if not self._loop.taken_over.any():
            return sample
        expert = np.zeros(len(sample.action), np.bool_)
        if not len(self._ids):
            return replace(sample, expert=expert)
        theirs = np.asarray(self._expert.act(o_t, tau[self._streams]))
        action, log_prob = sample.action.copy(), sample.log_prob.copy()
        if theirs.shape != (wanted := (len(self._ids), *action.shape[1:])):
            raise ValueError(f"the expert {type(self._expert).__name__} returned {theirs.shape}, not {wanted}.")
        action[self._ids], log_prob[self._ids], expert[self._ids] = theirs, 0, True
        return replace(sample, action=action, log_prob=log_prob, expert=expert)

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
        """The agent stores."""
        self._agent.store(o_t, tau, a_t, r_t, o_tp1, cut_t, diverged_t)

    def update(self) -> dict[str, float]:
        """The agent learns."""
        return self._agent.update()
