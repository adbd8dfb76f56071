"""Reset strategies: who is helped at a task switch, how, and what it counts as."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cronos_lerobot.data.schema import Intervention
from cronos_lerobot.loop_state import LoopState
from cronos_lerobot.protocol import ProtocolConfig

NUM_TRAIN_CONFIGURATIONS = 64
"""Benchmark configurations of the training split (paper, Section 5)."""


class ResetStrategy(ABC):
    """One kind of intervention: which streams need it now, and how it is applied to them."""

    kind: Intervention

    @abstractmethod
    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Return the ids, a (k,) int array, of the streams to intervene on now."""

    @abstractmethod
    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Intervene on the streams `ids`."""

    def apply_if_due(self, env: Any, loop: LoopState) -> bool:
        """Intervene where it is due and count it; returns whether any stream was touched."""
        ids = self.due(env, loop)
        if len(ids) == 0:
            return False
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


class SceneReset(ResetStrategy):
    """Bodies go back to a random training configuration and the arm goes home. The base of two strategies.

    Args:
        rng: draws the configuration, 0..63 of the train split, one for each stream.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Place the streams `ids` in configurations of the training split."""
        env.scene_reset(ids, self.rng.integers(NUM_TRAIN_CONFIGURATIONS, size=len(ids)))


class PeriodicSceneReset(SceneReset):
    """Every stream is reset every T steps (paper, Section 5), where T may follow a curriculum."""

    kind = Intervention.SCENE_RESET

    def __init__(self, rng: np.random.Generator, interval_at: Callable[[int], int | None]) -> None:
        super().__init__(rng)
        self.interval_at = interval_at

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Every stream when its step count is a multiple of the T in force."""
        interval = self.interval_at(loop.n)
        due_now = interval is not None and loop.t % interval == 0
        return np.arange(loop.num_streams if due_now else 0)


class InitialPlacement(SceneReset):
    """The very first placement of every stream. Free."""

    kind = Intervention.INITIAL

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Every stream of a run that has not begun; none of a resumed one."""
        return np.arange(loop.num_streams if loop.t == 0 else 0)


class DivergenceReset(SceneReset):
    """A simulation that broke down is put back at once, wherever it is in its segment (not in the paper)."""

    kind = Intervention.DIVERGENCE

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self.diverged: np.ndarray = np.empty(0, np.bool_)

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Streams marked in the last step's info["diverged"]."""
        return np.flatnonzero(self.diverged)

    def put_back(self, env: Any, loop: LoopState, diverged: np.ndarray) -> bool:
        """Reset the streams where `diverged`, (N,) bool; returns whether there was any."""
        self.diverged = diverged
        return self.apply_if_due(env, loop)


@dataclass(frozen=True)
class Resets:
    """The strategies of one run, in the order of Algorithm 1."""

    initial: ResetStrategy
    divergence: DivergenceReset
    end_effector: ResetStrategy
    heuristic: ResetStrategy
    scene: ResetStrategy


ResetFactory = Callable[[ProtocolConfig, np.random.Generator], ResetStrategy]

RESET_STRATEGIES: dict[str, ResetFactory] = {
    "none": lambda protocol, rng: NoReset(),
    "end_effector": lambda protocol, rng: EndEffectorReset(),
    "scene": lambda protocol, rng: PeriodicSceneReset(rng, protocol.scene_reset_interval_at),
}
"""Strategies by name; a new one is registered here."""


def make_resets(protocol: ProtocolConfig, rng: np.random.Generator) -> Resets:
    """Return the strategies that `protocol` enables; `rng` draws every configuration of the run."""
    end_effector = "end_effector" if protocol.end_effector_reset else "none"
    return Resets(
        initial=InitialPlacement(rng),
        divergence=DivergenceReset(rng),
        end_effector=RESET_STRATEGIES[end_effector](protocol, rng),
        heuristic=RESET_STRATEGIES["none"](protocol, rng),
        scene=RESET_STRATEGIES["scene"](protocol, rng),
    )
