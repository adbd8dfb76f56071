"""How the scene looks: visual geometry without mass or contacts, materials, lights. Changes no dynamics."""

import mujoco

from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.scene.visuals.materials import add_materials
from lerobot_env_cronos.scene.visuals.objects import LOOKS
from lerobot_env_cronos.scene.visuals.robot import dress_robot
from lerobot_env_cronos.scene.visuals.room import dress_room, set_quality


def dress(spec: mujoco.MjSpec, bodies: dict[str, mujoco.MjsBody]) -> None:
    """Add visual geometry to the room, the robot and `bodies` (by name) of `spec`; changes no dynamics."""
    set_quality(spec)
    add_materials(spec)
    dress_room(spec)
    dress_robot(spec)
    for name, spec_body in bodies.items():
        LOOKS[BODIES[name].shape](spec, spec_body, BODIES[name])
