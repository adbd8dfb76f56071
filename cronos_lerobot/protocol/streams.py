"""What Algorithm 1 needs of a world. The protocols are structural: nobody inherits from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np


class Task(Protocol):
    """What a stream is told to do."""

    instruction: str


class Streams(Protocol):
    """N scenes that live on. They never reset themselves, and say neither terminated nor truncated.

    Observations have LeRobot's raw names: `pixels`, a dict of uint8 (N, H, W, 3) by camera, and `agent_pos` and
    `environment_state`, float32 (N, d).
    """

    num_envs: int

    def set_task(self, ids: Iterable[int], tasks: Sequence[Any]) -> None:
        """Give the streams `ids` their tasks."""
        ...

    def observe(self) -> dict[str, Any]:
        """Return the observation now."""
        ...

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (N, A) in physical units for one control step.

        Returns:
            Observation, reward (N,), two arrays (N,) of False, and info: `is_success` and `diverged`, (N,) bool.
            If known, also `is_grasped` (N,) bool, `executed_action` (N, A) float32, and `intervened` (N,) bool: a
            person or a script acted.
        """
        ...

    def scene_reset(self, ids: np.ndarray, configurations: np.ndarray, split: str = "train") -> None:
        """Put every body of the streams `ids` at configurations (k,) of a split, and the arm home."""
        ...
