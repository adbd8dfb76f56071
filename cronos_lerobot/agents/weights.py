"""A policy's weights in its folder; of one that PEFT wraps only the adapters, beside LeRobot's config."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs.default import PeftConfig
from safetensors.torch import load_model

ADAPTER_FILE = "adapter_model.safetensors"
"""PEFT's name of what it saves."""
MIXED = ("smolvla",)
"""Types of policies whose layers turn what they read into the format of their own weights."""


def is_wrapped(policy: Any) -> bool:
    """Whether PEFT wraps the policy: it has adapters in its layers, and only they are trained."""
    return hasattr(policy, "peft_config")


def unwrapped(policy: Any) -> Any:
    """The LeRobot policy inside PEFT's wrapper, or the policy itself."""
    return policy.get_base_model() if is_wrapped(policy) else policy


def wrap(policy: Any, config: PeftConfig | None) -> Any:
    """Return a policy with PEFT's adapters, as `lerobot-train --peft.*` makes them; one that has them keeps them.

    Raises:
        ImportError: PEFT is not installed.
        ValueError: the policy is from scratch, or does not say which layers get adapters.
    """
    if config is None or is_wrapped(policy):
        return policy
    wrapped = policy.wrap_with_peft(policy._build_peft_config(vars(config).copy()))
    for adapters in wrapped.peft_config.values():
        # Of the Hub's policy that they go onto, which LeRobot's own wrapping leaves out.
        adapters.revision = policy.config.pretrained_revision
    return wrapped


def train_in_float32(policy: Any, path: str | Path | None = None, revision: str | None = None) -> None:
    """Give what is trained of a policy float32, where the other layers bear it: SmolVLA's is made in bfloat16.

    What its network is built around is frozen, and stays as it is.

    Args:
        policy: just loaded.
        path: where it was loaded from, a folder or a repository, whose weights LeRobot has rounded, but for those
            of adapters.
        revision: of the repository.
    """
    if policy.config.type not in MIXED:
        return
    rounded = [param for param in policy.parameters() if param.requires_grad and param.dtype.itemsize < 4]
    for param in rounded:
        param.data = param.data.float()
    if rounded and path and not is_wrapped(policy):
        file = Path(path) / SAFETENSORS_SINGLE_FILE
        if not file.is_file():
            file = Path(hf_hub_download(str(path), SAFETENSORS_SINGLE_FILE, revision=revision))
        load_model(policy, str(file), strict=False)


def check_precision(params: Iterable[torch.Tensor], config: Any, algorithm: str) -> None:
    """Check that the weights that are trained can hold the small steps of fine-tuning, and of an average.

    Raises:
        ValueError: some have fewer bits than float32.
    """
    if coarse := sorted({str(param.dtype) for param in params if param.dtype.itemsize < 4}):
        how = " (--policy.dtype=float32)" if hasattr(config, "dtype") else ""
        raise ValueError(
            f"--algorithm.type={algorithm} would learn next to nothing: {', '.join(coarse)} cannot hold the"
            f" small steps of the weights that are trained. Load them in float32{how}, or train adapters"
            " (--peft.method_type=LORA)."
        )


def save_policy(policy: Any, folder: Path) -> None:
    """Write what LeRobot's `make_policy` loads."""
    policy.save_pretrained(folder)
    if is_wrapped(policy):
        # PEFT writes its own config only.
        policy.config.save_pretrained(folder)


def weights_file(policy: Any, folder: Path) -> Path:
    """Where `save_policy` writes the weights."""
    return folder / (ADAPTER_FILE if is_wrapped(policy) else SAFETENSORS_SINGLE_FILE)


def load_weights(policy: Any, folder: Path) -> None:
    """Give a policy the weights that `save_policy` wrote."""
    if not is_wrapped(policy):
        load_model(policy, str(weights_file(policy, folder)))
        return
    from peft import load_peft_weights, set_peft_model_state_dict

    device = str(next(policy.parameters()).device)
    set_peft_model_state_dict(policy, load_peft_weights(str(folder), device=device))
