"""What an agent expects of every task from where each stream stands: for orders and resets that go by value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cronos_lerobot.agents.base import Agent, ValuingAgent
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import LoopState


@dataclass(frozen=True)
class RunContext:
    """What a run is made of, for a task order or a reset strategy with a method `bind`."""

    env: Any
    """The streams: all N of them, whatever process they are in."""
    agent: Agent
    tasks: Sequence[Any]
    """Those that are evaluated, in the order of their indices; without learned reset tasks."""
    protocol: ProtocolConfig
    total_steps: int
    """S: interaction steps of the whole run, summed over the streams."""


class TaskValues:
    """The agent's values of the tasks, to be asked at a task switch, when the streams stand where they will go on.

    Args:
        run: asked for.
        flag: what asks, for the message.

    Raises:
        ValueError: the agent has no values.
    """

    def __init__(self, run: RunContext, flag: str) -> None:
        if not isinstance(run.agent, ValuingAgent):
            raise ValueError(
                f"{flag} goes by the agent's values, and {type(run.agent).__name__} has none (no predict_values): "
                "choose an agent that has, as --algorithm.type=ppo, or leave the flag out."
            )
        self._env, self._agent, self._tasks = run.env, run.agent, run.tasks
        self._knows_complete = run.protocol.critic.knows_complete

    def ask(self) -> np.ndarray:
        """Values (N, tasks) float64: one batched forward pass for each task."""
        seen = self._env.observe_under(self._tasks)
        columns = [
            self._agent.predict_values(observation, [task.instruction] * self._env.num_envs)
            for task, observation in zip(self._tasks, seen, strict=True)
        ]
        return np.stack(columns, axis=1).astype(np.float64)

    def find_complete(self, loop: LoopState) -> np.ndarray:
        """Tasks (N, tasks) bool that are complete, as far as that is known: of all, or of the one just tried."""
        complete = self._env.find_complete(self._tasks)
        if not self._knows_complete:
            tried = loop.task[:, None] == np.arange(len(self._tasks))
            complete &= tried & (loop.switches > 0)
        return complete

    def best(self, loop: LoopState) -> np.ndarray:
        """Each stream's best value (N,) over the tasks; a task that is complete has nothing left to give."""
        return np.where(self.find_complete(loop), 0.0, self.ask()).max(axis=1)
