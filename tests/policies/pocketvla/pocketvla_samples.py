"""Shared pieces of the PocketVLA tests: small configurations, policies and batches."""

import torch
from lerobot.configs import FeatureType, PolicyFeature
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
        "observation.joints": torch.rand(n, 7, generator=rng) - 0.5,
        "task": [TASKS[i % 2] for i in range(n)],
    }


def take(batch: dict, rows: list[int]) -> dict:
    return {key: [v[i] for i in rows] if isinstance(v, list) else v[rows] for key, v in batch.items()}
