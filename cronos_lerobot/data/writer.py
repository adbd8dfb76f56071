"""Writes whole segments straight into a LeRobotDataset (v3), fast, and loadable after every flush.

`StreamRecorder` (recorder.py), the observer that a training loop calls once per step, sits on top of this.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from cronos_lerobot.data.schema import Features


class SegmentWriter:
    """Appends segments (arrays in memory) to a LeRobotDataset, one episode each."""

    features: Features
    """The features given, without LeRobot's own bookkeeping columns."""

    def __init__(self, repo_id: str, root: str | Path, features: Features, fps: int, **options: Any) -> None:
        """Start a new dataset in `root`, which must not exist."""
        raise NotImplementedError

    @classmethod
    def resume(cls, repo_id: str, root: str | Path, state: Mapping[str, Any], **options: Any) -> Self:
        """Go on with the dataset in `root` as it was at `state`; what was written after it is dropped."""
        raise NotImplementedError

    def add_segment(
        self,
        frames: Mapping[str, np.ndarray],
        task: str,
        *,
        episode_metadata: Mapping[str, Any] | None = None,
    ) -> int:
        """Queue one segment; returns its episode index. Blocks while the encoder is behind."""
        raise NotImplementedError

    def flush(self) -> None:
        """Write everything queued; the dataset on disk then loads in LeRobotDataset."""
        raise NotImplementedError

    def state_dict(self) -> dict[str, Any]:
        """What `resume` needs, as of the last flush."""
        raise NotImplementedError

    def finalize(self) -> None:
        """Flush, stop the encoder thread, and accept no more segments. Idempotent."""
        raise NotImplementedError
