"""The decisions of a run, to learn from again and again."""

from __future__ import annotations

from typing import Any

import numpy as np

HALF_LIMIT = np.finfo(np.float16).max
KINDS = {
    "features": np.float16,
    "choice": np.float16,
    "reward": np.float32,
    "discount": np.float32,
    "next_features": np.float16,
}
"""What is kept of a decision: features (F,) and what was chosen (d,), in half precision; the rewards until its
end; the factor of what follows, 0 if nothing does; the features that follow (F,)."""


class ReplayMemory:
    """The newest decisions, drawn from uniformly.

    Args:
        capacity: decisions; the oldest go while there are more.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._rows: dict[str, np.ndarray] = {}
        self._size, self._end = 0, 0

    def __len__(self) -> int:
        """Decisions."""
        return self._size

    def add(self, **columns: np.ndarray) -> None:
        """Keep k decisions: KINDS, each (k, ...)."""
        rows = np.arange(self._end, self._end + len(columns["reward"])) % self.capacity
        self._reserve(min(self.capacity, self._end + len(rows)), columns)
        for name, kind in KINDS.items():
            column = columns[name]
            if kind == np.float16:
                column = column.clip(-HALF_LIMIT, HALF_LIMIT)
            self._rows[name][rows] = column
        self._end = (self._end + len(rows)) % self.capacity
        self._size = min(self._size + len(rows), self.capacity)

    def draw(self, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return `count` uniform draws, KINDS as float32."""
        rows = (self._oldest + rng.integers(self._size, size=count)) % self.capacity
        return {name: column[rows].astype(np.float32) for name, column in self._rows.items()}

    def moments(self) -> np.ndarray:
        """Means of the features and of their squares, (2, F) float64."""
        features = self.state_dict()["features"].astype(np.float64)
        return np.stack([features.mean(0), (features**2).mean(0)])

    def state_dict(self) -> dict[str, Any]:
        """KINDS, oldest first; nothing of an empty memory."""
        rows = (self._oldest + np.arange(self._size)) % self.capacity
        return {name: column[rows] for name, column in self._rows.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`. A draw counts from the oldest, so that the same numbers draw the same."""
        self._rows, self._size, self._end = {}, 0, 0
        if state:
            self.add(**{name: column[-self.capacity :] for name, column in state.items()})

    @property
    def _oldest(self) -> int:
        return self._end if self._size == self.capacity else 0

    def _reserve(self, size: int, columns: dict[str, np.ndarray]) -> None:
        """Make room for `size` rows, twice what there was if it grows."""
        have = len(self._rows["reward"]) if self._rows else 0
        if size <= have:
            return
        size = min(self.capacity, max(size, 2 * have))
        for name, kind in KINDS.items():
            grown = np.zeros((size, *columns[name].shape[1:]), kind)
            if have:
                grown[:have] = self._rows[name]
            self._rows[name] = grown
