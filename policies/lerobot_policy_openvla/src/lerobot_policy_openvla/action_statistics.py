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
DEFAULT_KEY = "bridge_orig"
"""Key of the statistics that are used unless others are asked for."""


def choose_statistics(
    key: str | None, published: dict[str, dict[str, Any]], dataset_stats: dict[str, dict[str, Any]] | None
) -> dict[str, Any]:
    """Return the key, q01, q99 and mask (lists with an entry a dimension) of the statistics to use.

    Args:
        key: one of `published`, `dataset`, or None for `bridge_orig` or the only one there is.
        published: by data set, of the checkpoint.
        dataset_stats: LeRobot's, with quantiles or at least minimum and maximum of `action`.

    Raises:
        ValueError: there are none of that name.
    """
    if key == DATASET:
        return _of_dataset(dataset_stats)
    if key is None:
        key = DEFAULT_KEY if DEFAULT_KEY in published or len(published) != 1 else next(iter(published))
    if key not in published:
        raise ValueError(f"unnorm_key={key!r} is not one of {sorted(published)}, nor is it {DATASET!r}")
    entry = published[key]
    mask = entry.get("mask", [True] * len(entry["q01"]))
    return {"key": key, "q01": list(entry["q01"]), "q99": list(entry["q99"]), "mask": [bool(m) for m in mask]}


def _of_dataset(stats: dict[str, dict[str, Any]] | None) -> dict[str, Any]:
    if stats is None or "action" not in stats:
        raise ValueError(
            f"unnorm_key={DATASET!r} needs a data set's statistics of 'action': use lerobot-train first"
        )
    sides = ("q01", "q99") if {"q01", "q99"} <= set(stats["action"]) else ("min", "max")
    q01, q99 = ([float(v) for v in stats["action"][side]] for side in sides)
    # As the published checkpoints have it: the last dimension, the gripper, is 0 to 1 already.
    return {"key": DATASET, "q01": q01, "q99": q99, "mask": [True] * (len(q01) - 1) + [False]}


@dataclass
@ProcessorStepRegistry.register(name="openvla_action_statistics")
class ActionStatisticsProcessorStep(ProcessorStep):
    """Maps actions between physical units and [-1, 1] where the mask is true, and leaves the rest alone.

    A step of its own, not statistics of LeRobot's normaliser: `lerobot-train --policy.path` replaces those by the
    new data set's, and the bins would come to mean other actions.

    Raises:
        ValueError: the statistics differ in length, q01 is not below q99, or an action has another width.
    """

    q01: list[float] = field(default_factory=list)
    """Physical action that -1 stands for."""
    q99: list[float] = field(default_factory=list)
    """Physical action that 1 stands for."""
    mask: list[bool] = field(default_factory=list)
    """Which dimensions are mapped."""
    inverse: bool = False
    """False: physical to normalised (preprocessor). True: normalised to physical (postprocessor)."""

    def __post_init__(self) -> None:
        """Check the statistics at once."""
        if not len(self.q01) == len(self.q99) == len(self.mask) > 0:
            raise ValueError(
                "q01, q99 and mask need one entry a dimension, got "
                f"{len(self.q01)}, {len(self.q99)} and {len(self.mask)}"
            )
        for dim, (low, high, mapped) in enumerate(zip(self.q01, self.q99, self.mask, strict=True)):
            if mapped and not low < high:
                raise ValueError(f"action dimension {dim}: q01 {low} must be below q99 {high}")

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Convert the transition's action, if it has one."""
        action = transition.get(TransitionKey.ACTION)
        if action is None:
            return transition
        converted = transition.copy()
        converted["action"] = self.convert(torch.as_tensor(action))
        return converted

    def convert(self, action: Tensor) -> Tensor:
        """Convert actions (..., D) in the direction that `inverse` tells."""
        if action.shape[-1] != len(self.q01):
            raise ValueError(f"action has {action.shape[-1]} dimensions, the statistics have {len(self.q01)}")
        action = action.float()
        low, high = (
            torch.tensor(side, dtype=torch.float32, device=action.device) for side in (self.q01, self.q99)
        )
        mask = torch.tensor(self.mask, device=action.device)
        if self.inverse:
            return torch.where(mask, 0.5 * (action + 1) * (high - low) + low, action)
        return torch.where(mask, 2 * (action - low) / (high - low) - 1, action).clamp(-1.0, 1.0)

    def get_config(self) -> dict[str, Any]:
        """Return what is written to the processor's JSON."""
        return {"q01": self.q01, "q99": self.q99, "mask": self.mask, "inverse": self.inverse}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Shapes and types stay as they are."""
        return features
