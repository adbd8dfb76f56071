"""States as a checkpoint takes them: what torch reads back without executing anything."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
import torch

ARRAY, NUMBER = "numpy.ndarray", "numpy.generic"
"""The one key of a dict that stands for an array in a checkpoint, or for one of NumPy's numbers."""
PLAIN = (bool, int, float, str, type(None))


def map_leaves(tree: Any, leaf: type, convert: Callable[[Any], Any]) -> Any:
    """Convert every `leaf` in nested dicts and lists."""
    if isinstance(tree, dict):
        return {key: map_leaves(value, leaf, convert) for key, value in tree.items()}
    if isinstance(tree, list):
        return [map_leaves(value, leaf, convert) for value in tree]
    return convert(tree) if isinstance(tree, leaf) else tree


def to_comparable(tree: Any) -> Any:
    """Arrays as what `==` compares bit for bit: their type, shape and bytes."""
    return map_leaves(tree, np.ndarray, lambda array: (str(array.dtype), array.shape, array.tobytes()))


def agent_state(agent: Any) -> dict[str, Any]:
    """Return `to_saved` of an agent's `state_dict()`; `as_it_was` reverses it. Tensors are not copied."""
    return to_saved(agent.state_dict(), f"{type(agent).__name__}.state_dict()")


def as_it_was(saved: Any) -> Any:
    """Inverse of `to_saved`, of what is on the CPU; dicts and lists are changed in place."""
    if isinstance(saved, dict):
        if saved.keys() == {ARRAY}:
            return saved[ARRAY].numpy()
        if saved.keys() == {NUMBER}:
            return saved[NUMBER].numpy()[()]
        saved.update({key: as_it_was(value) for key, value in saved.items()})
    elif isinstance(saved, list):
        saved[:] = map(as_it_was, saved)
    return tuple(map(as_it_was, saved)) if type(saved) is tuple else saved


def to_saved(value: Any, where: str) -> Any:
    """Return `value` in what torch reads back without executing anything; `where` names it in an error.

    Raises:
        ValueError: a checkpoint cannot hold it.
    """
    if type(value) in (dict, OrderedDict):
        # Shallow, with the notes that PyTorch makes on the state of a module.
        saved = copy(value)
        for key, inner in value.items():
            saved[to_saved(key, f"the key {key!r} of {where}")] = to_saved(inner, f"{where}[{key!r}]")
        return saved
    if type(value) in (list, tuple):
        return type(value)(to_saved(inner, f"{where}[{index}]") for index, inner in enumerate(value))
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufc":
        name = ARRAY if isinstance(value, np.ndarray) else NUMBER
        return {name: torch.from_numpy(np.require(value, requirements="CW"))}
    if type(value) in PLAIN or isinstance(value, torch.Tensor):
        return value
    raise ValueError(
        f"{where} is of {type(value).__name__}: a checkpoint holds dicts, lists and tuples of tensors, arrays of "
        "numbers, numbers, strings and None."
    )
