"""What every reset strategy is: who is helped at a task switch, how, and what it counts as."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.task_values import RunContext


class ResetStrategy(ABC):
    """One kind of intervention: which streams need it now, and how it is applied to them.

    What it has to remember of a stream is in `LoopState`; what it keeps besides that and its generator it tells in
    `state_dict`, or a resumed run goes on without it.
    """

    kind: Intervention
    """What it is counted and recorded as; `protocol.COUNTED_INTERVENTIONS` are those that spend the budget."""

    def bind(self, run: RunContext) -> None:
        """Told once, before the run begins or goes on, what it is made of. A ValueError refuses the run."""
        return

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint has to hold of it: dicts and lists of numbers, strings and NumPy arrays."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, if that was not empty; called after `bind`."""
        return

    @abstractmethod
    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Return the ids, a (k,) int array, of the streams to intervene on now."""

    @abstractmethod
    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Intervene on the streams `ids`."""

    def apply_if_due(self, env: Any, loop: LoopState) -> bool:
        """Intervene where it is due and count it; returns whether any stream was touched."""
        ids = self._checked(self.due(env, loop), loop.num_streams)
        if len(ids) == 0:
            return False
        self.apply(env, ids)
        self.count(loop, ids)
        return True

    def _checked(self, due: Any, num_streams: int) -> np.ndarray:
        ids = np.asarray(due)
        if not ids.size:
            return ids
        is_sorted = ids.ndim == 1 and np.issubdtype(ids.dtype, np.integer) and (np.diff(ids) > 0).all()
        if not is_sorted or ids[0] < 0 or ids[-1] >= num_streams:
            raise ValueError(
                f"{type(self).__name__}.due must return numbers of streams from 0 to {num_streams - 1}, each once "
                f"and in order, got {due!r}"
            )
        return ids

    def count(self, loop: LoopState, ids: np.ndarray) -> None:
        """Count one event for each stream of `ids`."""
        loop.count_intervention(ids, self.kind)
