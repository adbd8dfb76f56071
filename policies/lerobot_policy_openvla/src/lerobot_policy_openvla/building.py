"""Puts a policy's network together: checkpoint, adapters, quantisation."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from torch import nn

from lerobot_policy_openvla.adapters import add_lora, linear_names, load_adapter
from lerobot_policy_openvla.architecture import Architecture
from lerobot_policy_openvla.checkpoint import read_checkpoint
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.network import OpenVLANetwork, load_network
from lerobot_policy_openvla.prompt import PromptTokenizer


def resolve_dtype(config: OpenVLAConfig) -> torch.dtype:
    """Return the format that `config.dtype` means on `config.device`."""
    if config.dtype == "auto":
        return torch.bfloat16 if torch.device(config.device or "cpu").type == "cuda" else torch.float32
    return getattr(torch, config.dtype)


def build(config: OpenVLAConfig) -> tuple[OpenVLANetwork, PromptTokenizer]:
    """Return the network and the tokenizer as `config` asks for them."""
    assert config.checkpoint is not None
    checkpoint = read_checkpoint(config.checkpoint, config.checkpoint_revision)
    device = config.device or "cpu"
    # What is to be quantised waits in ordinary memory: a GPU that needs it may not hold it as it is.
    staging = device if config.quantization == "none" else "cpu"
    network = load_network(checkpoint, config.attention, resolve_dtype(config), staging)
    finish_network(network, config)
    return network, PromptTokenizer(checkpoint.folder, network.bos_token_id)


def finish_network(network: OpenVLANetwork, config: OpenVLAConfig) -> None:
    """Do to a network what `config` asks for: merge, quantise, adapt, checkpoint gradients."""
    if config.adapter and config.merge_adapter:
        load_adapter(network, config.adapter, merge=True)
        if not config.lora_rank and config.quantization == "none":
            # The weights are the policy's own from now on, which are saved and loaded as they are.
            config.adapter, config.merge_adapter = None, False
    if config.quantization != "none":
        quantize(network, config.quantization, config.device or "cpu")
        network.requires_grad_(False)
    _add_adapters(network, config)
    if config.gradient_checkpointing:
        network.enable_gradient_checkpointing()


def _add_adapters(network: OpenVLANetwork, config: OpenVLAConfig) -> None:
    if config.adapter and not config.merge_adapter:
        lora = load_adapter(network, config.adapter, merge=False)
        # From now on the adapter is the policy's own, which is saved and loaded with it.
        config.lora_rank, config.lora_alpha, config.lora_dropout = lora.r, lora.lora_alpha, lora.lora_dropout
        config.lora_targets, config.adapter = sorted(lora.target_modules or []), None
    elif config.lora_rank:
        targets = config.lora_targets or linear_names(network, config.lora_modules)
        add_lora(network, config.lora_rank, config.lora_scale_numerator, config.lora_dropout, targets)


def architecture_of(config: OpenVLAConfig) -> Architecture:
    """Return the architecture of a config that is resolved."""
    fields: dict[str, Any] | None = config.architecture
    assert fields is not None
    return Architecture.from_dict(fields)


def quantize(network: OpenVLANetwork, kind: str, device: str | torch.device) -> None:
    """Replace the linear layers of Llama's blocks, which are most of the network, by frozen quantised ones.

    Args:
        network: on any device; it ends on `device`.
        kind: `int8` (LLM.int8) or `nf4` (QLoRA's 4-bit format).
        device: where the layers are quantised.

    Raises:
        ImportError: bitsandbytes is not installed.
    """
    library = import_module("bitsandbytes")
    blocks = network.language_model.model.layers
    for name, layer in [(n, m) for n, m in blocks.named_modules() if isinstance(m, nn.Linear)]:
        blocks.set_submodule(name, _quantized(library, layer, kind).to(device))
    network.to(device)


def _quantized(library: Any, layer: nn.Linear, kind: str) -> nn.Module:
    sizes: tuple[int, int] = (layer.in_features, layer.out_features)
    weight, dtype = layer.weight.detach(), layer.weight.dtype
    if kind == "int8":
        with torch.device("meta"):
            new = library.nn.Linear8bitLt(*sizes, bias=False, has_fp16_weights=False)
        new.weight = library.nn.Int8Params(weight, requires_grad=False, has_fp16_weights=False)
    else:
        with torch.device("meta"):
            new = library.nn.Linear4bit(*sizes, bias=False, compute_dtype=dtype, quant_type="nf4")
        new.weight = library.nn.Params4bit(weight, requires_grad=False, quant_type="nf4")
    return new
