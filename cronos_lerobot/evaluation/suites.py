"""The suites: which chains they run, by which rules, and why streams get stuck."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import cycle, islice
from typing import Any, Protocol

import numpy as np
from lerobot_env_cronos import EpisodeGroup
from lerobot_env_cronos.benchmark.orderings import draw_orderings
from lerobot_env_cronos.simulation.workspace import Unsuitable, find_unsuitable

from cronos_lerobot.evaluation.chains import Chain, Rules
from cronos_lerobot.protocol.streams import Streams, Task

SPLITS = ("train", "held_out")
INDEPENDENT, SEQUENTIAL, STREAM = SUITES = ("independent", "sequential", "stream")
STREAM_TASKS = 16
"""Tasks in a row in the stream suite."""


class Benchmark(Protocol):
    """What is evaluated in a world."""

    @property
    def tasks(self) -> Sequence[Task]:
        """Of the world."""
        ...

    @property
    def num_starts(self) -> Mapping[str, int]:
        """By split."""
        ...

    def groups(self, suite: str, split: str) -> Sequence[EpisodeGroup]:
        """The episodes or chains of the independent or sequential suite."""
        ...


@dataclass(frozen=True)
class DrawnBenchmark:
    """Of a world that brings none: every task, and up to ten orderings of them all, from every start."""

    tasks: Sequence[Any]
    num_starts: Mapping[str, int]

    def groups(self, suite: str, split: str) -> list[EpisodeGroup]:
        """See `Benchmark`. The first ordering is the training cycle."""
        starts = tuple(range(self.num_starts[split]))
        if suite == INDEPENDENT:
            return [EpisodeGroup(i, (task,), starts) for i, task in enumerate(self.tasks)]
        orderings = draw_orderings(len(self.tasks))
        return [
            EpisodeGroup(i, tuple(self.tasks[k] for k in ordering), starts, is_training_cycle=i == 0)
            for i, ordering in enumerate(orderings)
        ]


def benchmark_of(env: Streams) -> Benchmark:
    """What is evaluated in `env`."""
    return getattr(env, "benchmark", None) or DrawnBenchmark(env.tasks, env.num_starts)


def make_chains(
    benchmark: Benchmark, suite: str, split: str, n_episodes: int | None = None, orderings: int | None = None
) -> list[Chain]:
    """Return the chains of a suite on a split.

    A stream starts from each configuration. Its tasks follow the training cycle, from another task in each
    configuration.

    Args:
        benchmark: whose configurations and chains they are.
        suite: one of `SUITES`.
        split: `train` or `held_out`.
        n_episodes: the first N configurations of each task, ordering or split; None takes all.
        orderings: the first N orderings of the sequential suite; None takes all.
    """
    if suite == STREAM:
        tasks = benchmark.tasks
        first = range(benchmark.num_starts[split])[:n_episodes]
        return [Chain(c % len(tasks), _from(tasks, c % len(tasks)), c) for c in first]
    groups = benchmark.groups(suite, split)
    if suite == SEQUENTIAL:
        groups = groups[:orderings]
    return [Chain(group.number, group.tasks, c) for group in groups for c in group.configurations[:n_episodes]]


def _from(tasks: Sequence[Any], first: int) -> tuple[Any, ...]:
    """The tasks of a stream: the cycle from task number `first`."""
    return tuple(islice(cycle(tasks), first, first + STREAM_TASKS))


def rules_of(suite: str, window: int, advance: str, end_effector_reset: bool) -> Rules:
    """The rules of a suite's chains; a stream continues whatever happens, window by window."""
    if suite == STREAM:
        return Rules(window, end_effector_reset=end_effector_reset, stops=False)
    return Rules(window, advance, end_effector_reset)


def sampling_seed(seed: int, suite: str, split: str) -> tuple[int, int, int]:
    """What the action sampling of a suite and split is seeded with, see `ChainRunner.run`."""
    return seed, SUITES.index(suite), SPLITS.index(split)


class Start(StrEnum):
    """How a task's object and receptacle lay when it was given; the first that applies."""

    COMPLETE = "complete"
    """The task was complete."""
    FALLEN = "fallen"
    """One of them fell off the table, or the receptacle lies on its edge."""
    OUT_OF_REACH = "out_of_reach"
    """One of them lies where the end effector cannot go, or outside the camera's picture."""
    ON_OTHER_RECEPTACLE = "on_other_receptacle"
    """The object lies on a receptacle that is not the task's."""
    RECEPTACLE_OCCUPIED = "receptacle_occupied"
    """The object lies on the table, but another one is on the task's receptacle."""
    FREE = "free"
    """The object lies on the table and the receptacle is free, as after a scene reset."""


def classify_starts(env: Any, ids: np.ndarray) -> list[Start]:
    """Say how the bodies of the current tasks of streams `ids` (k,) of a CRONOS scene lie."""
    tasks, bodies = env.scene.tasks, env.scene.bodies
    complete, unsuitable = env.find_complete(tasks), find_unsuitable(env.simulation)
    starts = []
    for i in ids:
        own = env.current_tasks[i]
        meant = [bodies.index(body) for body in (own.object, own.receptacle)]
        done = [task for task, is_done in zip(tasks, complete[i], strict=True) if is_done]
        if own in done:
            starts.append(Start.COMPLETE)
        elif unsuitable[Unsuitable.FALLEN][i, meant].any():
            starts.append(Start.FALLEN)
        elif any(where[i, meant].any() for where in unsuitable.values()):
            starts.append(Start.OUT_OF_REACH)
        elif any(task.object == own.object for task in done):
            starts.append(Start.ON_OTHER_RECEPTACLE)
        elif any(task.receptacle == own.receptacle for task in done):
            starts.append(Start.RECEPTACLE_OCCUPIED)
        else:
            starts.append(Start.FREE)
    return starts
