"""What the cameras see."""

from itertools import product

import numpy as np

from lerobot_env_cronos.scene.model import camera_axes
from lerobot_env_cronos.scene.scenes import Body, Scene

CAMERA = "front"
"""The view that decides whether a body is seen; a square picture, whatever the observation."""


def is_in_view(points: np.ndarray, camera: str = CAMERA) -> np.ndarray:
    """Whether points (..., 3) in the base frame [m] lie inside a square picture of `camera`: (...,) bool."""
    origin, rotation, half_view = camera_axes(camera)
    x, y, z = np.moveaxis((points - origin) @ rotation, -1, 0)
    # A camera looks along its -z axis.
    limit = -z * np.tan(half_view)
    return (z < 0) & (np.abs(x) <= limit) & (np.abs(y) <= limit)


def is_spawn_area_in_view(scene: Scene, body: Body) -> bool:
    """Whether the front camera sees the centre of `body` wherever in the scene's spawn area it lies."""
    # What a camera sees is convex: with its corners it sees the whole area.
    centres = [(x, y, body.size[2] / 2) for x, y in product(*zip(scene.spawn_low, scene.spawn_high, strict=True))]
    return bool(is_in_view(np.array(centres)).all())
