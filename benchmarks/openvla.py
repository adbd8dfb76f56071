"""Time and memory of OpenVLA's acting and learning, with random weights of the published size.

    python benchmarks/openvla.py                                        # on one GPU with 40 GB or more
    python benchmarks/openvla.py --layers=4 --streams=2 --minibatch_size=2    # on a CPU

The environment is not part of it. Times are per interaction step.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any

import torch
from accelerate.utils import set_module_tensor_to_device
from lerobot.configs import FeatureType, PolicyFeature
from lerobot_policy_openvla.architecture import HALF, IMAGENET_MEAN, IMAGENET_STD, Architecture
from lerobot_policy_openvla.building import finish_network, resolve_dtype
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_policy_openvla.network import empty_network

CAMERA = "observation.images.front"
ACTION_TOKENS = 7
PROMPT = (1, *range(3, 28))
"""Tokens of an instruction, without the image."""


def make_policy(args: argparse.Namespace) -> OpenVLAPolicy:
    """Return a policy of random weights, the same few numbers again and again, made where they are to be."""
    architecture = Architecture(
        timm_model_ids=("vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"),
        act_layers=(None, None),
        image_size=224,
        image_means=(IMAGENET_MEAN, HALF),
        image_stds=(IMAGENET_STD, HALF),
        text_config={"vocab_size": 32064, "pad_token_id": 32000, "num_hidden_layers": args.layers},
        n_action_bins=256,
        pad_to_multiple_of=64,
    )
    config = OpenVLAConfig(
        device=args.device,
        dtype="bfloat16",
        lora_rank=32,
        lora_modules=["projector", "language"] if args.frozen_vision else ["vision", "projector", "language"],
        inference_batch_size=args.inference_batch_size,
        gradient_checkpointing=args.gradient_checkpointing,
        architecture=architecture.to_dict(),
        unnorm_key="none",
        action_statistics={"key": "none", "q01": [-1.0] * 7, "q99": [1.0] * 7, "mask": [True] * 7},
        input_features={CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 224, 224))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION_TOKENS,))},
    )
    network, dtype = empty_network(architecture, config.attention), resolve_dtype(config)
    numbers = 0.02 * torch.randn(4_000_037, device=args.device)
    for name, parameter in list(network.named_parameters()):
        value = torch.ones(parameter.shape, dtype=dtype, device=args.device)
        if parameter.ndim > 1 or not name.endswith("weight"):
            for piece in value.view(-1).split(len(numbers)):
                piece.copy_(numbers[: len(piece)])
        set_module_tensor_to_device(network, name, args.device, value, dtype=dtype)
    network.to(args.device).eval()
    finish_network(network, config)
    return OpenVLAPolicy(config, parts=(network, lambda _: PROMPT)).eval()


def observe(count: int, device: str) -> dict[str, Any]:
    """Return a batch of random observations."""
    images = torch.randint(0, 256, (count, 3, 224, 224), dtype=torch.uint8, device=device)
    return {CAMERA: images, "task": ["put the ketchup bottle on the yellow plate"] * count}


def seconds(work: Callable[[], Any], device: str, least: float) -> float:
    """Return the mean time of a call, repeated for `least` seconds after one that is not timed."""
    on_gpu = device.startswith("cuda")
    work()
    start, calls = time.perf_counter(), 0
    while not calls or time.perf_counter() - start < least:
        work()
        if on_gpu:
            torch.cuda.synchronize()
        calls += 1
    return (time.perf_counter() - start) / calls


def peak_gib(device: str) -> float:
    """Return the most memory so far, of the GPU or of the process."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layers", type=int, default=32, help="of Llama; the time is linear in them")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--streams", type=int, default=64)
    parser.add_argument("--inference_batch_size", type=int, default=32)
    parser.add_argument("--minibatch_size", type=int, default=8)
    parser.add_argument("--frozen_vision", action="store_true", help="no adapters on the vision towers")
    parser.add_argument("--gradient_checkpointing", action="store_true")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement")
    args = parser.parse_args()
    policy = make_policy(args)
    print(f"weights                 {peak_gib(args.device):6.1f} GiB")
    batch = observe(args.streams, args.device)
    with torch.inference_mode():
        act = seconds(lambda: policy.sample_actions(batch), args.device, args.seconds) / args.streams
    print(f"acting    {1e3 * act:9.1f} ms {peak_gib(args.device):6.1f} GiB")
    minibatch = observe(args.minibatch_size, args.device)
    tokens = torch.full((args.minibatch_size, ACTION_TOKENS), 31900, device=args.device)

    def learn() -> None:
        result = policy.evaluate_actions(minibatch, tokens)
        (result["log_prob"].mean() + result["value"].mean()).backward()

    update = seconds(learn, args.device, args.seconds) / args.minibatch_size
    print(f"learning  {1e3 * update:9.1f} ms {peak_gib(args.device):6.1f} GiB")
    print(f"together  {1 / (act + update):9.2f} steps/s")


if __name__ == "__main__":
    main()
