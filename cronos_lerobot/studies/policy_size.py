"""What acting and learning cost with SmolVLA, pi0 and pi0.5 at their real sizes, on random weights.

    python -m cronos_lerobot.studies.policy_size [--measure smolvla] [--batch_size 1] [--device cpu]

Arithmetic is counted by PyTorch on tensors without memory, so that policies of any size are counted anywhere;
`--measure` runs one. An estimate for a GPU is the operations over --peak_tflops times --utilisation, both assumed:
an H100's dense TF32 is 495, which float32 weights take with `torch.backends.cuda.matmul.allow_tf32`, and 67
without (`lerobot-train` turns it on, `cronos-train` does not). Weights and optimizer are float32, as LeRobot makes
them. Nothing is downloaded. The environment is not in any of the numbers.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
import torch.fx.experimental._config as fx_config
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import OBS_IMAGES, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from cronos_lerobot.agents.adapters import builtin as _builtin  # noqa: F401 -- registers them
from cronos_lerobot.agents.adapters.registry import AdapterOptions, make_trainable

EXPERT_ONLY = {"train_expert_only": True, "freeze_vision_encoder": True}
CASES: dict[str, tuple[str, dict[str, Any], int | None]] = {
    "smolvla": ("smolvla", {}, None),
    "smolvla, noise at 1 step": ("smolvla", {}, 1),
    "pi0": ("pi0", {}, None),
    "pi0, expert only": ("pi0", EXPERT_ONLY, None),
    "pi0, expert only, noise at 1 step": ("pi0", EXPERT_ONLY, 1),
    "pi05, expert only": ("pi05", EXPERT_ONLY, None),
}
"""Policy type, options of its config, `--algorithm.noise_steps`."""
STATE, ACTIONS, IMAGE = 13, 7, 256
SMOLVLM2_TEXT = {
    "model_type": "llama", "hidden_size": 960, "intermediate_size": 2560, "num_attention_heads": 15,
    "head_dim": 64, "num_key_value_heads": 5, "num_hidden_layers": 32, "vocab_size": 49280, "pad_token_id": 2,
}  # fmt: skip
SMOLVLM2_VISION = {
    "hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12,
    "image_size": 512, "patch_size": 16,
}  # fmt: skip
"""SmolVLM2-500M: 507 million parameters; SmolVLA keeps 16 of the 32 layers."""


@dataclass(frozen=True)
class Cost:
    """Of one decision, in a batch of one."""

    parameters: int
    used: int
    """Parameters that actions depend on: without heads that predict words."""
    trained: int
    act: int
    """Floating-point operations of drawing a decision."""
    value: int
    """The same of the critic's value alone."""
    update: int
    """The same of one pass of PPO, forwards and backwards."""
    weight_bytes: int
    state_bytes: int
    """Gradients and AdamW's two moments."""
    activation_bytes: int
    """What a pass keeps for its way back."""


def make_adapter(kind: str, options: dict[str, Any], noise_steps: int | None, device: str, played: int) -> Any:
    """Return a policy of real size with random weights, and what makes it trainable."""
    features = {
        OBS_STATE: PolicyFeature(FeatureType.STATE, (STATE,)),
        f"{OBS_IMAGES}.front": PolicyFeature(FeatureType.VISUAL, (3, IMAGE, IMAGE)),
    }
    config: Any = make_policy_config(
        kind, input_features=features, output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
        n_action_steps=played, device="cpu", push_to_hub=False, **options,
    )  # fmt: skip
    config.device = device  # "meta" is none that LeRobot's config lets through
    with torch.device(device), _smolvlm2():
        policy = get_policy_class(kind)(config)
    return make_trainable(policy.to(device).eval(), AdapterOptions(noise_steps=noise_steps))


def make_batch(size: int, words: int, device: str) -> dict[str, Any]:
    """Return preprocessed observations of one camera."""
    return {
        OBS_STATE: torch.zeros(size, STATE, device=device),
        f"{OBS_IMAGES}.front": torch.zeros(size, 3, IMAGE, IMAGE, device=device),
        OBS_LANGUAGE_TOKENS: torch.zeros(size, words, dtype=torch.long, device=device),
        OBS_LANGUAGE_ATTENTION_MASK: torch.ones(size, words, dtype=torch.bool, device=device),
        "task": ["put it there"] * size,
    }


def count(kind: str, options: dict[str, Any], noise_steps: int | None, words: int = 48, played: int = 10) -> Cost:
    """Count what one decision costs; see CASES for the arguments."""
    with _counting():
        adapter = make_adapter(kind, options, noise_steps, "meta", played)
        batch = make_batch(1, words, "meta")
        traces: list[Tensor] = []
        with torch.no_grad():
            act = _operations(lambda: traces.append(adapter.sample_actions(batch)["trace"]))
            value = _operations(lambda: adapter.predict_values(batch))
        params = [*adapter.policy.named_parameters()]
        kept: dict[int, int] = {}
        own = {param.untyped_storage()._cdata for _, param in params}

        def keep(tensor: Tensor) -> Tensor:
            storage = tensor.untyped_storage()
            if storage._cdata not in own:
                kept[storage._cdata] = storage.nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            update = _operations(lambda: _objective(adapter, batch, traces[0]).backward())
    trained = [param for group in adapter.rl_parameter_groups() for param in group["params"]]
    return Cost(
        parameters=sum(param.numel() for _, param in params),
        used=sum(param.numel() for name, param in params if "lm_head" not in name),
        trained=sum(param.numel() for param in trained),
        act=act,
        value=value,
        update=update,
        weight_bytes=sum(param.nbytes for _, param in params),
        state_bytes=3 * sum(param.nbytes for param in trained),
        activation_bytes=sum(kept.values()),
    )


def estimate(cost: Cost, args: argparse.Namespace) -> dict[str, Any]:
    """What the operations and bytes of a decision come to on the assumed GPU."""
    speed = args.peak_tflops * 1e12 * args.utilisation
    decisions = args.steps / args.played
    # The value's own pass reads what the critic needs once.
    operations = cost.act + args.epochs * cost.update + cost.value
    free = args.memory_gb * 1e9 - cost.weight_bytes - cost.state_bytes
    return {
        "act_ms": round(1e3 * cost.act / speed, 2),
        "update_ms": round(1e3 * cost.update / speed, 2),
        "steps_per_s": round(args.played / (operations / speed), 1),
        f"hours_for_{args.steps}_steps": round(decisions * operations / speed / 3600, 2),
        "fixed_gb": round((cost.weight_bytes + cost.state_bytes) / 1e9, 2),
        "activation_mb_per_decision": round(cost.activation_bytes / 1e6, 1),
        "largest_minibatch": max(0, int(free / cost.activation_bytes)),
    }


def measure(case: str, args: argparse.Namespace) -> dict[str, Any]:
    """Time acting and an optimizer step on this machine, on the mean of `--repeat` after one that is not timed."""
    device, size = args.device, args.batch_size
    adapter = make_adapter(*CASES[case], device, args.played)
    batch = make_batch(size, args.words, device)
    memory = {"built_gb": _peak_gb(device)}
    with torch.inference_mode():
        trace = adapter.sample_actions(batch)["trace"]
        act = _seconds(lambda: adapter.sample_actions(batch), args.repeat, device)
    trace, memory["acting_gb"] = trace.clone(), _peak_gb(device)
    params = [param for group in adapter.rl_parameter_groups() for param in group["params"]]
    optimizer = torch.optim.AdamW(params, lr=1e-6)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        _objective(adapter, batch, trace).backward()
        optimizer.step()

    update()
    learn = _seconds(update, args.repeat, device)
    memory["learning_gb"] = _peak_gb(device)
    speeds = {"act_steps_per_s": size * args.played / act, "update_steps_per_s": size * args.played / learn}
    return {
        "device": device, "threads": torch.get_num_threads(), "batch_size": size,
        "act_s": round(act, 2), "update_s": round(learn, 2),
        **{name: round(value, 2) for name, value in (speeds | memory).items()},
    }  # fmt: skip


def _objective(adapter: Any, batch: dict[str, Any], trace: Tensor) -> Tensor:
    evaluated = adapter.evaluate_actions(batch, trace)
    return evaluated["log_prob"].mean() + evaluated["value"].mean()


def _operations(work: Callable[[], Any]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def _seconds(work: Callable[[], Any], repeat: int, device: str) -> float:
    start = time.perf_counter()
    for _ in range(repeat):
        work()
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    return (time.perf_counter() - start) / repeat


def _peak_gb(device: str) -> float:
    """The most memory so far: of the process, or on the GPU."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


@contextmanager
def _smolvlm2() -> Generator[None]:
    """Inside, SmolVLA finds SmolVLM2-500M's sizes, and a tokenizer's two numbers, without the Hub."""
    from lerobot.policies.smolvla import smolvlm_with_expert as module
    from transformers import SmolVLMConfig

    make_config: Any = SmolVLMConfig
    config = make_config(
        image_token_id=49190, scale_factor=4, pad_token_id=2, tie_word_embeddings=False,
        vision_config=SMOLVLM2_VISION, text_config=SMOLVLM2_TEXT | {"tie_word_embeddings": False},
    )  # fmt: skip
    tokenizer = SimpleNamespace(fake_image_token_id=49189, global_image_token_id=49152)
    found = {"AutoConfig": config, "AutoProcessor": SimpleNamespace(tokenizer=tokenizer)}
    with ExitStack() as stack:
        for name, value in found.items():
            source = SimpleNamespace(from_pretrained=lambda _, value=value: value)
            stack.enter_context(patch.object(module, name, source))
        yield


@contextmanager
def _counting() -> Generator[None]:
    """Inside, tensors without memory pass the two places that look at numbers: images have no empty patches."""
    from transformers import masking_utils

    with (
        patch.object(fx_config, "meta_nonzero_assume_all_nonzero", True),
        patch.object(masking_utils, "_ignore_bidirectional_mask_sdpa", lambda *_, **__: True),
    ):
        yield


def main() -> None:
    """Count, measure, and print a line of JSON for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES), help="what is counted")
    parser.add_argument("--measure", nargs="*", default=[], choices=list(CASES), help="what is run here")
    parser.add_argument("--device", default="cpu", help="where it is run")
    parser.add_argument("--batch_size", type=int, default=1, help="decisions at once, where it is run")
    parser.add_argument("--repeat", type=int, default=2, help="calls that are timed")
    parser.add_argument("--words", type=int, default=48, help="tokens of an instruction, with padding")
    parser.add_argument("--played", type=int, default=10, help="actions of a decision that are played")
    parser.add_argument("--steps", type=int, default=307_200, help="interaction steps of a run")
    parser.add_argument("--epochs", type=int, default=3, help="passes of PPO over them")
    parser.add_argument("--peak_tflops", type=float, default=495.0, help="of the GPU: an H100's, dense TF32")
    parser.add_argument("--utilisation", type=float, default=0.3, help="share of it that is reached")
    parser.add_argument("--memory_gb", type=float, default=80.0, help="of the GPU")
    args = parser.parse_args()
    for name in args.cases:
        cost = count(*CASES[name], words=args.words, played=args.played)
        print(json.dumps({"case": name} | asdict(cost) | {"estimate": estimate(cost, args)}), flush=True)
    for name in args.measure:
        print(json.dumps({"measured": name} | measure(name, args)), flush=True)


if __name__ == "__main__":
    main()
