"""The same rounding on different processors, so that two machines clone the same base policy.

PyTorch, MKL, oneDNN, NumPy and OpenBLAS choose the instructions that a processor has; with others sums come out
with other last bits, and a clone or a run becomes another one. All of them can be told to stay with AVX2, which
nearly every x86-64 processor has.
"""

from __future__ import annotations

AVX2 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
}
"""Variables by which PyTorch, MKL, oneDNN and OpenBLAS use nothing newer; Haswell was the first with AVX2."""


def portable_arithmetic() -> dict[str, str]:
    """Return the variables that hold a command to AVX2; none where the processor does not have it.

    They have to be set before the command starts. One that a user has set himself should win over them.
    """
    # They take seconds, and commands that only explain themselves do without.
    import numpy as np
    import torch

    if torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"):
        return {}
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    newer = [name for name in found if name.startswith("AVX512")]
    return AVX2 | ({"NPY_DISABLE_CPU_FEATURES": " ".join(newer)} if newer else {})
