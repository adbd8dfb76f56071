"""OpenVLA for LeRobot: published checkpoints, LoRA, behaviour cloning and reinforcement learning.

Importing the package registers `--policy.type=openvla` and its processor step with LeRobot;
`lerobot.utils.import_utils.register_third_party_plugins` does that for LeRobot's own commands.
"""

from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_policy_openvla.processor_openvla import make_openvla_pre_post_processors

__all__ = ["OpenVLAConfig", "OpenVLAPolicy", "make_openvla_pre_post_processors"]
