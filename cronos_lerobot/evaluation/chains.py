"""Runs chains of tasks in a fixed number of streams; a chain that ends makes room for the next one.

All suites are chains: an independent episode is a chain of one task, and a stream is a long one that never stops.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from cronos_lerobot.agents.base import Actor, StreamSeed
from cronos_lerobot.protocol.streams import STEPS_PER_TASK, Streams, Task


@dataclass(frozen=True)
class Chain:
    """What is to be done."""

    number: int
    """Of the task (independent), the ordering (sequential), or the first task of the cycle (stream)."""
    tasks: tuple[Task, ...]
    configuration: int
    """Where it starts: index into the split."""


@dataclass(frozen=True)
class Rules:
    """How a chain continues."""

    window: int = STEPS_PER_TASK
    """Control steps for each task."""
    advance: str = "window"
    """When the next task is given: `window` (the window is over) or `on_success` (at once)."""
    end_effector_reset: bool = False
    """Send the arm home between tasks."""
    stops: bool = True
    """Whether a chain ends at its first failed task, and at the success of its last one."""


@dataclass(frozen=True)
class Trajectory:
    """T steps and the start, to draw pictures from."""

    states: np.ndarray
    """(T + 1, ...) what the runner was told to keep: joint positions, or frames."""
    position: np.ndarray
    """(T + 1,) int, number of the task at hand."""
    is_complete: np.ndarray
    """(T + 1,) bool, whether that task has been complete."""


@dataclass
class ChainResult:
    """What has come of a chain so far."""

    chain: Chain
    success: list[bool] = field(default_factory=list)
    """Of each task that was given."""
    steps: int = 0
    """Control steps."""
    found_complete: list[int] = field(default_factory=list)
    """Positions of successes whose task was complete when it was given."""
    never_grasped: list[int] | None = field(default_factory=list)
    """Positions of other successes without a grasp of the object from the task's start to its success; None if the
    world does not say what is grasped."""
    starts: list[str] = field(default_factory=list)
    """How each task's bodies lay when it was given, if the runner was asked to look."""
    is_kept: bool = False
    """Whether the runner keeps its trajectory."""
    frames: list[tuple[np.ndarray, int, bool]] = field(default_factory=list)
    """Rows of the trajectory."""
    elapsed: int = 0
    """Control steps of the task at hand."""
    was_found: bool | None = None
    """Whether it was complete when it was given; None until that is known."""
    was_grasped: bool = False

    @property
    def length(self) -> int:
        """Tasks completed."""
        return sum(self.success)

    @property
    def task(self) -> Task:
        """The one at hand."""
        return self.chain.tasks[len(self.success) - 1]

    @property
    def is_last(self) -> bool:
        """Whether no task comes after it."""
        return len(self.success) == len(self.chain.tasks)

    @cached_property
    def trajectory(self) -> Trajectory | None:
        """If the runner keeps it."""
        return Trajectory(*map(np.array, zip(*self.frames, strict=True))) if self.frames else None

    def record(self, is_success: bool, is_grasped: bool | None) -> None:
        """Note a control step; `is_grasped` is None where that is unknown."""
        self.steps += 1
        self.elapsed += 1
        if is_grasped is None:
            self.never_grasped = None
        self.was_grasped |= bool(is_grasped)
        if self.was_found is None:
            # No task can be done in one step.
            self.was_found = is_success
        if is_success and not self.success[-1]:
            self.success[-1] = True
            if self.was_found:
                self.found_complete.append(len(self.success) - 1)
            elif self.never_grasped is not None and not self.was_grasped:
                self.never_grasped.append(len(self.success) - 1)


class ChainRunner:
    """Runs chains with one actor.

    Args:
        env: streams of their own, never those of a training. Its `is_success` and `is_grasped` (N,), if it has
            them, are those of the current tasks now.
        actor: chooses the actions.
        rules: of all chains.
        look: says how the bodies of streams (k,) lie, a word each; None does not look.
        states: returns what a picture is drawn from of streams (k,), (k, ...); None keeps no trajectories.
        num_kept: trajectories of the first so many chains alone.
    """

    def __init__(
        self,
        env: Streams,
        actor: Actor,
        rules: Rules = Rules(),  # noqa: B008 - frozen
        *,
        look: Callable[[Any, np.ndarray], Iterable[str]] | None = None,
        states: Callable[[np.ndarray], np.ndarray] | None = None,
        num_kept: int | None = None,
    ) -> None:
        self.env, self.actor, self.rules = env, actor, rules
        self._look, self._states, self._num_kept = look, states, num_kept
        self._everyone = np.arange(env.num_envs)
        self._runs: dict[int, ChainResult] = {}

    def run(
        self,
        chains: Sequence[Chain],
        split: str,
        seed: StreamSeed,
        on_end: Callable[[ChainResult], None] = lambda result: None,
    ) -> list[ChainResult]:
        """Run chains and return their results, in the same order.

        Args:
            chains: in the order in which they get a free stream.
            split: of their configurations.
            seed: of the action sampling. A chain's randomness depends on it, on the chain's number and on its
                configuration, and on nothing else.
            on_end: called with each result as it comes in.
        """
        results = [ChainResult(chain) for chain in chains]
        for result in results[: self._num_kept]:
            result.is_kept = self._states is not None
        waiting, self._runs = deque(results), {}
        self._instructions = [chains[0].tasks[0].instruction] * self.env.num_envs
        observation = self.env.observe()
        while waiting or self._runs:
            fresh = np.union1d(self._fill(waiting, split, seed), self._switch())
            if len(fresh):
                _scatter(observation, fresh, self.env.observe(fresh))
            observation, info = self._step(observation)
            for i in self._record(info):
                on_end(self._runs.pop(i))
        return results

    def _fill(self, waiting: deque[ChainResult], split: str, seed: StreamSeed) -> np.ndarray:
        """Start waiting chains in free streams; returns those (k,).

        An actor with one memory for all streams can only clear it for all: its chains start together.
        """
        free = np.array([i for i in self._everyone if i not in self._runs], dtype=int)[: len(waiting)]
        if not len(free) or not (self.actor.is_per_stream or not self._runs):
            return free[:0]
        runs = {int(i): waiting.popleft() for i in free}
        self.env.scene_reset(free, np.array([run.chain.configuration for run in runs.values()]), split)
        self._runs |= runs
        self._give_next_task(free)
        seeds = [(*seed, run.chain.number, run.chain.configuration) for run in runs.values()]
        self.actor.begin(free, seeds)
        return free

    def _switch(self) -> np.ndarray:
        """Give the next task where it is due; returns those streams (k,)."""
        at_once = self.rules.advance == "on_success"
        window, runs = self.rules.window, sorted(self._runs.items())
        due = [i for i, run in runs if (run.success[-1] if at_once else run.elapsed >= window)]
        ids = np.array(due, dtype=int)
        if len(ids):
            if self.rules.end_effector_reset:
                arms: Any = self.env
                arms.end_effector_reset(ids)
            self._give_next_task(ids)
            self.actor.begin(ids)
        return ids

    def _give_next_task(self, ids: np.ndarray) -> None:
        runs = [self._runs[int(i)] for i in ids]
        for run in runs:
            run.success.append(False)
        self.env.set_task(ids, [run.task for run in runs])
        looks = list(self._look(self.env, ids)) if self._look else []
        for row, (i, run) in enumerate(zip(ids, runs, strict=True)):
            run.elapsed = 0
            run.was_found, run.was_grasped = self._now("is_success", i), bool(self._now("is_grasped", i))
            run.starts += looks[row : row + 1]
            self._instructions[i] = run.task.instruction
            if not run.frames:
                self._keep_state(i, run)

    def _now(self, name: str, i: int) -> bool | None:
        known = getattr(self.env, name, None)
        return None if known is None else bool(known[i])

    def _keep_state(self, i: int, run: ChainResult) -> None:
        if run.is_kept and self._states is not None:
            run.frames.append((self._states(np.array([i]))[0], len(run.success) - 1, run.success[-1]))

    def _step(self, observation: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Act in the streams that run; the others hold still."""
        ids = np.array(sorted(self._runs)) if self.actor.is_per_stream else self._everyone
        rows = observation if len(ids) == len(self._everyone) else _take(observation, ids)
        chosen = self.actor.act(rows, [self._instructions[i] for i in ids], ids).action
        actions = np.zeros((len(self._everyone), chosen.shape[1]))
        actions[ids] = chosen
        observation, *_, info = self.env.step(actions)
        return observation, info

    def _record(self, info: dict[str, np.ndarray]) -> list[int]:
        """Note what a step did; returns the streams whose chains are over."""
        over = []
        diverged = info.get("diverged")
        grasped = info.get("is_grasped", [None] * self.env.num_envs)
        for i, run in sorted(self._runs.items()):
            # A simulation that broke down proves nothing, whatever it shows.
            broke_down = diverged is not None and bool(diverged[i])
            run.record(bool(info["is_success"][i]) and not broke_down, grasped[i])
            self._keep_state(i, run)
            window_over = run.elapsed >= self.rules.window
            if self.rules.stops:
                is_over = broke_down or (window_over and not run.success[-1]) or (run.is_last and run.success[-1])
            else:
                is_over = run.is_last and window_over
            if is_over:
                over.append(i)
        return over


def _take(batch: dict[str, Any], rows: np.ndarray) -> dict[str, Any]:
    return {name: _take(value, rows) if isinstance(value, dict) else value[rows] for name, value in batch.items()}


def _scatter(into: dict[str, Any], rows: np.ndarray, batch: dict[str, Any]) -> None:
    for name, value in batch.items():
        if isinstance(value, dict):
            _scatter(into[name], rows, value)
        else:
            into[name][rows] = value
