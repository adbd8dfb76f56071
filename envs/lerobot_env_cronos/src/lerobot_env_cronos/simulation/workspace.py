"""When a scene has become unsuitable for any task: the detector of the heuristic scene reset.

A body is unsuitable (paper, Section 5: "unrecoverable") if its centre is where the end effector cannot go, if it
fell off the table or, being a receptacle, lies on its edge, or if the front camera does not see its centre.
"""

from enum import StrEnum

import numpy as np

from lerobot_env_cronos.benchmark.configurations import footprint_corners, sample_place
from lerobot_env_cronos.scene.model import camera_axes
from lerobot_env_cronos.scene.robot import EE_HIGH, EE_LOW
from lerobot_env_cronos.simulation.simulation import Simulation

CAMERA = "front"
"""The view that decides whether a body is seen; a square picture, whatever the observation."""
MAX_RECEPTACLE_TILT_RAD = np.deg2rad(60)

LOW_HAND_M, HAND_HALF_M = 0.15, 0.06
"""Below this height of the end effector, a body is not put back under the hand [m]."""
DROP_HEIGHT_M = 0.10
"""From where a body falls for which there is no free place [m]."""


class Unsuitable(StrEnum):
    """Why a body has to be put back."""

    OUTSIDE = "outside"
    """Its centre is outside the box that the end effector moves in, seen from above."""
    FALLEN = "fallen"
    """Its centre is below the table's surface, or a receptacle lies on its edge."""
    UNSEEN = "unseen"
    """Its centre is outside the picture of the front camera."""


def find_unsuitable(simulation: Simulation) -> dict[Unsuitable, np.ndarray]:
    """Return for each reason which bodies of which simulations it applies to, (n, bodies) bool."""
    position = simulation.body_poses()[..., :3]
    outside = np.asarray((position[..., :2] < EE_LOW[:2]) | (position[..., :2] > EE_HIGH[:2])).any(-1)
    flat = np.array([name in simulation.scene.receptacles for name in simulation.scene.bodies])
    # Lying upside down is as good as lying upright.
    upright = np.abs(simulation.body_rotations()[..., 2, 2])
    on_edge = flat & (upright < np.cos(MAX_RECEPTACLE_TILT_RAD))
    return {
        Unsuitable.OUTSIDE: np.asarray(outside),
        Unsuitable.FALLEN: np.asarray((position[..., 2] < 0.0) | on_edge),
        Unsuitable.UNSEEN: np.asarray(~is_in_view(position)),
    }


def is_in_view(points: np.ndarray, camera: str = CAMERA) -> np.ndarray:
    """Whether points (..., 3) in the base frame [m] lie inside a square picture of `camera`: (...,) bool."""
    origin, rotation, half_view = camera_axes(camera)
    x, y, z = np.moveaxis((points - origin) @ rotation, -1, 0)
    # A camera looks along its -z axis.
    limit = -z * np.tan(half_view)
    return (z < 0) & (np.abs(x) <= limit) & (np.abs(y) <= limit)


def find_free_pose(simulation: Simulation, stream: int, body: str, rng: np.random.Generator) -> np.ndarray:
    """Draw a pose (7,) on the table's spawn area, clear of the other bodies and of a low hand.

    If there is none, it is a random one, above the others.
    """
    scene = simulation.scene
    poses = dict(zip(scene.bodies, simulation.body_poses()[stream], strict=True))
    others = [
        footprint_corners(name, pose[:2], 2 * np.arctan2(pose[6], pose[3]))
        for name, pose in poses.items()
        if name != body
    ]
    hand = simulation.end_effector()[0][stream]
    if hand[2] < LOW_HAND_M:
        others.append(hand[:2] + HAND_HALF_M * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]))
    try:
        return sample_place(scene, body, others, rng)[0]
    except RuntimeError:
        pose = sample_place(scene, body, [], rng)[0]
        pose[2] += DROP_HEIGHT_M
        return pose
