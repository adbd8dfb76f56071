"""OpenVLA for LeRobot: published checkpoints, LoRA, behaviour cloning and reinforcement learning.

Importing the package registers `--policy.type=openvla` and its processor step with LeRobot;
`lerobot.utils.import_utils.register_third_party_plugins` does that for LeRobot's own commands.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.processor_openvla import make_openvla_pre_post_processors

if TYPE_CHECKING:
    from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy

__all__ = ["OpenVLAConfig", "OpenVLAPolicy", "make_openvla_pre_post_processors"]


def __getattr__(name: str) -> Any:
    # LeRobot imports every plugin in every command; of those that have no OpenVLA none shall wait for timm.
    if name == "OpenVLAPolicy":
        from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy

        return OpenVLAPolicy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
