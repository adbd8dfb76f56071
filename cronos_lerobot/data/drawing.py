"""Pictures that are drawn when they are written: a stream keeps the state of each step, the writer's thread draws.

A frame of 640 x 480 takes software rendering milliseconds, which the training loop should not wait for, and its
pixels take some thousand times the memory of the state.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LateCamera:
    """A camera whose pictures are drawn from states.

    Args:
        height: of a picture [px].
        width: of a picture [px].
        num_positions: generalised positions (MuJoCo's nq) of a state.
        draw: from states float64 (1, nq) to pictures uint8 (1, height, width, 3); called in another thread.
    """

    height: int
    width: int
    num_positions: int
    draw: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class UndrawnFrames:
    """The pictures of one segment, of which only the states are there: float64 (T, nq)."""

    camera: LateCamera
    positions: np.ndarray

    dtype = np.dtype(np.uint8)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the pictures."""
        return len(self), self.camera.height, self.camera.width, 3

    @property
    def nbytes(self) -> int:
        """Of the pictures: what stands in a queue counts as the work that it is."""
        return int(np.prod(self.shape))

    def draw(self, out: np.ndarray) -> np.ndarray:
        """Draw into the beginning of `out` (at least T, height, width, 3) and return that part of it.

        One at a time, because whoever draws for the training loop meanwhile waits for it.
        """
        for i in range(len(self)):
            out[i] = self.camera.draw(self.positions[i : i + 1])[0]
        return out[: len(self)]
