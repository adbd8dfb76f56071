"""How the scene looks: visual geometry without mass or contacts, materials, lights. Changes no dynamics."""

from collections.abc import Callable

import mujoco

from lerobot_env_cronos.scene.arms.so101.looks import dress_robot as dress_so101
from lerobot_env_cronos.scene.arms.widowx.looks import dress_robot as dress_widowx
from lerobot_env_cronos.scene.scenes import BODIES, Scene
from lerobot_env_cronos.scene.visuals.materials import add_materials
from lerobot_env_cronos.scene.visuals.objects import LOOKS
from lerobot_env_cronos.scene.visuals.room import dress_room, set_quality

DRESS_ROBOT: dict[str, Callable[[mujoco.MjSpec], None]] = {"widowx": dress_widowx, "so101": dress_so101}
"""How to draw an arm, by its name."""


def dress(spec: mujoco.MjSpec, scene: Scene, bodies: dict[str, mujoco.MjsBody]) -> None:
    """Add visual geometry to the room, the robot and `bodies` (by name) of `spec`; changes no dynamics."""
    set_quality(spec)
    add_materials(spec)
    dress_room(spec)
    DRESS_ROBOT[scene.arm](spec)
    for name, spec_body in bodies.items():
        LOOKS[BODIES[name].shape](spec, spec_body, BODIES[name])
