"""What task orders and reset strategies keep besides `LoopState` and their generators, for a checkpoint."""

from __future__ import annotations

from typing import Any

import numpy as np

LEAVES = (bool, int, float, str, np.ndarray, type(None))


def own_state(part: Any) -> dict[str, Any]:
    """Return what `part.state_dict()` says, {} of a part that has no such method.

    Raises:
        ValueError: it says what a checkpoint cannot hold; the part, the place and the type are named.
    """
    method = getattr(part, "state_dict", None)
    if method is None:
        return {}
    if not callable(getattr(part, "load_state_dict", None)):
        raise ValueError(f"{type(part).__name__} has state_dict() and no load_state_dict(state) to go on from it.")
    state = method()
    if not isinstance(state, dict):
        raise ValueError(f"{type(part).__name__}.state_dict() must return a dict, got {state!r}.")
    _check(state, f"{type(part).__name__}.state_dict()")
    return state


def load_own_state(part: Any, state: dict[str, Any]) -> None:
    """Go on from `own_state`; nothing to do for a part that had none."""
    if state:
        part.load_state_dict(state)


def _check(value: Any, where: str) -> None:
    if isinstance(value, dict):
        if wrong := [key for key in value if not isinstance(key, str | int)]:
            raise ValueError(f"{where} has the key {wrong[0]!r}: a checkpoint holds strings and ints as keys.")
        for key, inner in value.items():
            _check(inner, f"{where}[{key!r}]")
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            _check(inner, f"{where}[{index}]")
    elif type(value) not in LEAVES or (isinstance(value, np.ndarray) and value.dtype.kind not in "biufc"):
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"of {type(value).__name__}"
        raise ValueError(
            f"{where} is {kind}: a checkpoint holds dicts and lists of numbers, strings, None and NumPy arrays of"
            " numbers."
        )
