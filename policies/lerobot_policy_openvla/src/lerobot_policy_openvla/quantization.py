"""The frozen language model's linear layers in 8 or 4 bits, by bitsandbytes."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from torch import nn

from lerobot_policy_openvla.network import OpenVLANetwork


def _bitsandbytes() -> Any:
    try:
        return import_module("bitsandbytes")
    except ImportError as error:
        raise ImportError(
            "quantization needs bitsandbytes: pip install 'lerobot_policy_openvla[quantized]', or "
            "--policy.quantization=none"
        ) from error


def quantize(network: OpenVLANetwork, kind: str, device: str | torch.device) -> None:
    """Replace the linear layers of Llama's blocks, which are most of the network, by frozen quantised ones.

    Args:
        network: on any device; it ends on `device`.
        kind: `int8` (LLM.int8) or `nf4` (QLoRA's 4-bit format).
        device: where the layers are quantised.

    Raises:
        ImportError: bitsandbytes is not installed.
    """
    library = _bitsandbytes()
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
