"""Floating-point operations and bytes of an OpenVLA's acting and learning, by formula.

A product of (n x a) with (a x b) counts 2 n a b operations. Attention is counted whole, as if it were not causal,
and over all places of the cache. Norms, activations and softmaxes are left out: they are less than 1 %.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from torch import nn
from transformers import LlamaConfig

from lerobot_policy_openvla.network import OpenVLANetwork, depth_of

ADAM_BYTES = 4 * 7
"""Read and written for one adapter weight by AdamW: gradient, two moments, weight; float32."""


@dataclass(frozen=True)
class Work:
    """Of one observation."""

    vision: float
    """Operations of the vision towers."""
    prompt: float
    """Operations of the projector and of Llama on the prompt."""
    decode: float
    """Operations of Llama on the action tokens after the first, one at a time."""
    forward: float
    """Operations of projector and Llama on the whole sequence at once, as the update has it."""
    layers: float
    """Part of `forward` that is Llama's layers, which gradient checkpointing computes again."""
    vision_lora: float
    """Part of `vision` that is the adapters'."""
    lora: float
    """Part of `forward` that is the adapters'."""
    vision_attention: float
    """Part of `vision` that is attention."""
    attention: float
    """Part of `forward` that is attention."""

    @property
    def rollout(self) -> float:
        """Operations to act once."""
        return self.vision + self.prompt + self.decode

    def update(self, *, vision_trained: bool, vision_kept: bool, recompute: bool) -> float:
        """Operations to learn once from a transition with LoRA.

        Backwards, a frozen weight costs as much as forwards (the gradient of its input), an adapter's weight
        twice, attention twice.

        Args:
            vision_trained: the towers have adapters, and gradients go through them.
            vision_kept: the towers' features come from the rollout.
            recompute: gradient checkpointing.
        """
        operations = 2 * self.forward + self.lora + self.attention + (self.layers if recompute else 0)
        if vision_trained:
            operations += self.vision * (2 if recompute else 1) + self.vision_lora + self.vision_attention
        return operations + (0 if vision_kept else self.vision)


def _linear(modules: Iterable[nn.Module], prefix: str = "") -> tuple[float, float]:
    """Operations of all linear layers for one token: (with adapters, the adapters')."""
    total = adapters = 0.0
    for module in modules:
        for name, layer in module.named_modules(prefix=prefix):
            if isinstance(layer, nn.Linear):
                operations = 2.0 * layer.in_features * layer.out_features
                total += operations
                adapters += operations if ".lora_" in f".{name}" else 0.0
    return total, adapters


def work_of(network: OpenVLANetwork, prompt_tokens: int, action_tokens: int) -> Work:
    """Count the operations for prompts of `prompt_tokens` (without image) and actions of `action_tokens`."""
    vision = vision_lora = vision_attention = 0.0
    towers: list[Any] = [network.vision_backbone.featurizer, network.vision_backbone.fused_featurizer]
    patches = network.vision_backbone.num_patches
    for tower in towers:
        tokens = patches + tower.num_prefix_tokens
        each, adapters = _linear(tower.blocks)
        attention = 4.0 * tokens**2 * tower.embed_dim * depth_of(tower)
        vision += tokens * each + attention + 2.0 * patches * tower.patch_embed.proj.weight.numel()
        vision_lora, vision_attention = vision_lora + tokens * adapters, vision_attention + attention
    llama, head = network.language_model.model, network.language_model.lm_head
    config: LlamaConfig = network.language_model.config
    attended = 4.0 * config.num_attention_heads * (config.head_dim or 0) * config.num_hidden_layers
    (layer, layer_lora), (out, out_lora) = _linear(llama.layers), _linear([head])
    projector, projector_lora = (patches * x for x in _linear([network.projector]))
    prompt, whole = prompt_tokens + patches, prompt_tokens + patches + action_tokens - 1
    return Work(
        vision=vision,
        prompt=projector + prompt * layer + prompt * whole * attended + out,
        decode=(action_tokens - 1) * (layer + out + whole * attended),
        forward=projector + whole * layer + whole**2 * attended + action_tokens * out,
        layers=whole * layer + whole**2 * attended,
        vision_lora=vision_lora,
        lora=projector_lora + whole * layer_lora + action_tokens * out_lora,
        vision_attention=vision_attention,
        attention=whole**2 * attended,
    )


def parameter_bytes(module: nn.Module) -> int:
    """Bytes of all parameters."""
    return sum(p.numel() * p.element_size() for p in module.parameters())


def rollout_bytes(network: OpenVLANetwork, prompt_tokens: int, action_tokens: int, batch: int) -> float:
    """Bytes to and from memory to act once: weights once a pass for the whole batch, keys and values."""
    config: LlamaConfig = network.language_model.config
    size = network.language_model.lm_head.weight.element_size()
    heads = (config.num_key_value_heads or config.num_attention_heads) * (config.head_dim or 0)
    kv = 2 * config.num_hidden_layers * heads * size * (prompt_tokens + network.vision_backbone.num_patches)
    weights = parameter_bytes(network) + (action_tokens - 1) * parameter_bytes(network.language_model)
    return weights / batch + (action_tokens - 1) * kv


def update_bytes(network: OpenVLANetwork, minibatch: int, accumulation: int, *, recompute: bool) -> float:
    """Bytes to and from memory to learn once: weights forwards and backwards, and AdamW; without activations."""
    passes = 3 if recompute else 2
    adapters = sum(p.numel() for p in network.parameters() if p.requires_grad)
    return passes * parameter_bytes(network) / minibatch + adapters * ADAM_BYTES / (minibatch * accumulation)
