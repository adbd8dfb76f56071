"""LoRA adapters inside the network, made anew or read from PEFT's format."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from peft import (
    LoraConfig,
    PeftConfig,
    get_peft_model_state_dict,
    inject_adapter_in_model,
    set_peft_model_state_dict,
)
from peft.tuners.tuners_utils import BaseTunerLayer
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_policy_openvla.checkpoint import fetch, timm_name
from lerobot_policy_openvla.network import OpenVLANetwork

ADAPTER = "default"
ADAPTER_CONFIG, ADAPTER_WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
PEFT_PREFIXES = ("base_model.model.", "network.")
"""What PEFT puts before a name, and where LeRobot's policies have the network."""
PARTS = {"vision": "vision_backbone", "projector": "projector", "language": "language_model"}
"""What LoRA may be asked to adapt."""
BASE_LAYER = ".base_layer."
"""In the name of an adapted layer's own weights, which PEFT saves too where that is the output layer."""
VARIANTS = ("use_rslora", "use_dora", "rank_pattern", "alpha_pattern")
"""Settings of LoRA that a policy's config has no place for."""


def linear_names(network: nn.Module, parts: Sequence[str]) -> list[str]:
    """Names of all linear layers in `parts` of the network, the output layer included."""
    prefixes = tuple(f"{PARTS[part]}." for part in parts)
    return [
        name
        for name, module in network.named_modules()
        if isinstance(module, nn.Linear) and name.startswith(prefixes)
    ]


def add_lora(network: OpenVLANetwork, rank: int, alpha: int, dropout: float, targets: Sequence[str]) -> None:
    """Put a fresh adapter on the layers `targets`; it changes nothing yet, and only it is trained."""
    config = LoraConfig(
        r=rank, lora_alpha=alpha, lora_dropout=dropout, target_modules=list(targets), init_lora_weights="gaussian"
    )
    _inject(network, config)


def load_adapter(network: OpenVLANetwork, name: str, *, merge: bool) -> LoraConfig:
    """Put a trained adapter on the network; returns its config, with the names of all layers it adapts.

    Args:
        network: without an adapter.
        name: a folder or a repository on the Hub in PEFT's format, of the published model class or of this policy.
        merge: add it to the weights instead of keeping it apart and trainable.

    Raises:
        ValueError: it is no LoRA adapter, or one of `VARIANTS` that is not to be merged, its tensors are not this
            network's, or it was made on other weights.
    """
    folder = fetch(name)
    config = PeftConfig.from_pretrained(str(folder))
    if not isinstance(config, LoraConfig):
        raise ValueError(f"{name} is an adapter of type {config.peft_type}; only LoRA can be loaded.")
    if not merge and (variants := [field for field in VARIANTS if getattr(config, field)]):
        raise ValueError(
            f"{name} is no plain LoRA ({', '.join(variants)}), and would be loaded as such once it is saved with "
            "the policy: add it to the weights, --policy.merge_adapter=true"
        )
    state = {_network_name(key): value for key, value in load_file(folder / ADAPTER_WEIGHTS).items()}
    _check_base(network, {key: state.pop(key) for key in list(state) if BASE_LAYER in key}, name)
    modules = dict(network.named_modules())
    kept = {key: value for key, value in state.items() if _module_name(key) in modules}
    unknown = sorted(key for key in state.keys() - kept.keys() if not key.startswith("vision_backbone."))
    if unknown or not kept:
        raise ValueError(f"The adapter {name} has tensors that the network has not: {unknown[:5]}.")
    # Exactly the layers that have weights: the network lacks what the towers' last blocks are for.
    config.target_modules = {_module_name(key) for key in kept}
    config.modules_to_save = None
    targets = set(config.target_modules)
    _inject(network, config)
    set_peft_model_state_dict(network, kept, ADAPTER)
    if merge:
        merge_adapters(network)
    config.target_modules = targets
    return config


def save_adapter(network: OpenVLANetwork, folder: Path, base: str | None) -> None:
    """Write the network's adapter to `folder` in PEFT's format, for PEFT or `load_adapter`.

    Fields at their defaults are left out: an older PEFT, such as OpenVLA's, refuses those it does not know.
    """
    folder.mkdir(parents=True, exist_ok=True)
    configs: Any = network.peft_config
    config = configs[ADAPTER]
    defaults = LoraConfig().to_dict()
    fields = {k: v for k, v in config.to_dict().items() if k not in defaults or v != defaults[k]}
    fields.pop("peft_version", None)
    fields |= {"peft_type": config.peft_type, "base_model_name_or_path": base, "inference_mode": True}
    fields |= {"r": config.r, "lora_alpha": config.lora_alpha, "target_modules": sorted(config.target_modules)}
    (folder / ADAPTER_CONFIG).write_text(json.dumps(fields, indent=2, sort_keys=True, default=str))
    state: dict[str, Tensor] = get_peft_model_state_dict(
        network, adapter_name=ADAPTER, save_embedding_layers=False
    )
    tensors = {f"base_model.model.{key}": value.contiguous() for key, value in state.items()}
    save_file(tensors, folder / ADAPTER_WEIGHTS, metadata={"format": "pt"})


def merge_adapters(network: OpenVLANetwork) -> None:
    """Add the adapter to the weights it adapts, and take it away."""
    for name, module in list(network.named_modules()):
        if isinstance(module, BaseTunerLayer):
            module.merge()
            network.set_submodule(name, module.get_base_layer())
    del network.peft_config
    network.requires_grad_(True)


def has_adapter(network: OpenVLANetwork) -> bool:
    """Whether there is an adapter that is not merged."""
    return hasattr(network, "peft_config")


def is_adapter_tensor(name: str) -> bool:
    """Whether a parameter of that name belongs to an adapter."""
    return ".lora_" in name


def _check_base(network: OpenVLANetwork, saved: dict[str, Tensor], name: str) -> None:
    """Compare weights that lie beside an adapter with the network's, in the less precise format of the two.

    Raises:
        ValueError: they are of a layer that the network has not, or differ.
    """
    own = network.state_dict()
    for key, value in saved.items():
        weight = own.get(key.replace(BASE_LAYER, "."))
        if weight is None:
            raise ValueError(f"The adapter {name} has tensors that the network has not: {[key]}.")
        if not (value.is_floating_point() and weight.is_floating_point()):
            continue  # Quantised, each in a way of its own.
        dtype = min(value.dtype, weight.dtype, key=lambda kind: kind.itemsize)
        if not torch.equal(value.to(weight.device, dtype), weight.to(dtype)):
            raise ValueError(
                f"The adapter {name} was made on other weights than these: its {key} is not the network's. "
                "Choose the checkpoint that it was trained on (an adapter that was merged before belongs to it)."
            )


def _inject(network: OpenVLANetwork, config: LoraConfig) -> None:
    network.requires_grad_(False)
    inject_adapter_in_model(config, network, ADAPTER)
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(is_adapter_tensor(name))
    layers: list[Any] = [module for module in network.modules() if isinstance(module, BaseTunerLayer)]
    for module in layers:
        # The adapter is float32 also on a bfloat16 network, or AdamW's steps would be lost in rounding. Its
        # products run in the activations' format, by autocast, instead of in its own.
        module.cast_input_dtype_enabled = False
        for tensor in (p for n, p in module.named_parameters() if is_adapter_tensor(f".{n}")):
            tensor.data = tensor.data.to(torch.float32)


def _network_name(key: str) -> str:
    for prefix in PEFT_PREFIXES:
        key = key.removeprefix(prefix)
    return timm_name(key)


def _module_name(key: str) -> str:
    return key.split(".lora_")[0]
