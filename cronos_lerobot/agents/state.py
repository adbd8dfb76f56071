"""The state of an agent as a checkpoint takes it: nested dicts and lists with tensors, numbers and strings."""

from __future__ import annotations

import io
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from pickle import PicklingError, UnpicklingError
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


def to_tensors(tree: Any) -> Any:
    """Arrays as tensors, which torch reads back without executing anything."""
    return map_leaves(tree, np.ndarray, torch.from_numpy)


def to_arrays(tree: Any) -> Any:
    """Inverse of `to_tensors`, where there were no tensors before."""
    return map_leaves(tree, torch.Tensor, lambda tensor: tensor.numpy())


def to_comparable(tree: Any) -> Any:
    """Arrays as what `==` compares bit for bit: their type, shape and bytes."""
    return map_leaves(tree, np.ndarray, lambda array: (str(array.dtype), array.shape, array.tobytes()))


def agent_state(agent: Any) -> dict[str, Any]:
    """Return what an agent says in `state_dict()`, in what torch reads back without executing anything.

    `as_it_was` makes it what it was again; tensors are not copied.

    Raises:
        ValueError: it says what a checkpoint cannot give back; the place and the type are named.
    """
    state, where = agent.state_dict(), f"{type(agent).__name__}.state_dict()"
    if not isinstance(state, dict):
        raise ValueError(f"{where} must return a dict, got {state!r}.")
    return _to_save(state, where)


def as_it_was(saved: Any) -> Any:
    """Inverse of `agent_state`, of what is on the CPU; dicts and lists are changed in place."""
    if isinstance(saved, dict):
        if saved.keys() == {ARRAY}:
            return saved[ARRAY].numpy()
        if saved.keys() == {NUMBER}:
            return saved[NUMBER].numpy()[()]
        saved.update({key: as_it_was(value) for key, value in saved.items()})
    elif isinstance(saved, list):
        saved[:] = map(as_it_was, saved)
    return tuple(map(as_it_was, saved)) if type(saved) is tuple else saved


def _to_save(value: Any, where: str) -> Any:
    if type(value) in (dict, OrderedDict):
        # Shallow, with the notes that PyTorch makes on the state of a module.
        saved = copy(value)
        for key, inner in value.items():
            _check(key, f"the key {key!r} of {where}")
            saved[key] = _to_save(inner, f"{where}[{key!r}]")
        return saved
    if type(value) in (list, tuple):
        return type(value)(_to_save(inner, f"{where}[{index}]") for index, inner in enumerate(value))
    if type(value) is np.ndarray or isinstance(value, np.generic):
        # Text, objects and the like are no tensors.
        with suppress(TypeError, ValueError):
            name = ARRAY if isinstance(value, np.ndarray) else NUMBER
            return {name: torch.from_numpy(np.require(value, requirements="CW"))}
    _check(value, where)
    return value


def _check(value: Any, where: str) -> None:
    """Tensors and what is plain are read back for certain; of the rest torch is asked."""
    if type(value) in PLAIN or isinstance(value, torch.Tensor):
        return
    file = io.BytesIO()
    try:
        torch.save(value, file)
        file.seek(0)
        torch.load(file, weights_only=True)
    except (PicklingError, UnpicklingError, AttributeError, TypeError, RuntimeError) as error:
        kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"of {type(value).__name__}"
        raise ValueError(
            f"{where} is {kind}: a checkpoint holds dicts, lists and tuples of tensors, NumPy arrays of numbers, "
            "numbers, strings and None."
        ) from error
