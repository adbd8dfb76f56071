"""Which number format the convolutions run in."""

from typing import Literal

import torch

Precision = Literal["auto", "float32", "bfloat16"]


def bfloat16_is_native(device: str) -> bool:
    """Whether the device multiplies bfloat16 in hardware; elsewhere it would be slower than float32.

    A processor that can, but whose oneDNN is held to AVX2, as the runs of experiments are, counts as one that
    cannot: its convolutions would be emulated, and take several times as long as in float32.
    """
    kind = torch.device(device).type
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if kind == "cpu":
        capabilities = torch.cpu.get_capabilities()
        has_it = bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
        # PyTorch tells by its own operator alone what oneDNN, which runs the convolutions, may use.
        return has_it and torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return False


def use_bfloat16(precision: Precision, device: str) -> bool:
    """Resolve `PocketVLAConfig.dtype` for a device."""
    return bfloat16_is_native(device) if precision == "auto" else precision == "bfloat16"
