"""What the cameras of an arm's set-up see."""

from itertools import product

import mujoco
import numpy as np

from lerobot_env_cronos.scene.arms.arm import Camera
from lerobot_env_cronos.scene.scenes import Body, Scene


def camera_quaternion(camera: Camera) -> np.ndarray:
    """Orientation (w, x, y, z) of a camera in its base frame."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, camera.rotation.ravel())
    return quat


def is_spawn_area_in_view(scene: Scene, body: Body) -> bool:
    """Whether the front camera sees the centre of `body` wherever in the scene's spawn area it lies."""
    # What a camera sees is convex: with its corners it sees the whole area.
    centres = [(x, y, body.size[2] / 2) for x, y in product(*zip(scene.spawn_low, scene.spawn_high, strict=True))]
    return bool(scene.robot.sees(np.array(centres)).all())
