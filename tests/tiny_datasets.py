"""Datasets of a few frames in LeRobot's own format."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset


def write_dataset(root: Path, episodes: Sequence[tuple[str, dict[str, np.ndarray]]]) -> Path:
    """Write episodes, each a task and columns (T, ...), with pictures (T, H, W, 3) as they are; returns `root`."""

    def feature(column):
        if column.ndim == 4:
            return {"dtype": "image", "shape": column.shape[1:], "names": ["height", "width", "channels"]}
        return {"dtype": "float32", "shape": column.shape[1:] or (1,), "names": None}

    features = {name: feature(column) for name, column in episodes[0][1].items()}
    dataset = LeRobotDataset.create("me/tiny", fps=5, features=features, root=root, use_videos=False)
    for task, columns in episodes:
        for row in zip(*columns.values(), strict=True):
            frame = {name: np.atleast_1d(value) for name, value in zip(columns, row, strict=True)}
            dataset.add_frame(frame | {"task": task})
        dataset.save_episode()
    dataset.finalize()
    return root
