"""What an action may ask of a robot."""

from __future__ import annotations

import math

import numpy as np

from cronos_lerobot.robot.setups import Setup


class Safety:
    """Keeps actions within the limits, the steps and the box.

    Args:
        setup: has the limits and the box.
        max_step: the furthest that a target moves in one control step, in the action's units; None for any.
    """

    def __init__(self, setup: Setup, max_step: float | None) -> None:
        self._setup, self._max_step = setup, max_step
        self.limited = 0
        """Control steps in which an action was changed."""

    def steps_for(self, distance: float) -> int:
        """Control steps that a target needs for a distance, in the action's units."""
        return 1 if self._max_step is None else math.ceil(distance / self._max_step)

    def limit(self, action: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Return the action (A,) that is allowed after the target `last` (A,): out of the box it is `last`."""
        setup = self._setup
        allowed = np.clip(action, setup.low, setup.high)
        if self._max_step is not None:
            allowed = np.clip(allowed, last - self._max_step, last + self._max_step)
        if setup.box is not None and setup.hand is not None:
            hand = setup.hand(allowed)
            if (hand < setup.box[0]).any() or (hand > setup.box[1]).any():
                allowed = last
        allowed = allowed.astype(np.float32)
        self.limited += not np.allclose(allowed, action, atol=1e-4)
        return allowed
