"""The same rounding on different processors, so that two machines clone the same base policy.

PyTorch, MKL, oneDNN, NumPy and OpenBLAS choose the instructions that a processor has; with others sums come out
with other last bits, and a clone or a run becomes another one. All of them can be told to stay with AVX2, which
nearly every x86-64 processor has. MKL goes by the maker of the processor as well, but for one path, without AVX:
the slower one, so that only clones take it, which every run of an experiment begins with.
"""

from __future__ import annotations

AVX2 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
}
"""Variables by which PyTorch, MKL, oneDNN and OpenBLAS use nothing newer; Haswell was the first with AVX2."""
ANY_MAKER = {"MKL_CBWR": "COMPATIBLE"}
"""MKL's path that is the same on the processors of all makers."""
CLONING = "lerobot-train"
"""The command that clones."""


def portable_arithmetic(command: str) -> dict[str, str]:
    """Return the variables that hold a command to AVX2; none where the processor does not have it.

    They have to be set before the command starts. One that a user has set himself should win over them.

    Args:
        command: its name; `lerobot-train` gets what is the same on the processors of all makers.
    """
    # They take seconds, and commands that only explain themselves do without.
    import numpy as np
    import torch

    if torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"):
        return {}
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    newer = [name for name in found if name.startswith("AVX512")]
    held = AVX2 | (ANY_MAKER if command == CLONING else {})
    return held | ({"NPY_DISABLE_CPU_FEATURES": " ".join(newer)} if newer else {})
