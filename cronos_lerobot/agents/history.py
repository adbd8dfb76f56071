"""What streams have seen lately, for policies that look back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from lerobot.utils.constants import OBS_IMAGES

from cronos_lerobot.agents.base import Columns


class ObservationHistory:
    """The last observations of every stream, its own; streams are numbered by whoever asks.

    Where a stream has not seen so many since it began, the first one is repeated, as LeRobot's policies do.

    Args:
        length: H, how many observations a policy looks at; with 1 columns stay as they are.
    """

    def __init__(self, length: int = 1) -> None:
        self.length = length
        self._past: dict[int, Columns] = {}

    def begin(self, ids: Iterable[int]) -> None:
        """What streams `ids` see from now on has nothing to do with what they saw before."""
        for i in ids:
            self._past.pop(int(i), None)

    def see(self, columns: Columns, ids: Sequence[int]) -> Columns:
        """Remember the observations (k, ...) of streams `ids` (k,); returns `followed_by` them."""
        seen = self.followed_by(columns, ids)
        if self.length > 1:
            for row, i in enumerate(ids):
                self._past[int(i)] = {name: col[row] for name, col in seen.items()}
        return seen

    def followed_by(self, columns: Columns, ids: Sequence[int]) -> Columns:
        """What streams `ids` have seen once they see these observations (k, ...): (k, H, ...), oldest first."""
        if self.length == 1:
            return columns
        return {
            name: np.stack([self._row(name, col[row], int(i)) for row, i in enumerate(ids)])
            for name, col in columns.items()
        }

    def _row(self, name: str, newest: np.ndarray, i: int) -> np.ndarray:
        if i not in self._past:
            return np.repeat(newest[None], self.length, axis=0)
        return np.concatenate([self._past[i][name][1:], newest[None]])


def observation_steps(policy: Any) -> int:
    """How many observations a TrainablePolicy looks at."""
    return int(getattr(policy, "observation_steps", 1))


def blank_columns(policy: Any) -> Columns:
    """One observation in which there is nothing: zeros (1, ...) for all that `policy` reads."""
    columns: Columns = {}
    history = (steps,) if (steps := observation_steps(policy)) > 1 else ()
    for name, feature in (policy.config.input_features or {}).items():
        shape, kind = feature.shape, np.float32
        if name.startswith(OBS_IMAGES):
            shape, kind = (*shape[1:], shape[0]), np.uint8
        columns[name] = np.zeros((1, *history, *shape), kind)
    return columns
