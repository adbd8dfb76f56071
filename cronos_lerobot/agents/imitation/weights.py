"""How often the frames of a remembered segment are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cronos_lerobot.agents.imitation.memory import Segment


def by_task(segments: Sequence[Segment], lengths: np.ndarray) -> np.ndarray:
    """Weights of the segments' frames, (segments,), with which every instruction is drawn as often.

    Args:
        segments: of them.
        lengths: frames of each that can be drawn.
    """
    _, tasks = np.unique([segment.instruction for segment in segments], return_inverse=True)
    return 1.0 / np.bincount(tasks, weights=lengths)[tasks]
