"""What task orders and reset strategies keep besides `LoopState` and their generators, for a checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

import numpy as np

LEAVES = (bool, int, float, str, np.ndarray, type(None))


def own_states(parts: Iterable[Any]) -> dict[str, dict[str, Any]]:
    """Return what each of `parts` says in `state_dict()`, by its class, of those that say anything.

    Raises:
        ValueError: one says what a checkpoint cannot hold; the part, the place and the type are named.
    """
    return {name: state for name, part in _named(parts).items() if (state := _own_state(part))}


def load_own_states(parts: Iterable[Any], states: dict[str, dict[str, Any]]) -> None:
    """Let those of `parts` that `own_states` has something of go on from it.

    A resumed run may have other strategies than before: they begin anew, and what is of none of them is dropped.
    """
    named = _named(parts)
    for name, state in states.items():
        if load := getattr(named.get(name), "load_state_dict", None):
            load(state)
        else:
            logging.warning(f"The checkpoint has the state of {name}, which this run does not have: dropped.")


def _named(parts: Iterable[Any]) -> dict[str, Any]:
    """By their classes; of one class the second and later ones with a number."""
    named: dict[str, Any] = {}
    for part in parts:
        name = type(part).__name__
        same = sum(other.partition(" ")[0] == name for other in named)
        named[f"{name} {same + 1}" if same else name] = part
    return named


def _own_state(part: Any) -> dict[str, Any]:
    method = getattr(part, "state_dict", None)
    if method is None:
        return {}
    if not callable(getattr(part, "load_state_dict", None)):
        raise ValueError(f"{type(part).__name__} has state_dict() and no load_state_dict(state) to go on from it.")
    state = method()
    if not isinstance(state, dict):
        raise ValueError(f"{type(part).__name__}.state_dict() must return a dict, got {state!r}.")
    state = _plain(state)
    _check(state, f"{type(part).__name__}.state_dict()")
    return state


def _plain(value: Any) -> Any:
    """A copy with NumPy's numbers as Python's: a mean is one as soon as it is taken."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return value.item() if isinstance(value, np.generic) else value


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
