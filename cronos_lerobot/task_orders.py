"""Task orders: which task a stream gets at its next task switch (paper, Section 5 and Appendix E)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from cronos_lerobot.loop_state import LoopState


class TaskOrder(Protocol):
    """TASKSCHEDULER of Algorithm 1. `loop` carries each stream's history: attempts and successes by task."""

    def draw(self, loop: LoopState) -> np.ndarray:
        """Return the next task of every stream, (N,) indices into the task set."""
        ...


class HeuristicOrder:
    """The fixed cycle of Appendix E: objects outer, receptacles inner.

    Stream i starts i tasks into the cycle, so that every update sees all tasks.
    """

    def draw(self, loop: LoopState) -> np.ndarray:
        """The successor of each stream's task in the cycle."""
        return (np.arange(loop.num_streams) + loop.switches) % loop.num_tasks


class RandomOrder:
    """Uniform over the task set, independent of everything before."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def draw(self, loop: LoopState) -> np.ndarray:
        """One uniform draw for each stream."""
        return self.rng.integers(loop.num_tasks, size=loop.num_streams)


TASK_ORDERS: dict[str, Callable[[np.random.Generator], TaskOrder]] = {
    "heuristic": lambda rng: HeuristicOrder(),
    "random": RandomOrder,
}
"""Task orders by name; a new one is registered here."""


def make_task_order(name: str, rng: np.random.Generator) -> TaskOrder:
    """Return the task order `name`.

    Raises:
        ValueError: no task order has that name.
    """
    if name not in TASK_ORDERS:
        raise ValueError(f"protocol.task_order must be one of {sorted(TASK_ORDERS)}, got {name!r}.")
    return TASK_ORDERS[name](rng)
