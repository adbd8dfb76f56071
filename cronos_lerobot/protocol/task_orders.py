"""Task orders: which task a stream gets at its next task switch (paper, Section 5 and Appendix E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.task_values import RunContext, TaskValues


@dataclass(frozen=True)
class TaskSet:
    """The tasks of a run: those that are evaluated and, with learned resets, one reset task for each object."""

    tasks: tuple[Any, ...]
    reset_tasks: tuple[Any, ...] = ()

    @classmethod
    def of(cls, scene: Any, protocol: ProtocolConfig) -> TaskSet:
        """The tasks of `scene` that `protocol` trains."""
        return cls(tuple(scene.tasks), tuple(scene.reset_tasks) if protocol.learned_reset else ())

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
    one. What an order keeps besides that and its generator it tells in `state_dict()` and takes back in
    `load_state_dict(state)`, as a `ResetStrategy` does, or a resumed run goes on without it.

    An order may also have `bind(run)`: it is then told once, before the run begins or goes on, what the run is
    made of, a `RunContext`; a ValueError refuses the run.
    """

    def draw(self, loop: LoopState) -> np.ndarray:
        """Return the next task of every stream, (N,) indices below `loop.num_tasks`.

        With `protocol.reset_starts=learnable` a stream that was just reset is given its `loop.first_task` instead,
        where that is not -1.
        """
        ...


TaskOrderFactory = Callable[[np.random.Generator], TaskOrder]

TASK_ORDERS: dict[str, TaskOrderFactory] = {}
"""Task orders by name."""


def register_task_order(name: str) -> Callable[[TaskOrderFactory], TaskOrderFactory]:
    """Make a task order selectable as `--protocol.task_order=name`.

    It decorates a class whose constructor, or a function that, takes the generator of the order's random draws.

    Raises:
        ValueError: the name is taken.
    """

    def register(factory: TaskOrderFactory) -> TaskOrderFactory:
        if name in TASK_ORDERS:
            raise ValueError(f"there is a task order {name!r} already; taken names: {sorted(TASK_ORDERS)}.")
        TASK_ORDERS[name] = factory
        return factory

    return register


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


@register_task_order("critic")
class CriticOrder:
    """What is neither hopeless nor certain by the agent's own values comes first (not in the paper).

    p = V / certain_value, clipped to [0, 1], stands for the chance of a success, and a task is drawn with a
    probability proportional to (p (1 - p) + floor) ** sharpness. Tasks that are known to be complete are left out,
    unless all are.

    Raises:
        ValueError: in `bind`, of an agent without values.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._values: TaskValues | None = None

    def bind(self, run: RunContext) -> None:
        """Take the agent's values and the protocol's `critic`."""
        self._values, self._config = TaskValues(run, "protocol.task_order=critic"), run.protocol.critic

    def draw(self, loop: LoopState) -> np.ndarray:
        """One draw for each stream; `loop.task_value` becomes the values of what was drawn."""
        if self._values is None:
            raise ValueError("protocol.task_order=critic works in cronos-train: here no agent tells its values.")
        values = self._values.ask()
        odds = self.weigh(values, self._values.find_complete(loop)).cumsum(axis=1)
        drawn = self.rng.random(loop.num_streams)[:, None] * odds[:, -1:]
        task = (odds > drawn).argmax(axis=1)
        given = np.where(loop.first_task >= 0, loop.first_task, task)
        loop.task_value = values[np.arange(loop.num_streams), given]
        return task

    def weigh(self, values: np.ndarray, complete: np.ndarray) -> np.ndarray:
        """Weights (N, tasks) that the probabilities are proportional to.

        Args:
            values: (N, tasks).
            complete: (N, tasks) bool, to be left out.
        """
        p = (values / self._config.certain_value).clip(0, 1)
        weights = (p * (1 - p) + self._config.floor) ** self._config.sharpness
        return np.where(complete & ~complete.all(axis=1, keepdims=True), 0.0, weights)


BUILT_IN = frozenset(TASK_ORDERS)


class CheckedOrder:
    """A user's order whose every draw is looked at: what is no task would stop the run much later, or never.

    Raises:
        ValueError: in `draw`, of anything but (N,) indices of tasks; it names the order.
    """

    def __init__(self, order: TaskOrder) -> None:
        self.order = order

    def bind(self, run: RunContext) -> None:
        """Tell the order."""
        bind_task_order(self.order, run)

    def draw(self, loop: LoopState) -> np.ndarray:
        """What the order draws."""
        drawn = self.order.draw(loop)
        wanted = (
            f"{type(self.order).__name__}.draw must return an array ({loop.num_streams},) of ints in 0.."
            f"{loop.num_tasks - 1}, the next task of every stream, got"
        )
        try:
            task = np.asarray(drawn)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{wanted} {drawn!r}.") from error
        if task.shape != (loop.num_streams,) or not np.issubdtype(task.dtype, np.integer):
            raise ValueError(f"{wanted} {task.dtype} of shape {task.shape}: {drawn!r}.")
        if wrong := sorted({*task[(task < 0) | (task >= loop.num_tasks)].tolist()}):
            raise ValueError(f"{wanted} {wrong} among them.")
        return task


class LearnedReset:
    """Every second segment, the stream puts the object of its last task back on the table (paper, Section 5, LSR).

    Args:
        order: draws the tasks in between.
        reset_task: (num_tasks,) index of the reset task that follows each task.
    """

    def __init__(self, order: TaskOrder, reset_task: np.ndarray) -> None:
        self.order = order
        self.reset_task = reset_task

    def bind(self, run: RunContext) -> None:
        """Tell the order of the tasks in between."""
        bind_task_order(self.order, run)

    def draw(self, loop: LoopState) -> np.ndarray:
        """A task for every stream, or the reset task of every stream, in turns."""
        if loop.switches % 2:
            return self.reset_task[loop.task]
        return self.order.draw(loop)


def bind_task_order(order: TaskOrder, run: RunContext) -> None:
    """Tell a task order what the run is made of, if it wants to know; a ValueError refuses the run."""
    bind = getattr(order, "bind", None)
    if bind is not None:
        bind(run)


def find_inner(order: TaskOrder) -> TaskOrder:
    """The order itself, out of what `make_task_order` has put around it."""
    while isinstance(order, CheckedOrder | LearnedReset):
        order = order.order
    return order


def check_task_order(name: str) -> None:
    """Raise a ValueError that lists the valid names, unless `name` is one of them."""
    if name not in TASK_ORDERS:
        raise ValueError(
            f"protocol.task_order must be one of {sorted(TASK_ORDERS)}, got {name!r}. Register your own with "
            "cronos_lerobot.protocol.task_orders.register_task_order, in a module named by "
            "--protocol.discover_packages_path."
        )


def make_task_order(name: str, rng: np.random.Generator, task_set: TaskSet | None = None) -> TaskOrder:
    """Return the task order `name`, with a learned reset after every task if `task_set` has reset tasks.

    Raises:
        ValueError: no task order has that name.
    """
    check_task_order(name)
    order = TASK_ORDERS[name](rng)
    if name not in BUILT_IN:
        order = CheckedOrder(order)
    if task_set is None or not task_set.reset_tasks:
        return order
    return LearnedReset(order, task_set.reset_task_of())
