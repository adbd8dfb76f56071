"""A tiny data set on disk."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from pocketvla_samples import CAMERA, TASKS


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of random frames with every feature that CRONOS data has."""
    root = tmp_path_factory.mktemp("pocketvla") / "data"
    features = {
        CAMERA: {"dtype": "image", "shape": (128, 128, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (13,), "names": None},
        "observation.environment_state": {"dtype": "float32", "shape": (48,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    dataset = LeRobotDataset.create("local/pocketvla", fps=5, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for task in TASKS:
        for _ in range(6):
            dataset.add_frame(
                {
                    CAMERA: rng.integers(0, 256, (128, 128, 3), dtype=np.uint8),
                    "observation.state": rng.normal(size=13).astype(np.float32),
                    "observation.environment_state": rng.normal(size=48).astype(np.float32),
                    "action": rng.uniform(-0.02, 0.02, 7).astype(np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root
