"""The policy's config: what LeRobot saves as config.json."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamConfig


@PreTrainedConfig.register_subclass("mine")
@dataclass
class MineConfig(PreTrainedConfig):
    """Normalises states by mean and deviation, actions to [-1, 1]."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self):
        """The optimizer of `lerobot-train`."""
        return AdamConfig(lr=1e-3)

    def get_scheduler_preset(self):
        """No schedule."""
        return None

    def validate_features(self):
        """Any features will do."""
