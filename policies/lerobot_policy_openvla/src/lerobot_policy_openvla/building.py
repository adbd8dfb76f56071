"""Puts a policy's network together: checkpoint, adapters, quantisation."""

from __future__ import annotations

from typing import Any

import torch

from lerobot_policy_openvla.adapters import add_lora, linear_names, load_adapter
from lerobot_policy_openvla.architecture import Architecture
from lerobot_policy_openvla.checkpoint import read_checkpoint
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.network import OpenVLANetwork
from lerobot_policy_openvla.network_loading import load_network
from lerobot_policy_openvla.prompt import PromptTokenizer
from lerobot_policy_openvla.quantization import quantize


def resolve_dtype(config: OpenVLAConfig) -> torch.dtype:
    """Return the format that `config.dtype` means on `config.device`."""
    if config.dtype == "auto":
        return torch.bfloat16 if torch.device(config.device or "cpu").type == "cuda" else torch.float32
    return getattr(torch, config.dtype)


def build(config: OpenVLAConfig) -> tuple[OpenVLANetwork, PromptTokenizer]:
    """Return the network and the tokenizer as `config` asks for them.

    Raises:
        ValueError: the config names no checkpoint.
    """
    if config.checkpoint is None:
        raise ValueError("choose the weights to build on: --policy.checkpoint=openvla/openvla-7b")
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
