"""Runs chains of tasks through a fixed number of environments; a chain that ends makes room for the next one.

An independent episode is a chain of one task, so both suites go through here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from lerobot_env_cronos import SequentialVectorEnv, Task
from lerobot_env_cronos.sequential import ChainStep
from lerobot_env_cronos.simulation.simulation import ACTION_NAMES

from cronos_lerobot.evaluation.actors import Actor


@dataclass(frozen=True)
class Chain:
    """What is to be done."""

    number: int
    """Of the ordering, or of the task in an independent evaluation."""
    tasks: tuple[Task, ...]
    configuration: int
    """Index into the split."""


@dataclass(frozen=True)
class Trajectory:
    """What happened, T steps and the start; a video is drawn from it."""

    qpos: np.ndarray
    """(T + 1, nq) float32, joint positions."""
    position: np.ndarray
    """(T + 1,) int, number of the task at hand."""
    is_complete: np.ndarray
    """(T + 1,) bool, whether that task has been complete."""


@dataclass(frozen=True)
class ChainResult:
    """How a chain ended."""

    chain: Chain
    length: int
    """Tasks completed; the first that failed is the one after them."""
    steps: int
    """Control steps."""
    trajectory: Trajectory | None = None
    """If the runner keeps them."""
    found_complete: tuple[int, ...] = ()
    """Positions of completed tasks that were complete when they were given."""
    never_grasped: tuple[int, ...] = ()
    """Positions of the other completed tasks whose object was in no grasp from the task's start to its success."""

    @property
    def is_success(self) -> bool:
        """Whether all tasks were completed."""
        return self.length == len(self.chain.tasks)


Noise = Callable[[Chain], np.ndarray]
"""The randomness of a chain's actions: uniform numbers in [0, 1), (steps, action dimensions) float32."""


def chain_noise(window: int, *key: int) -> Noise:
    """Randomness that depends on `key` and on a chain's number and configuration, and on nothing else.

    Args:
        window: control steps for each task.
        key: non-negative integers: the evaluation's seed, suite and split.
    """

    def draw(chain: Chain) -> np.ndarray:
        rng = np.random.default_rng([*key, chain.number, chain.configuration])
        return rng.random((window * len(chain.tasks), len(ACTION_NAMES)), dtype=np.float32)

    return draw


@dataclass
class _Run:
    """A chain that is running, and its past."""

    index: int
    chain: Chain
    noise: np.ndarray
    steps: int = 0
    qpos: list[np.ndarray] = field(default_factory=list)
    position: list[int] = field(default_factory=lambda: [0])
    is_complete: list[bool] = field(default_factory=lambda: [False])
    found_complete: list[int] = field(default_factory=list)
    never_grasped: list[int] = field(default_factory=list)
    _was_found: bool = False
    _was_grasped: bool = False

    def begin_task(self, is_complete: bool, is_grasped: bool) -> None:
        """Note how the task at hand was found."""
        self._was_found, self._was_grasped = is_complete, is_grasped

    def record(self, position: int, is_success: bool, is_grasped: bool) -> None:
        """Note a step of task `position`; `is_success` at most once for each task."""
        was_complete = self.is_complete[-1] and self.position[-1] == position
        self.steps += 1
        self.position.append(position)
        self.is_complete.append(is_success or was_complete)
        self._was_grasped |= is_grasped
        if is_success and self._was_found:
            self.found_complete.append(position)
        elif is_success and not self._was_grasped:
            self.never_grasped.append(position)

    def result(self, length: int) -> ChainResult:
        trajectory = None
        if self.qpos:
            trajectory = Trajectory(np.stack(self.qpos), np.array(self.position), np.array(self.is_complete))
        kinds = tuple(self.found_complete), tuple(self.never_grasped)
        return ChainResult(self.chain, length, self.steps, trajectory, *kinds)


class ChainRunner:
    """Runs chains with one actor.

    Args:
        env: the environments; what it decides (window, advance, split, ...) holds for all chains.
        actor: chooses the actions.
        keeps_states: return trajectories, from which videos can be drawn.
    """

    def __init__(self, env: SequentialVectorEnv, actor: Actor, *, keeps_states: bool = True) -> None:
        self.env, self.actor = env, actor
        self._keeps_states = keeps_states
        self._everyone = np.arange(env.num_envs)
        self._runs: dict[int, _Run] = {}
        self._results: dict[int, ChainResult] = {}

    def run(
        self, chains: Sequence[Chain], noise: Noise, on_end: Callable[[ChainResult], None] = lambda result: None
    ) -> list[ChainResult]:
        """Run `chains` and return their results, in the same order.

        Args:
            chains: in the order in which they get a free environment.
            noise: the randomness of each of them.
            on_end: called with each result as it comes in.
        """
        waiting = deque(enumerate(chains))
        self._runs, self._results = {}, {}
        self.env.done[:] = True
        began = np.zeros(0, dtype=int)
        while True:
            began = np.union1d(began, self._fill(waiting, noise))
            running = self._everyone[~self.env.done]
            if not len(running):
                return [self._results[i] for i in range(len(chains))]
            self.actor.begin(began)
            step = self.env.apply(self._choose(running))
            for index in self._record(step, running):
                on_end(self._results[index])
            began = self._everyone[step.switched]

    def _fill(self, waiting: deque[tuple[int, Chain]], noise: Noise) -> np.ndarray:
        """Start waiting chains in free environments; returns those (k,).

        A policy with one memory for the whole batch can only clear it for all: its chains are started together.
        """
        free = self._everyone[self.env.done][: len(waiting)]
        if not len(free) or not (self.actor.is_per_environment or self.env.done.all()):
            return np.zeros(0, dtype=int)
        started = [waiting.popleft() for _ in free]
        tasks = [chain.tasks for _, chain in started]
        self.env.start(free, tasks, np.array([chain.configuration for _, chain in started]))
        for i, (index, chain) in zip(free, started, strict=True):
            self._runs[int(i)] = _Run(index, chain, noise(chain))
            self._begin_task(int(i))
            self._keep_state(int(i))
        return free

    def _begin_task(self, i: int) -> None:
        self._runs[i].begin_task(bool(self.env.is_success[i]), bool(self.env.is_grasped[i]))

    def _keep_state(self, i: int) -> None:
        if self._keeps_states:
            self._runs[i].qpos.append(self.env.simulation.qpos[i].astype(np.float32))

    def _choose(self, running: np.ndarray) -> np.ndarray:
        """Actions (n, 7), zero for those that are not running."""
        env = self.env
        if self.actor.is_per_environment:
            ids, observation = running, env.observe(running)
        else:
            ids, observation = self._everyone, env.observe_running(running)
        uniform = np.zeros((len(ids), len(ACTION_NAMES)), np.float32)
        for row, i in enumerate(ids):
            if not env.done[i]:
                run = self._runs[int(i)]
                uniform[row] = run.noise[run.steps]
        instructions = env.instructions
        actions = np.zeros((env.num_envs, len(ACTION_NAMES)))
        actions[ids] = self.actor.act(observation, [instructions[i] for i in ids], uniform, ids)
        return actions

    def _record(self, step: ChainStep, running: np.ndarray) -> Iterable[int]:
        """Note what a step did; returns the indices of the chains that ended."""
        ended = []
        for i in map(int, running):
            run = self._runs[i]
            run.record(int(step.position[i]), bool(step.task_success[i]), bool(step.is_grasped[i]))
            self._keep_state(i)
            if step.switched[i]:
                self._begin_task(i)
            if self.env.done[i]:
                self._results[run.index] = self._runs.pop(i).result(int(self.env.chain_length[i]))
                ended.append(run.index)
        return ended
