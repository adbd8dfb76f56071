"""Memory and speed of OpenVLA's acting and learning with random weights, and what an H100 could do at best.

    python -m lerobot_policy_openvla.benchmark --size=7b               # on one GPU with 40 GB or more
    python -m lerobot_policy_openvla.benchmark --size=7b --layers=4 --streams=2 --minibatch_size=2    # on a CPU
    python -m lerobot_policy_openvla.benchmark --size=7b --formulas    # only counts

It prints the rates of the rollout and of the update, where their time goes, what each of four measures is worth
(measured with and without it), the operations and bytes by formula, and the hours for 1.3 million steps: as
measured, and as the bound of an H100. The environment is not part of it.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from accelerate.utils import set_module_tensor_to_device
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_openvla.architecture import HALF, IMAGENET_MEAN, IMAGENET_STD, Architecture
from lerobot_policy_openvla.arithmetic import parameter_bytes, rollout_bytes, update_bytes, work_of
from lerobot_policy_openvla.benchmark_report import report, report_of_formulas
from lerobot_policy_openvla.building import finish_network, resolve_dtype
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_policy_openvla.network import OpenVLANetwork
from lerobot_policy_openvla.network_loading import empty_network
from lerobot_policy_openvla.sequence import score_actions

H100_FLOPS, H100_BYTES = 989e12, 3.35e12
"""Of the SXM version, per second: bfloat16 without sparsity, and memory (NVIDIA's data sheet)."""
CAMERA = "observation.images.front"
ACTION_TOKENS = 7
SIZES: dict[str, dict[str, Any]] = {
    "7b": {},
    "1b": {"hidden_size": 2048, "intermediate_size": 5504, "num_hidden_layers": 12, "num_attention_heads": 16},
    "tiny": {"hidden_size": 128, "intermediate_size": 256, "num_hidden_layers": 4, "num_attention_heads": 4},
}
"""Llama's sizes; the vision towers are the published ones but for `tiny`."""


class FixedPrompt:
    """Stands for the tokenizer: a prompt of a given length, whatever the instruction."""

    def __init__(self, length: int) -> None:
        self._ids = (1, *range(3, length + 2))

    def __call__(self, instruction: str) -> tuple[int, ...]:
        """Return the tokens."""
        return self._ids


def architecture_of_size(size: str, layers: int | None = None) -> Architecture:
    """Return the published architecture, or it with another Llama or with another number of Llama's layers."""
    towers = ("vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224")
    tiny = size == "tiny"
    text_config = {"vocab_size": 32064, "pad_token_id": 32000} | SIZES[size]
    if layers is not None:
        text_config["num_hidden_layers"] = layers
    return Architecture(
        timm_model_ids=("test_vit2", "test_vit3") if tiny else towers,
        act_layers=(None, None),
        image_size=64 if tiny else 224,
        image_means=(IMAGENET_MEAN, HALF),
        image_stds=(IMAGENET_STD, HALF),
        text_config=text_config,
        n_action_bins=256,
        pad_to_multiple_of=64,
    )


def random_network(architecture: Architecture, config: OpenVLAConfig) -> OpenVLANetwork:
    """Return a network of small random weights, the same few again and again, made where they are to be."""
    network = empty_network(architecture, config.attention)
    device, dtype = config.device or "cpu", resolve_dtype(config)
    numbers = 0.02 * torch.randn(4_000_037, device=device)
    for name, parameter in list(network.named_parameters()):
        value = torch.ones(parameter.shape, dtype=dtype, device=device)
        if parameter.ndim > 1 or not name.endswith("weight"):
            for piece in value.view(-1).split(len(numbers)):
                piece.copy_(numbers[: len(piece)])
        set_module_tensor_to_device(network, name, device, value, dtype=dtype)
    return network.to(device).eval()


def policy_config(args: argparse.Namespace) -> OpenVLAConfig:
    """Return the configuration that the command line asks for."""
    return OpenVLAConfig(
        device=args.device,
        dtype=args.dtype,
        lora_rank=args.lora_rank,
        lora_modules=["projector", "language"] if args.frozen_vision else ["vision", "projector", "language"],
        inference_batch_size=args.inference_batch_size,
        gradient_checkpointing=args.gradient_checkpointing,
        attention=args.attention,
        quantization=args.quantization,
        architecture=architecture_of_size(args.size, args.layers).to_dict(),
        unnorm_key="none",
        action_statistics={"key": "none", "q01": [-1.0] * ACTION_TOKENS, "q99": [1.0] * 7, "mask": [True] * 7},
        input_features={CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 224, 224))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION_TOKENS,))},
    )


def random_policy(args: argparse.Namespace) -> OpenVLAPolicy:
    """Return a policy of random weights."""
    config = policy_config(args)
    network = random_network(architecture_of_size(args.size, args.layers), config)
    finish_network(network, config)
    return OpenVLAPolicy(config, parts=(network, FixedPrompt(args.prompt_tokens))).eval()


class Clock:
    """Times calls on a device, each repeated for some seconds after one that is not counted; 0: a single call."""

    def __init__(self, device: str, seconds: float) -> None:
        self._cuda = torch.device(device).type == "cuda"
        self._seconds = seconds

    def __call__(self, function: Callable[[], Any]) -> float:
        """Return the mean time of a call [s]; on a CPU, of work: what other processes take does not count."""
        if self._seconds:
            function()
            self._wait()
        start, begun, calls = self._now(), time.perf_counter(), 0
        while not calls or time.perf_counter() - begun < self._seconds:
            function()
            self._wait()
            calls += 1
        return (self._now() - start) / calls

    def _now(self) -> float:
        return time.perf_counter() if self._cuda else time.process_time() / torch.get_num_threads()

    def peak_bytes(self) -> int:
        """Most memory that was in use since the last `restart`; on a CPU, since the process began."""
        if self._cuda:
            return torch.cuda.max_memory_allocated()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

    def restart(self) -> None:
        """Begin to look for the peak anew, where that is possible."""
        if self._cuda:
            torch.cuda.reset_peak_memory_stats()

    def _wait(self) -> None:
        if self._cuda:
            torch.cuda.synchronize()


class Bench:
    """The measurements; times are per observation [s]."""

    def __init__(self, policy: OpenVLAPolicy, args: argparse.Namespace) -> None:
        self.policy, self.args = policy, args
        self.clock = Clock(args.device, args.seconds)
        self.tokens = torch.full(
            (max(args.minibatch_size, args.streams), ACTION_TOKENS), 31900, device=policy.device
        )

    def observe(self, count: int, *, kept: bool = False) -> dict[str, Any]:
        """Return a batch of `count` random observations, if `kept` with the towers' features for the image."""
        shape = (count, 3, 224, 224)
        images = torch.randint(0, 256, shape, dtype=torch.uint8, device=self.policy.device)
        batch = {CAMERA: images, "task": ["put the ketchup bottle on the yellow plate"] * count}
        return dict(self.policy._with_features(batch)) if kept else batch

    def rollout(self) -> dict[str, float]:
        """Acting, and its parts; `decode` is what is left of the whole."""
        streams, policy = self.args.streams, self.policy
        batch = self.observe(streams)
        kept = self.observe(streams, kept=True)
        with torch.inference_mode():
            whole = self.clock(lambda: policy.sample_actions(batch)) / streams
            vision = self.clock(lambda: policy._with_features(batch)) / streams
            prompt = self.clock(lambda: policy.predict_values(kept)) / streams
        return {"whole": whole, "vision": vision, "prompt": prompt, "decode": whole - vision - prompt}

    @torch.no_grad()
    def ratio_error(self) -> float:
        """Mean |log ratio| before the first update: what the network's format leaves of 0 [nats]."""
        batch = self.observe(self.args.streams)
        sample = self.policy.sample_actions(batch)
        again = self.policy.evaluate_actions(batch, sample["trace"])
        return float((again["log_prob"] - sample["log_prob"]).abs().mean())

    def backward(self, batch: dict[str, Any]) -> None:
        """Forward and backward pass of PPO on a batch, with a loss on all that PPO has one on."""
        self.forward(batch).backward()

    def forward(self, batch: dict[str, Any]) -> torch.Tensor:
        """The forward pass of `backward`."""
        result = self.policy.evaluate_actions(batch, self.tokens[: len(batch["task"])])
        return result["log_prob"].mean() + result["value"].mean() + result["entropy"].mean()

    def update(self, minibatch: int, *, kept: bool) -> dict[str, float]:
        """Learning, and its parts; the optimizer's step is shared by the accumulated minibatches."""
        batch = self.observe(minibatch, kept=kept)
        whole = self.clock(lambda: self.backward(batch)) / minibatch
        forward = self.clock(lambda: self.forward(batch)) / minibatch
        groups = self.policy.rl_parameter_groups()
        optimizer = torch.optim.AdamW([p for group in groups for p in group["params"]], lr=0.0)
        step = self.clock(optimizer.step) / (minibatch * self.args.grad_accumulation)
        optimizer.zero_grad(set_to_none=True)
        return {"whole": whole + step, "forward": forward, "backward": whole - forward, "optimizer": step}

    def activation_bytes(self, minibatch: int, *, kept: bool) -> float:
        """Return what a forward pass keeps for the backward pass, for each observation, without the weights."""
        weights = {p.untyped_storage().data_ptr() for p in self.policy.parameters()}
        storages: dict[int, Any] = {}

        def pack(tensor: torch.Tensor) -> torch.Tensor:
            storage = tensor.untyped_storage()
            if storage.data_ptr() not in weights:
                # Held, so that no later tensor gets its address.
                storages[storage.data_ptr()] = storage
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            self.forward(self.observe(minibatch, kept=kept))
        return sum(storage.nbytes() for storage in storages.values()) / minibatch

    def without_cache(self) -> float:
        """Acting that reads the prompt again for each of the seven tokens."""
        count = min(self.args.streams, self.args.inference_batch_size)
        kept = self.observe(count, kept=True)
        policy = self.policy

        def act() -> None:
            prompts, patches = policy._prompts(kept), policy._patches(kept)
            for i in range(1, ACTION_TOKENS + 1):
                score_actions(policy.network, prompts, patches, self.tokens[:count, :i])

        with torch.inference_mode(), policy._precision():
            return self.clock(act) / count

    def one_at_a_time(self) -> float:
        """Acting for each stream by itself."""
        batch = self.observe(1)
        with torch.inference_mode():
            return self.clock(lambda: self.policy.sample_actions(batch))


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Run all measurements."""
    policy = random_policy(args)
    bench = Bench(policy, args)
    bench.clock.restart()
    rollout = bench.rollout()
    memory = {"weights": parameter_bytes(policy), "rollout": bench.clock.peak_bytes()}
    bench.clock.restart()
    update = bench.update(args.minibatch_size, kept=args.frozen_vision)
    memory["update"] = bench.clock.peak_bytes()
    activations = bench.activation_bytes(args.minibatch_size, kept=args.frozen_vision)
    single = bench.update(1, kept=args.frozen_vision)["whole"] if args.minibatch_size > 1 else None
    # What frozen towers save in the update: with adapters on them, what their part of it costs.
    other = bench.update(args.minibatch_size, kept=not args.frozen_vision)["whole"]
    recomputed, kept = (other, update["whole"]) if args.frozen_vision else (update["whole"], other)
    measures = {
        "prompt read once, not once a token": (rollout["vision"] + bench.without_cache(), rollout["whole"]),
        "features of frozen towers kept for the update": (recomputed, kept),
    }
    if args.inference_batch_size > 1:
        together = f"{args.inference_batch_size} streams act at a time, not 1"
        measures[together] = (bench.one_at_a_time(), rollout["whole"])
    if single is not None:
        measures[f"minibatches of {args.minibatch_size}, not 1"] = (single, update["whole"])
    return {
        "settings": vars(args) | {"output": str(args.output or "")},
        "machine": torch.cuda.get_device_name() if args.device.startswith("cuda") else platform.processor(),
        "threads": torch.get_num_threads(),
        "parameters": sum(p.numel() for p in policy.parameters()),
        "trained": sum(p.numel() for p in policy.parameters() if p.requires_grad),
        "memory_bytes": memory,
        "activation_bytes": activations,
        "ratio_error": bench.ratio_error(),
        "rollout_s": rollout,
        "update_s": update,
        "before_after_s": measures,
        "arithmetic": arithmetic(policy.network, args),
    }


def arithmetic(network: OpenVLANetwork, args: argparse.Namespace) -> dict[str, float]:
    """Operations and bytes of one interaction step, by formula, and the time of an H100 at its limits [s]."""
    work = work_of(network, args.prompt_tokens, ACTION_TOKENS)
    recompute = args.gradient_checkpointing
    learn = work.update(vision_trained=not args.frozen_vision, vision_kept=args.frozen_vision, recompute=recompute)
    act_bytes = rollout_bytes(network, args.prompt_tokens, ACTION_TOKENS, args.inference_batch_size)
    learn_bytes = update_bytes(network, args.minibatch_size, args.grad_accumulation, recompute=recompute)
    # Prompt and update are bound by operations, decoding by the bytes of weights and cache.
    return {
        "weight_bytes": parameter_bytes(network),
        "trained": sum(p.numel() for p in network.parameters() if p.requires_grad),
        "vision_flop": work.vision,
        "prompt_flop": work.prompt,
        "decode_flop": work.decode,
        "rollout_flop": work.rollout,
        "update_flop": learn,
        "rollout_bytes": act_bytes,
        "update_bytes": learn_bytes,
        "h100_rollout_s": (work.vision + work.prompt) / H100_FLOPS + act_bytes / H100_BYTES,
        "h100_update_s": max(learn / H100_FLOPS, learn_bytes / H100_BYTES),
    }


def count(args: argparse.Namespace) -> dict[str, Any]:
    """Only the formulas, of a network that takes no memory."""
    config = policy_config(args)
    network = empty_network(architecture_of_size(args.size, args.layers), args.attention).to(resolve_dtype(config))
    finish_network(network, config)
    return arithmetic(network, args)


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cuda = torch.cuda.is_available()
    parser.add_argument("--size", choices=SIZES, default="7b" if cuda else "tiny")
    parser.add_argument("--layers", type=int, help="of Llama, in place of the size's: the time is linear in them")
    parser.add_argument("--device", default="cuda" if cuda else "cpu")
    parser.add_argument("--dtype", choices=["auto", "bfloat16", "float32"], default="bfloat16")
    parser.add_argument("--streams", type=int, default=64)
    parser.add_argument("--inference_batch_size", type=int, default=32)
    parser.add_argument("--minibatch_size", type=int, default=8)
    parser.add_argument("--grad_accumulation", type=int, default=20)
    parser.add_argument("--prompt_tokens", type=int, default=26, help="length of the prompt without the image")
    parser.add_argument("--lora_rank", type=int, default=32)
    parser.add_argument("--frozen_vision", action="store_true", help="no adapters on the vision towers")
    parser.add_argument("--gradient_checkpointing", action="store_true")
    parser.add_argument("--attention", default="sdpa")
    parser.add_argument("--quantization", default="none")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement; 0: one call, cold")
    parser.add_argument("--formulas", action="store_true", help="measure nothing, only count")
    parser.add_argument("--output", type=Path, help="JSON file for the numbers")
    args = parser.parse_args(argv)
    if args.lora_rank < 1:
        parser.error(f"--lora_rank must be at least 1, got {args.lora_rank}")
    return args


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    args = parse_args(argv)
    result = count(args) if args.formulas else measure(args)
    print(report_of_formulas(result) if args.formulas else report(result))
    if args.output:
        args.output.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
