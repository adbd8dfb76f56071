"""Reset strategies: who is helped at a task switch, how, and what it counts as."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS

from cronos_lerobot.protocol.config import COUNTED_INTERVENTIONS, ProtocolConfig
from cronos_lerobot.protocol.interventions import BEFORE_SEGMENTS, Intervention
from cronos_lerobot.protocol.learnable_starts import LearnableStarts
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.reset_strategy import ResetStrategy
from cronos_lerobot.protocol.task_values import RunContext, TaskValues


class NoReset(ResetStrategy):
    """A strategy that is switched off."""

    kind = Intervention.NONE

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """No stream, ever."""
        return np.empty(0, np.int64)

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Nothing to do: `due` names no stream."""


class EndEffectorReset(ResetStrategy):
    """The arm of every stream goes home, the objects stay (EER). Free."""

    kind = Intervention.END_EFFECTOR_RESET

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Every stream, at every task switch."""
        return np.arange(loop.num_streams)

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Send the arms home."""
        env.end_effector_reset(ids)


class HeuristicReset(ResetStrategy):
    """Bodies that no task can reach any more are put back on the table, the others stay (HSR).

    A body is, if its centre is outside the end effector's workspace or the camera's picture, or if it fell; see
    `lerobot_env_cronos.simulation.workspace`. One event for each stream, however many bodies it had to put back.

    Args:
        rng: draws the free places.
    """

    kind = Intervention.HEURISTIC_RESET

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Streams with an unsuitable body."""
        return np.flatnonzero(env.unsuitable_bodies().any(axis=1))

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Put every unsuitable body of the streams `ids` at a free place."""
        unsuitable = env.unsuitable_bodies()
        for stream in ids:
            for body in np.flatnonzero(unsuitable[stream]):
                env.put_back(int(stream), env.scene.bodies[body], self.rng)


class SceneReset(ResetStrategy):
    """Bodies go back to a random training configuration and the arm goes home. The base of three strategies.

    Args:
        rng: draws the configuration of the train split, one for each stream.
        num_configurations: draws only from the first so many of the split.
    """

    def __init__(self, rng: np.random.Generator, num_configurations: int = NUM_CONFIGURATIONS) -> None:
        self.rng = rng
        self.num_configurations = num_configurations

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Place the streams `ids` in configurations of the training split."""
        env.scene_reset(ids, self.rng.integers(self.num_configurations, size=len(ids)))


class PeriodicSceneReset(SceneReset):
    """Every stream is reset every T steps (paper, Section 5), where T may follow a curriculum.

    Staggered, stream i of N is reset i/N of T, in whole segments, before the multiples of T. Of the streams that
    are reset at the same moment each then goes on with another task of the heuristic order.

    A stream that an extra strategy has reset at the same switch is as it should be, and is not reset and counted
    again.
    """

    kind = Intervention.SCENE_RESET

    def __init__(self, rng: np.random.Generator, protocol: ProtocolConfig) -> None:
        super().__init__(rng, protocol.num_configurations)
        self.interval_at = protocol.scene_reset_interval_at
        self.segment = protocol.task_switch_interval
        self.is_staggered = protocol.reset_phase == "staggered"

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Streams whose step count, ahead by their phase, is a multiple of the T in force."""
        interval = self.interval_at(loop.n)
        if interval is None:
            return np.empty(0, np.int64)
        streams = np.arange(loop.num_streams)
        segments = interval // self.segment
        phase = streams * segments // loop.num_streams if self.is_staggered else 0 * streams
        is_due = (loop.t // self.segment + phase) % segments == 0
        # Not `preceded_by`: it says divergence of a stream that was put back and then reset.
        was_reset = loop.interventions[:, Intervention.SCENE_RESET] > loop.scene_resets_before
        return np.flatnonzero(is_due & ~was_reset)


class CriticSceneReset(SceneReset):
    """Streams in which nothing can be learned any more are reset, as far as a budget goes (not in the paper).

    Of the streams that have failed their last tasks, those come first whose best task has the lowest value, of
    equal ones (a critic that has learned nothing yet) those whose last reset is the longest ago. The budget is
    paced: after a share of the run's steps no more than that share of it is spent. What other kinds of
    interventions cost is taken from it, too. Nothing is reset before a learned reset task, which would then have
    nothing to put back: what may be spent is kept for the next switch.

    Raises:
        ValueError: in `bind`, of an agent without values.
    """

    kind = Intervention.SCENE_RESET

    def __init__(self, rng: np.random.Generator, protocol: ProtocolConfig) -> None:
        super().__init__(rng, protocol.num_configurations)
        assert protocol.reset_budget is not None
        self.budget, self.failures = protocol.reset_budget, protocol.critic.failures
        self._values: TaskValues | None = None

    def bind(self, run: RunContext) -> None:
        """Take the agent's values and the length of the run."""
        self._values, self._total_steps = TaskValues(run, "protocol.scene_reset=critic"), run.total_steps

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Of the streams that are stuck those with the lowest best value, as many as may be spent by now."""
        if loop.num_reset_tasks and loop.switches % 2:
            return np.empty(0, np.int64)
        allowance = math.floor(self.budget * loop.n / self._total_steps - loop.b) if self._is_running(loop) else 0
        stuck = self.find_stuck(loop)
        if allowance < 1 or not len(stuck):
            return np.empty(0, np.int64)
        assert self._values is not None
        best = self._values.best(loop)
        order = np.lexsort((-loop.segments_since_reset[stuck], best[stuck]))
        chosen = np.sort(stuck[order[:allowance]])
        loop.reset_value[chosen] = best[chosen]
        return chosen

    def count(self, loop: LoopState, ids: np.ndarray) -> None:
        """Count them as scene resets, and apart from those of other strategies."""
        super().count(loop, ids)
        loop.asked_resets[ids] += 1

    def find_stuck(self, loop: LoopState) -> np.ndarray:
        """Ids (k,) of the streams that have failed their last tasks, all of them since their scene reset."""
        # Learned reset tasks, every second segment of all streams alike, say nothing.
        is_task = loop.recent_task[0] < loop.num_tasks
        failed = (loop.recent_success[:, is_task][:, -self.failures :] == 0).all(axis=1)
        num_segments = self.failures * (2 if loop.num_reset_tasks else 1)
        return np.flatnonzero(failed & (loop.segments_since_reset >= num_segments))

    def _is_running(self, loop: LoopState) -> bool:
        """After the last segment a reset would be of no use."""
        if self._values is None:
            raise ValueError("protocol.scene_reset=critic works in cronos-train: here no agent tells its values.")
        return loop.n < self._total_steps


class InitialPlacement(SceneReset):
    """The very first placement of every stream. Free."""

    kind = Intervention.INITIAL

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Every stream of a run that has not begun; none of a resumed one."""
        return np.arange(loop.num_streams if loop.t == 0 else 0)


class DivergenceReset(SceneReset):
    """A simulation that broke down is put back at once, wherever it is in its segment (not in the paper)."""

    kind = Intervention.DIVERGENCE

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Streams that the last step broke down."""
        return np.flatnonzero(loop.diverged)


@dataclass(frozen=True)
class Resets:
    """The strategies of one run, in the order of Algorithm 1."""

    initial: ResetStrategy
    divergence: ResetStrategy
    end_effector: ResetStrategy
    heuristic: ResetStrategy
    extra: tuple[ResetStrategy, ...]
    scene: ResetStrategy
    takeover: ResetStrategy = field(default_factory=NoReset)
    """Not in the paper: once the tasks are drawn, who is helped with them."""

    def bind(self, run: RunContext) -> None:
        """Tell every strategy what the run is made of; a ValueError refuses the run."""
        for strategy in self.all:
            strategy.bind(run)

    @property
    def all(self) -> tuple[ResetStrategy, ...]:
        """Every one of them."""
        first = (self.initial, self.divergence, self.end_effector, self.heuristic)
        return (*first, *self.extra, self.scene, self.takeover)


ResetFactory = Callable[[np.random.Generator, ProtocolConfig], ResetStrategy]

EXTRA_RESETS: dict[str, ResetFactory] = {}
"""Strategies of users by name."""
EXTRA_KINDS = tuple(kind for kind in BEFORE_SEGMENTS if kind is not Intervention.INITIAL)
"""What they may be counted as: a first placement, which is free, is the run's own."""


def register_reset(name: str) -> Callable[[ResetFactory], ResetFactory]:
    """Make a strategy selectable as `--protocol.extra_resets='[name]'`.

    It decorates a class whose constructor, or a function that, takes a generator of its own and the protocol.

    Raises:
        ValueError: the name is taken.
    """

    def register(factory: ResetFactory) -> ResetFactory:
        if name in EXTRA_RESETS:
            raise ValueError(f"there is a reset {name!r} already; taken names: {sorted(EXTRA_RESETS)}.")
        EXTRA_RESETS[name] = factory
        return factory

    return register


def check_extra_resets(names: Sequence[str]) -> None:
    """Raise a ValueError that lists the valid names, unless all of `names` are registered."""
    unknown = [name for name in names if name not in EXTRA_RESETS]
    if unknown:
        raise ValueError(
            f"protocol.extra_resets has {unknown}; registered: {sorted(EXTRA_RESETS)}. Register your own "
            "with cronos_lerobot.protocol.resets.register_reset, in a module named by "
            "--protocol.discover_packages_path."
        )


def make_resets(protocol: ProtocolConfig, rng: Callable[[str], np.random.Generator]) -> Resets:
    """Return the strategies that `protocol` enables.

    Args:
        protocol: of the run.
        rng: returns the generator of a name. Each strategy draws from one of its own, so that none changes what
            another one draws.

    Raises:
        ValueError: an extra reset is not registered, or does not say what it is counted as.
    """
    check_extra_resets(protocol.extra_resets)
    extra = tuple(EXTRA_RESETS[name](rng(f"resets/extra/{name}"), protocol) for name in protocol.extra_resets)
    for name, strategy in zip(protocol.extra_resets, extra, strict=True):
        # A scene reset that is counted as something free would be a way around the budget.
        valid = COUNTED_INTERVENTIONS if isinstance(strategy, SceneReset) else EXTRA_KINDS
        if getattr(strategy, "kind", None) not in valid:
            raise ValueError(
                f"{type(strategy).__name__}.kind, of --protocol.extra_resets={name}, must be an Intervention"
                f" before a segment, one of {[kind.name for kind in valid]}, got "
                f"{getattr(strategy, 'kind', None)!r}"
            )
    scene: ResetStrategy = (CriticSceneReset if protocol.scene_reset == "critic" else PeriodicSceneReset)(
        rng("resets/scene"), protocol
    )
    if protocol.reset_starts == "learnable":
        scene = LearnableStarts(scene, rng("resets/starts"), protocol.num_configurations)
    return Resets(
        initial=InitialPlacement(rng("resets/initial"), protocol.num_configurations),
        divergence=DivergenceReset(rng("resets/divergence"), protocol.num_configurations),
        end_effector=EndEffectorReset() if protocol.end_effector_reset else NoReset(),
        heuristic=HeuristicReset(rng("resets/heuristic")) if protocol.heuristic_reset else NoReset(),
        extra=extra,
        scene=scene,
    )
