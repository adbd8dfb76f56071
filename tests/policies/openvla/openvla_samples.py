"""Shared pieces of the OpenVLA tests: policies and batches."""

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot_policy_openvla import OpenVLAConfig, OpenVLAPolicy
from lerobot_policy_openvla.images import prepare_images
from published_checkpoint import reference_logits

CAMERA = "observation.images.front"
TASKS = ("put the ketchup bottle on the yellow plate", "put the kitchen shovel on the cloth please")
INPUTS = {
    CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 48, 40)),
    "observation.state": PolicyFeature(FeatureType.STATE, (13,)),
}
OUTPUTS = {"action": PolicyFeature(FeatureType.ACTION, (7,))}


def make_config(checkpoint, **kwargs) -> OpenVLAConfig:
    fields = {"unnorm_key": "bridge_orig", "input_features": INPUTS, "output_features": OUTPUTS, "device": "cpu"}
    return OpenVLAConfig(checkpoint=str(checkpoint), **fields | kwargs)


def make_policy(checkpoint, *, stir: bool = True, **kwargs) -> OpenVLAPolicy:
    """A policy whose adapters and value head do something: fresh ones do nothing."""
    torch.manual_seed(0)
    policy = OpenVLAPolicy(make_config(checkpoint, **kwargs)).eval()
    if stir:
        with torch.no_grad():
            for name, parameter in policy.named_parameters():
                if ".lora_" in name or "value_head" in name:
                    parameter.add_(0.1 * torch.randn_like(parameter))
    return policy


def make_batch(n: int, seed: int = 0) -> dict:
    """Images and instructions of different lengths."""
    rng = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (n, 3, 48, 40), dtype=torch.uint8, generator=rng)
    return {CAMERA: images, "observation.state": torch.zeros(n, 13), "task": [TASKS[i % 2] for i in range(n)]}


def take(batch: dict, rows: list[int]) -> dict:
    return {key: [v[i] for i in rows] if isinstance(v, list) else v[rows] for key, v in batch.items()}


def log_probs_and_values(policy, seed: int = 2) -> torch.Tensor:
    """Of the tokens 400 .. 413 for two observations, (2, 2)."""
    batch = make_batch(2, seed)
    tokens = torch.arange(400, 414).reshape(2, 7)
    with torch.no_grad():
        result = policy.eval().evaluate_actions(batch, tokens)
    return torch.stack([result["log_prob"], result["value"]])


def reference_of(policy, parts, batch: dict, tokens: torch.Tensor) -> torch.Tensor:
    """Logits (B, 7, V) one observation at a time, with the published modules."""
    pixels = prepare_images(batch[CAMERA], policy.architecture, crop=False)
    prompts = [list(policy.prompt_tokenizer(text)) for text in batch["task"]]
    rows = zip(pixels, prompts, tokens.tolist(), strict=True)
    return torch.stack([reference_logits(parts, x, prompt, row[:-1]) for x, prompt, row in rows])
