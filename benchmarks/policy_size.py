"""What acting and learning cost with SmolVLA, pi0 and pi0.5 at their real sizes, counted without running them.

    python benchmarks/policy_size.py

PyTorch counts operations and bytes on tensors without memory, so any machine can count any size. Hours are the
operations over `--peak_tflops` times `--utilisation`: an H100's dense TF32 is 495. Nothing is downloaded. The
environment is in none of the numbers.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
import torch.fx.experimental._config as fx_config
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_policy_config
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import OBS_IMAGES, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch.utils.flop_counter import FlopCounterMode

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
STATE, ACTIONS, IMAGE, WORDS, PLAYED = 13, 7, 256, 48, 10
SMOLVLM2_TEXT = {
    "model_type": "llama", "hidden_size": 960, "intermediate_size": 2560, "num_attention_heads": 15,
    "head_dim": 64, "num_key_value_heads": 5, "num_hidden_layers": 32, "vocab_size": 49280, "pad_token_id": 2,
}  # fmt: skip
SMOLVLM2_VISION = {
    "hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12,
    "image_size": 512, "patch_size": 16,
}  # fmt: skip
"""SmolVLM2-500M; SmolVLA keeps 16 of the 32 layers."""


def make_adapter(kind: str, options: dict[str, Any], noise_steps: int | None) -> Any:
    """Return a policy of real size without memory, and what makes it trainable."""
    features = {
        OBS_STATE: PolicyFeature(FeatureType.STATE, (STATE,)),
        f"{OBS_IMAGES}.front": PolicyFeature(FeatureType.VISUAL, (3, IMAGE, IMAGE)),
    }
    config: Any = make_policy_config(
        kind, input_features=features, output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
        n_action_steps=PLAYED, device="cpu", push_to_hub=False, **options,
    )  # fmt: skip
    config.device = "meta"  # none that LeRobot's config lets through
    with torch.device("meta"), _smolvlm2():
        policy = get_policy_class(kind)(config)
    return make_trainable(policy.eval(), AdapterOptions(noise_steps=noise_steps))


def make_batch() -> dict[str, Any]:
    """Return one preprocessed observation."""
    with torch.device("meta"):
        return {
            OBS_STATE: torch.zeros(1, STATE),
            f"{OBS_IMAGES}.front": torch.zeros(1, 3, IMAGE, IMAGE),
            OBS_LANGUAGE_TOKENS: torch.zeros(1, WORDS, dtype=torch.long),
            OBS_LANGUAGE_ATTENTION_MASK: torch.ones(1, WORDS, dtype=torch.bool),
            "task": ["put it there"],
        }


def count(kind: str, options: dict[str, Any], noise_steps: int | None) -> dict[str, int]:
    """Count what one decision costs: parameters, operations, bytes. See CASES for the arguments."""
    with _counting():
        adapter, batch = make_adapter(kind, options, noise_steps), make_batch()
        traces: list[torch.Tensor] = []
        with torch.no_grad():
            act = _operations(lambda: traces.append(adapter.sample_actions(batch)["trace"]))
            value = _operations(lambda: adapter.predict_values(batch))
        params = [*adapter.policy.parameters()]
        own = {param.untyped_storage()._cdata for param in params}
        kept: dict[int, int] = {}

        def keep(tensor: torch.Tensor) -> torch.Tensor:
            storage = tensor.untyped_storage()
            if storage._cdata not in own:
                kept[storage._cdata] = storage.nbytes()
            return tensor

        def learn() -> None:
            evaluated = adapter.evaluate_actions(batch, traces[0])
            (evaluated["log_prob"].mean() + evaluated["value"].mean()).backward()

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            update = _operations(learn)
    trained = [param for group in adapter.rl_parameter_groups() for param in group["params"]]
    return {
        "parameters": sum(param.numel() for param in params),
        "trained": sum(param.numel() for param in trained),
        "act": act,
        "value": value,
        "update": update,
        "weight_bytes": sum(param.nbytes for param in params),
        # Gradients and AdamW's two moments.
        "state_bytes": 3 * sum(param.nbytes for param in trained),
        "activation_bytes": sum(kept.values()),
    }


def estimate(cost: dict[str, int], args: argparse.Namespace) -> dict[str, float]:
    """What the operations and bytes of a decision come to on the assumed GPU."""
    speed = args.peak_tflops * 1e12 * args.utilisation
    # The value's own pass reads what the critic needs once.
    seconds = (cost["act"] + args.epochs * cost["update"] + cost["value"]) / speed
    fixed = cost["weight_bytes"] + cost["state_bytes"]
    return {
        "steps_per_s": round(PLAYED / seconds, 1),
        f"hours_for_{args.steps}_steps": round(args.steps / PLAYED * seconds / 3600, 2),
        "fixed_gb": round(fixed / 1e9, 2),
        "largest_minibatch": max(0, int((args.memory_gb * 1e9 - fixed) / cost["activation_bytes"])),
    }


def _operations(work: Callable[[], Any]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


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
    """Print a line of JSON for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--steps", type=int, default=307_200, help="interaction steps of a run")
    parser.add_argument("--epochs", type=int, default=3, help="passes of PPO over them")
    parser.add_argument("--peak_tflops", type=float, default=495.0, help="of the GPU: an H100's, dense TF32")
    parser.add_argument("--utilisation", type=float, default=0.3, help="share of it that is reached")
    parser.add_argument("--memory_gb", type=float, default=80.0, help="of the GPU")
    args = parser.parse_args()
    for name in args.cases:
        cost = count(*CASES[name])
        print(json.dumps({"case": name} | cost | {"estimate": estimate(cost, args)}), flush=True)


if __name__ == "__main__":
    main()
