"""Who says that a task is done: a person, the simulator's truth, or a model (reward_models.py)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from cronos_lerobot.robot.person import Events

PERSON, SIM = "person", "sim"


class Judge(Protocol):
    """Judges every control step. It never ends a segment."""

    name: str
    """For recordings and results."""

    def begin(self, task: Any) -> None:
        """A segment of a task begins."""
        ...

    def judge(self, observation: Mapping[str, Any], events: Events) -> bool:
        """Whether the task is complete now, by what the robot observes and the person does."""
        ...


class PersonJudge:
    """Complete from the success key on, until the failure key or the end of the segment."""

    name = PERSON

    def begin(self, task: Any) -> None:
        """See `Judge`."""
        self._said = False

    def judge(self, observation: Mapping[str, Any], events: Events) -> bool:
        """See `Judge`."""
        self._said = (self._said or events.success) and not events.failure
        return self._said


class SimJudge:
    """The truth of a simulated robot, which is turned around in a share of the segments. For tests.

    Args:
        world: the simulator, with `find_complete`.
        error: share of the segments in which it is wrong, from a drawn step on.
        window: control steps of a segment.
        rng: draws them.
    """

    name = SIM

    def __init__(self, world: Any, error: float, window: int, rng: np.random.Generator) -> None:
        self._world, self._error, self._window, self._rng = world, error, window, rng

    def begin(self, task: Any) -> None:
        """See `Judge`."""
        self._task, self._step = task, 0
        is_wrong, turn = self._rng.random() < self._error, int(self._rng.integers(self._window))
        self._turn = turn if is_wrong else self._window + 1

    def judge(self, observation: Mapping[str, Any], events: Events) -> bool:
        """See `Judge`."""
        self._step += 1
        truth = bool(self._world.find_complete([self._task])[0, 0])
        return truth != (self._step > self._turn)
