"""Shared pieces of the PocketVLA tests: small configurations, batches, and a tiny data set on disk."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot_policy_pocketvla import PocketVLAConfig, PocketVLAPolicy

CAMERA = "observation.images.front"
TASKS = ("put the ketchup bottle on the yellow plate", "put the kitchen shovel on the cloth")


def make_config(image: bool = True, size: int = 64, action_dim: int = 7, **kwargs) -> PocketVLAConfig:
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (13,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (48,)),
    }
    if image:
        inputs[CAMERA] = PolicyFeature(FeatureType.VISUAL, (3, size, size))
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (action_dim,))}
    return PocketVLAConfig(input_features=inputs, output_features=outputs, device="cpu", **kwargs)


def make_policy(seed: int = 0, **kwargs) -> PocketVLAPolicy:
    """Build a policy whose outputs depend on its inputs: the fresh heads and modulations are nearly zero."""
    torch.manual_seed(seed)
    policy = PocketVLAPolicy(make_config(**kwargs)).eval()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return policy


def make_batch(n: int, seed: int = 0, size: int = 64) -> dict:
    rng = torch.Generator().manual_seed(seed)
    return {
        CAMERA: torch.randint(0, 256, (n, 3, size, size), dtype=torch.uint8, generator=rng),
        "observation.state": torch.randn(n, 13, generator=rng),
        "observation.environment_state": torch.randn(n, 48, generator=rng),
        "task": [TASKS[i % 2] for i in range(n)],
    }


def take(batch: dict, rows: list[int]) -> dict:
    return {key: [v[i] for i in rows] if isinstance(v, list) else v[rows] for key, v in batch.items()}


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
