"""The arms by name."""

from lerobot_env_cronos.scene.arms.arm import Arm
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX

ARMS: dict[str, Arm] = {arm.name: arm for arm in (WIDOWX, SO101_ARM)}
"""Those that `Scene.arm` names."""


def get_arm(name: str) -> Arm:
    """Look an arm up by name; a ValueError names the valid ones."""
    if name not in ARMS:
        raise ValueError(f"unknown arm {name!r}; valid arms: {sorted(ARMS)}")
    return ARMS[name]
