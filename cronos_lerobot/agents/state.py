"""The state of an agent as a checkpoint takes it: nested dicts and lists with tensors, numbers and strings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch


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
