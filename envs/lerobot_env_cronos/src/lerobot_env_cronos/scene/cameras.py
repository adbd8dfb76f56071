"""The fixed cameras, and what they see."""

from itertools import product
from typing import Any

import mujoco
import numpy as np

from lerobot_env_cronos.scene.scenes import Body, Scene

CAMERAS: dict[str, dict[str, Any]] = {
    # A front view, 45 degrees down through a long lens: bodies at the edges of the widened spawn area just fit
    # the width of a square picture, and little is lost behind the arm.
    "front": {"pos": [1.03, 0, 0.82], "xyaxes": [0, 1, 0, -1, 0, 1], "fovy": 27.0},
    # The Bridge set-up's third-person Logitech C920, as identified by SimplerEnv.
    "bridge": {
        "pos": [0.0, -0.16, 0.36],
        "xyaxes": [0.483933, -0.875105, 0.0, 0.602558, 0.333214, 0.725184],
        "fovy": 42.1004,
    },
}
"""Fixed cameras by name: position [m], image x and y axes, vertical field of view [deg]."""


def camera_quaternion(xyaxes: list[float]) -> np.ndarray:
    """Orientation (w, x, y, z) of a camera from its image x and y axes."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, _rotation(xyaxes).ravel())
    return quat


def _rotation(xyaxes: list[float]) -> np.ndarray:
    """Rotation matrix of a camera from its image x and y axes, made orthonormal."""
    x, y = np.array(xyaxes[:3]), np.array(xyaxes[3:])
    x = x / np.linalg.norm(x)
    y = y - x * (x @ y)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def camera_projection(name: str, height: int, width: int) -> np.ndarray:
    """The matrix (3, 4) of a camera's picture of `height` x `width` pixels.

    Times a point (x, y, z, 1) in the base frame [m] it is (u w, v w, w), w the depth [m]. u to the right and v
    downwards lie in [-1, 1] inside the picture.
    """
    camera = CAMERAS[name]
    rotation, zoom = _rotation(camera["xyaxes"]), 1 / np.tan(np.deg2rad(camera["fovy"]) / 2)
    # A camera looks along its -z axis, and its y axis points up.
    scale = np.diag([zoom * height / width, -zoom, -1.0])
    return scale @ np.concatenate([rotation.T, -(rotation.T @ camera["pos"])[:, None]], axis=1)


def is_in_view(points: np.ndarray, camera: str = "front") -> np.ndarray:
    """Whether points (..., 3) in the base frame [m] lie inside a square picture of `camera`: (...,) bool.

    The front view decides whether a body is seen, whatever the observation.
    """
    projection = camera_projection(camera, 1, 1)
    x, y, depth = np.moveaxis(points @ projection[:, :3].T + projection[:, 3], -1, 0)
    return (depth > 0) & (np.abs(x) <= depth) & (np.abs(y) <= depth)


def is_spawn_area_in_view(scene: Scene, body: Body) -> bool:
    """Whether the front camera sees the centre of `body` wherever in the scene's spawn area it lies."""
    # What a camera sees is convex: with its corners it sees the whole area.
    centres = [(x, y, body.size[2] / 2) for x, y in product(*zip(scene.spawn_low, scene.spawn_high, strict=True))]
    return bool(is_in_view(np.array(centres)).all())
