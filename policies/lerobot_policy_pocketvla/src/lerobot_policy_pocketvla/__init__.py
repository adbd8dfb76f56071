"""PocketVLA: a language-conditioned visuomotor policy for LeRobot that trains on a laptop CPU.

Importing the package registers `--policy.type=pocketvla` and its processor step with LeRobot;
`lerobot.utils.import_utils.register_third_party_plugins` does that for LeRobot's own commands.
"""

from lerobot_policy_pocketvla.configuration_pocketvla import PocketVLAConfig
from lerobot_policy_pocketvla.flow_policy import PocketVLAFlowPolicy
from lerobot_policy_pocketvla.modeling_pocketvla import PocketVLAPolicy
from lerobot_policy_pocketvla.processor_pocketvla import make_pocketvla_pre_post_processors
from lerobot_policy_pocketvla.token_policy import PocketVLATokenPolicy

__all__ = [
    "PocketVLAConfig",
    "PocketVLAFlowPolicy",
    "PocketVLAPolicy",
    "PocketVLATokenPolicy",
    "make_pocketvla_pre_post_processors",
]
