"""Task orders: which task a stream gets at its next task switch (paper, Section 5 and Appendix E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.run_context import RunContext
from cronos_lerobot.protocol.streams import Streams
from cronos_lerobot.registry import Registry


@dataclass(frozen=True)
class TaskSet:
    """The tasks of a run: those that are evaluated and, with learned resets, one reset task for each object."""

    tasks: tuple[Any, ...]
    reset_tasks: tuple[Any, ...] = ()

    @classmethod
    def of(cls, env: Streams, protocol: ProtocolConfig) -> TaskSet:
        """The tasks of `env` that `protocol` trains.

        Raises:
            ValueError: learned resets are wanted, and there are no reset tasks.
        """
        if protocol.learned_reset and not env.reset_tasks:
            raise ValueError(f"--protocol.learned_reset needs reset_tasks, and {env.identity.id} has none")
        return cls(tuple(env.tasks), tuple(env.reset_tasks) if protocol.learned_reset else ())

    @property
    def all(self) -> tuple[Any, ...]:
        """Every task, in the order of the indices that `LoopState.task` holds."""
        return self.tasks + self.reset_tasks

    def reset_task_of(self) -> np.ndarray:
        """Index of the reset task of each task's object, (len(tasks),)."""
        objects = [task.object for task in self.reset_tasks]
        return np.array([len(self.tasks) + objects.index(task.object) for task in self.tasks])

    def new_loop(self, num_streams: int) -> LoopState:
        """The state of a run that has not begun."""
        return LoopState(num_streams, len(self.tasks), len(self.reset_tasks))


class TaskOrder(Protocol):
    """TASKSCHEDULER of Algorithm 1.

    `loop` has each stream's history: `attempts` and `successes` by task, `recent_task` and `recent_success` one by
    one. An order may also have `bind(run)`, `state_dict()` and `load_state_dict(state)`, as a `ResetStrategy` has.
    """

    def draw(self, loop: LoopState) -> np.ndarray:
        """Return the next task of every stream, (N,) indices below `loop.num_tasks`."""
        ...


TaskOrderFactory = Callable[[np.random.Generator], TaskOrder]
TASK_ORDERS: Registry[TaskOrderFactory] = Registry(
    "--protocol.task_order", "cronos_lerobot.protocol.register_task_order"
)
"""Task orders by name."""
register_task_order = TASK_ORDERS.register
"""Decorates a class whose constructor, or a function that, takes the generator of the order's random draws."""


@register_task_order("heuristic")
class HeuristicOrder:
    """The fixed cycle of Appendix E: objects outer, receptacles inner.

    Stream i starts i tasks into the cycle, so that every update sees all tasks.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        """`rng` is not used: nothing is random."""

    def draw(self, loop: LoopState) -> np.ndarray:
        """The successor of each stream's task in the cycle."""
        return (np.arange(loop.num_streams) + loop.round) % loop.num_tasks


@register_task_order("random")
class RandomOrder:
    """Uniform over the task set, independent of everything before."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def draw(self, loop: LoopState) -> np.ndarray:
        """One uniform draw for each stream."""
        return self.rng.integers(loop.num_tasks, size=loop.num_streams)


class LearnedReset:
    """Every second segment, the stream puts the object of its last task back on the table (paper, Section 5, LSR).

    Args:
        order: draws the tasks in between.
        reset_task: (num_tasks,) index of the reset task that follows each task.
    """

    def __init__(self, order: TaskOrder, reset_task: np.ndarray) -> None:
        self.order = order
        self.reset_task = reset_task

    def draw(self, loop: LoopState) -> np.ndarray:
        """A task for every stream, or the reset task of every stream, in turns."""
        if loop.switches % 2:
            return self.reset_task[loop.task]
        return self.order.draw(loop)


def find_inner(order: TaskOrder) -> TaskOrder:
    """The order of the tasks, without the reset tasks that `make_task_order` has put between them."""
    return order.order if isinstance(order, LearnedReset) else order


def bind_task_order(order: TaskOrder, run: RunContext) -> None:
    """Tell a task order what the run is made of, if it wants to know; a ValueError refuses the run."""
    if bind := getattr(find_inner(order), "bind", None):
        bind(run)


def make_task_order(name: str, rng: np.random.Generator, task_set: TaskSet | None = None) -> TaskOrder:
    """Return the task order `name`, with a learned reset after every task if `task_set` has reset tasks.

    Raises:
        ValueError: no task order has that name.
    """
    TASK_ORDERS.check(name)
    order = TASK_ORDERS[name](rng)
    if task_set is None or not task_set.reset_tasks:
        return order
    return LearnedReset(order, task_set.reset_task_of())
