"""Pre- and postprocessor of PocketVLA: LeRobot's default steps and the action bounds."""

from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType
from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from lerobot_policy_pocketvla.action_bounds import ActionBoundsProcessorStep
from lerobot_policy_pocketvla.configuration_pocketvla import PocketVLAConfig

MIN_STD = 1e-3
"""Smallest standard deviation to divide a state by, in its own units (1 mm for metres): LeRobot adds only
1e-8, so the float noise of a dimension that stood still in the data would become the largest input."""

Stats = dict[str, dict[str, Any]]


def with_floored_std(stats: Stats | None, config: PocketVLAConfig) -> Stats | None:
    """Copy data set statistics with the standard deviations of the vector inputs at least `MIN_STD`."""
    if stats is None:
        return None
    floored = {key: dict(values) for key, values in stats.items()}
    for key, feature in (config.input_features or {}).items():
        if feature.type in (FeatureType.STATE, FeatureType.ENV) and "std" in floored.get(key, {}):
            floored[key]["std"] = np.maximum(np.asarray(floored[key]["std"], dtype=np.float32), MIN_STD)
    return floored


def make_pocketvla_pre_post_processors(
    config: PocketVLAConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Build the processors; LeRobot finds this function by its name.

    Args:
        config: of the policy, its features known.
        dataset_stats: LeRobot's statistics per feature.

    Returns:
        The preprocessor (states to zero mean and unit deviation, actions from `action_bounds` to [-1, 1],
        images as they are) and the postprocessor (actions back to physical units, on the CPU).
    """
    steps = make_default_policy_processor_steps(
        config, with_floored_std(dataset_stats, config), normalizer_device=config.device
    )
    low, high = config.physical_bounds(dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            steps.to_device,
            steps.normalize,
            ActionBoundsProcessorStep(low, high),
        ],
        output_steps=[ActionBoundsProcessorStep(low, high, inverse=True), steps.unnormalize, steps.to_cpu],
    )
