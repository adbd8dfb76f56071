"""Which physical actions the ends of the bins stand for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import EnvTransition, ProcessorStep, ProcessorStepRegistry, TransitionKey
from torch import Tensor

DATASET = "dataset"
"""Key of the statistics of a LeRobotDataset."""
SMALLEST_RANGE = 1e-8
"""Added to q99 - q01 where actions are normalised, as in the published training code."""


def choose_statistics(
    key: str | None, published: dict[str, dict[str, Any]], dataset_stats: dict[str, dict[str, Any]] | None
) -> dict[str, Any]:
    """Return the key, q01, q99, mask and unused (lists with an entry a dimension) of the statistics to use.

    Args:
        key: one of `published`, `dataset`, or None for the only one there is.
        published: by data set, of the checkpoint.
        dataset_stats: LeRobot's, with quantiles or at least minimum and maximum of `action`.

    Raises:
        ValueError: there are none of that name, or no name is given and there are several.
    """
    if key == DATASET:
        return _of_dataset(dataset_stats)
    if key is None:
        if len(published) != 1:
            raise ValueError(
                f"unnorm_key is not given, and there is not one set of action statistics but {len(published)}: "
                f"choose one of {sorted(published)}, or {DATASET!r}"
            )
        key = next(iter(published))
    if key not in published:
        raise ValueError(f"unnorm_key={key!r} is not one of {sorted(published)}, nor is it {DATASET!r}")
    entry = published[key]
    mask = entry.get("mask", [True] * len(entry["q01"]))
    return _statistics(key, entry, ("q01", "q99"), [bool(m) for m in mask])


def _statistics(key: str, entry: dict[str, Any], sides: tuple[str, str], mask: list[bool]) -> dict[str, Any]:
    q01, q99 = ([float(v) for v in entry[side]] for side in sides)
    unused = entry.get("unused")
    if unused is None:
        least, most = (entry.get(side, bound) for side, bound in (("min", q01), ("max", q99)))
        unused = [bool(low == high) for low, high in zip(least, most, strict=True)]
    return {"key": key, "q01": q01, "q99": q99, "mask": mask, "unused": unused}


def _of_dataset(stats: dict[str, dict[str, Any]] | None) -> dict[str, Any]:
    if stats is None or "action" not in stats:
        raise ValueError(
            f"unnorm_key={DATASET!r} needs a data set's statistics of 'action': use lerobot-train first"
        )
    sides = ("q01", "q99") if {"q01", "q99"} <= set(stats["action"]) else ("min", "max")
    # As the published checkpoints have it: the last dimension, the gripper, is 0 to 1 already.
    mask = [True] * (len(stats["action"]["min"]) - 1) + [False]
    chosen = _statistics(DATASET, stats["action"], sides, mask)
    # A gripper that never moved stays where it was: without the mask nothing would bring 0 back to that.
    chosen["unused"] = [unused and mapped for unused, mapped in zip(chosen["unused"], mask, strict=True)]
    return chosen


@dataclass
@ProcessorStepRegistry.register(name="openvla_action_statistics")
class ActionStatisticsProcessorStep(ProcessorStep):
    """Maps actions between physical units and [-1, 1] where the mask is true, and leaves the rest alone.

    A step of its own, not statistics of LeRobot's normaliser: `lerobot-train --policy.path` replaces those by the
    new data set's, and the bins would come to mean other actions.
    """

    q01: list[float] = field(default_factory=list)
    """Physical action that -1 stands for."""
    q99: list[float] = field(default_factory=list)
    """Physical action that 1 stands for."""
    mask: list[bool] = field(default_factory=list)
    """Which dimensions are mapped."""
    unused: list[bool] = field(default_factory=list)
    """Which dimensions never change in the data (minimum = maximum): normalised they are 0. Empty: none."""
    inverse: bool = False
    """False: physical to normalised (preprocessor). True: normalised to physical (postprocessor)."""

    def __post_init__(self) -> None:
        """Fill in what is not given."""
        self.unused = self.unused or [False] * len(self.q01)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Convert the transition's action, if it has one."""
        action = transition.get(TransitionKey.ACTION)
        if action is None:
            return transition
        converted = transition.copy()
        converted["action"] = self.convert(torch.as_tensor(action))
        return converted

    def convert(self, action: Tensor) -> Tensor:
        """Convert actions (..., D) in the direction that `inverse` tells.

        A dimension with q01 = q99 comes back as that constant, whatever its token.
        """
        action = action.float()
        low, high = (
            torch.tensor(side, dtype=torch.float32, device=action.device) for side in (self.q01, self.q99)
        )
        mask, unused = (torch.tensor(which, device=action.device) for which in (self.mask, self.unused))
        if self.inverse:
            return torch.where(mask, 0.5 * (action + 1) * (high - low) + low, action)
        normalised = torch.where(mask, 2 * (action - low) / (high - low + SMALLEST_RANGE) - 1, action)
        return normalised.clamp(-1.0, 1.0).masked_fill(unused, 0.0)

    def get_config(self) -> dict[str, Any]:
        """Return what is written to the processor's JSON."""
        names = ("q01", "q99", "mask", "unused", "inverse")
        return {name: getattr(self, name) for name in names}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Shapes and types stay as they are."""
        return features
