"""Pre- and postprocessor of OpenVLA: LeRobot's default steps and the action statistics."""

from typing import Any

from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from lerobot_policy_openvla.action_statistics import ActionStatisticsProcessorStep
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig


def make_openvla_pre_post_processors(
    config: OpenVLAConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Build the processors; LeRobot finds this function by its name.

    Args:
        config: of the policy.
        dataset_stats: LeRobot's statistics per feature.

    Returns:
        The preprocessor (actions to [-1, 1], images as they are) and the postprocessor (actions back to physical
        units, on the CPU).
    """
    config.resolve(dataset_stats)
    assert config.action_statistics is not None
    statistics = {name: values for name, values in config.action_statistics.items() if name != "key"}
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            steps.to_device,
            steps.normalize,
            ActionStatisticsProcessorStep(**statistics),
        ],
        output_steps=[
            ActionStatisticsProcessorStep(**statistics, inverse=True),
            steps.unnormalize,
            steps.to_cpu,
        ],
    )
