"""One tiny checkpoint for all tests, and a tiny data set."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from openvla_samples import CAMERA, TASKS
from published_checkpoint import BRIDGE, Parts, make_parts, write_checkpoint


@pytest.fixture(scope="session")
def parts() -> Parts:
    return make_parts()


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory, parts: Parts) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("openvla") / "published", parts)


@pytest.fixture(scope="session")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of random frames; the action of each is always the same."""
    root = tmp_path_factory.mktemp("openvla") / "data"
    features = {
        CAMERA: {"dtype": "image", "shape": (48, 40, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (13,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    dataset = LeRobotDataset.create("local/openvla", fps=5, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for task, side in zip(TASKS, ("q01", "q99"), strict=True):
        for _ in range(6):
            dataset.add_frame(
                {
                    CAMERA: rng.integers(0, 256, (48, 40, 3), dtype=np.uint8),
                    "observation.state": np.zeros(13, np.float32),
                    "action": np.array(BRIDGE[side], np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root
