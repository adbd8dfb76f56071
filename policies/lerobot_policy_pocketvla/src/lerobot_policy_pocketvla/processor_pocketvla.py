"""Pre- and postprocessor of PocketVLA: LeRobot's default steps and the action bounds."""

from typing import Any

import torch
from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from lerobot_policy_pocketvla.action_bounds import ActionBoundsProcessorStep
from lerobot_policy_pocketvla.bodies import BodiesProcessorStep
from lerobot_policy_pocketvla.configuration_pocketvla import PocketVLAConfig

EPS = 1e-3
"""What is added to the standard deviation that a state is divided by, in its own units (1 mm for metres): by
LeRobot's 1e-8 the float noise of a dimension that stood still in the data would be the largest input. It is saved
with the processor, and stays where `lerobot-train --policy.path` puts another dataset's statistics into it."""


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
        The preprocessor (bodies as `describe_bodies` says, other states to zero mean and unit deviation, actions
        from `action_bounds` to [-1, 1], images as they are) and the postprocessor (actions back to physical units,
        on the CPU).
    """
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    steps.normalize.eps = EPS
    low, high = config.physical_bounds(dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            steps.to_device,
            *([BodiesProcessorStep()] if config.bodies else []),
            # Before the states are normalised: it needs the joints in the actions' units.
            ActionBoundsProcessorStep(low, high, joints=config.joints),
            steps.normalize,
        ],
        output_steps=[ActionBoundsProcessorStep(low, high, inverse=True), steps.unnormalize, steps.to_cpu],
    )
