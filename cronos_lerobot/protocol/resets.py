"""Reset strategies: which streams are reset at a task switch, how, and what it counts as."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import BEFORE_SEGMENTS, Intervention
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.run_context import RunContext
from cronos_lerobot.registry import Registry


class ResetStrategy(ABC):
    """One kind of intervention: which streams need it now, and how it is applied to them.

    What it has to remember of a stream is in `LoopState`. What it keeps besides that and its generator it tells in
    `state_dict`, or a resumed run continues without it.
    """

    kind: Intervention
    """What it is counted and recorded as; `COUNTED_INTERVENTIONS` are those that spend the budget."""

    @abstractmethod
    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Return the ids, a rising (k,) int array, of the streams to intervene on now."""

    @abstractmethod
    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Intervene on the streams `ids`."""

    def bind(self, run: RunContext) -> None:
        """Told once, before the run begins or resumes, what it is made of. A ValueError refuses the run."""
        return

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint has to hold of it: nested dicts and lists of numbers, strings and NumPy arrays."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`, if that was not empty; called after `bind`."""
        return

    def apply_if_due(self, env: Any, loop: LoopState) -> bool:
        """Intervene where it is due and count it; returns whether any stream was touched."""
        ids = np.asarray(self.due(env, loop))
        if ids.size == 0:
            return False
        is_rising = ids.ndim == 1 and ids.dtype.kind in "iu" and (np.diff(ids) > 0).all()
        if not is_rising or ids[0] < 0 or ids[-1] >= loop.num_streams:
            raise ValueError(f"{type(self).__name__}.due must return rising ids of streams, got {ids!r}.")
        self.apply(env, ids)
        loop.count_intervention(ids, self.kind)
        return True


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
    """Bodies that no task can reach any more are put back at a free place, the others stay (HSR).

    A body is, if its centre is outside the workspace or the camera's picture, or if it fell. It is one event for
    each stream, however many bodies are put back.

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
                env.put_back(int(stream), int(body), self.rng)


class SceneReset(ResetStrategy):
    """Bodies go to a random training configuration and the arm goes home. The base of all scene resets.

    Args:
        rng: draws the configuration of the train split, one for each stream.
        num_configurations: draws from the first N of the split only; None from all.
    """

    kind = Intervention.SCENE_RESET

    def __init__(self, rng: np.random.Generator, num_configurations: int | None = None) -> None:
        self.rng = rng
        self.num_configurations = num_configurations

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Place the streams `ids` in configurations of the training split."""
        available = self.num_configurations or env.num_starts["train"]
        env.scene_reset(ids, self.rng.integers(available, size=len(ids)))


class PeriodicSceneReset(SceneReset):
    """Every stream is reset every T steps (paper, Section 5), where T may follow a curriculum.

    Staggered, stream i of N is reset i/N of T, in whole segments, before the multiples of T. Of the streams that
    are reset at the same moment each then has another task of the heuristic order.

    A stream that an extra strategy has reset at the same switch is not reset and counted again.
    """

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
        streams, segments = np.arange(loop.num_streams), interval // self.segment
        phase = streams * segments // loop.num_streams if self.is_staggered else 0 * streams
        is_due = (loop.t // self.segment + phase) % segments == 0
        return np.flatnonzero(is_due & (loop.preceded_by != Intervention.SCENE_RESET))


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

    @property
    def all(self) -> tuple[ResetStrategy, ...]:
        """Every one of them."""
        first = (self.initial, self.divergence, self.end_effector, self.heuristic)
        return (*first, *self.extra, self.scene)

    def bind(self, run: RunContext) -> None:
        """Tell every strategy what the run is made of; a ValueError refuses the run."""
        for strategy in self.all:
            strategy.bind(run)


ResetFactory = Callable[[np.random.Generator, ProtocolConfig], ResetStrategy]
EXTRA_RESETS: Registry[ResetFactory] = Registry(
    "--protocol.extra_resets", "cronos_lerobot.protocol.register_reset"
)
"""Strategies of users by name."""
register_reset = EXTRA_RESETS.register
"""Decorates a class whose constructor, or a function that, takes a generator of its own and the protocol."""
EXTRA_KINDS = tuple(kind for kind in BEFORE_SEGMENTS if kind is not Intervention.INITIAL)
"""What they may be counted as: a first placement, which is free, is the run's own."""


def make_resets(protocol: ProtocolConfig, rng: Callable[[str], np.random.Generator]) -> Resets:
    """Return the strategies that `protocol` enables.

    Args:
        protocol: of the run.
        rng: returns the generator of a name. Each strategy draws from one of its own, so that none changes what
            another one draws.

    Raises:
        ValueError: an extra reset is not registered, or does not say what it is counted as.
    """
    extra = []
    for name in protocol.extra_resets:
        EXTRA_RESETS.check(name)
        extra.append(EXTRA_RESETS[name](rng(f"resets/extra/{name}"), protocol))
        if (kind := getattr(extra[-1], "kind", None)) not in EXTRA_KINDS:
            raise ValueError(
                f"--protocol.extra_resets={name}: {type(extra[-1]).__name__}.kind must be one of "
                f"{[kind.name for kind in EXTRA_KINDS]}, got {kind!r}."
            )
    return Resets(
        initial=InitialPlacement(rng("resets/initial"), protocol.num_configurations),
        divergence=DivergenceReset(rng("resets/divergence"), protocol.num_configurations),
        end_effector=EndEffectorReset() if protocol.end_effector_reset else NoReset(),
        heuristic=HeuristicReset(rng("resets/heuristic")) if protocol.heuristic_reset else NoReset(),
        extra=tuple(extra),
        scene=PeriodicSceneReset(rng("resets/scene"), protocol),
    )
