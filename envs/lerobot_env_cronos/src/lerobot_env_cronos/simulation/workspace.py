"""When a scene has become unsuitable for any task: the detector of the heuristic scene reset.

A body is unsuitable (paper, Section 5: "unrecoverable") if its centre is where the end effector cannot go, if it
fell off the table or, being a receptacle, lies on its edge, or if the front camera does not see its centre.
"""

from enum import StrEnum
from functools import partial

import numpy as np

from lerobot_env_cronos.benchmark.configurations import Place, draw_spawn_place, footprint_corners, sample_place
from lerobot_env_cronos.scene.cameras import is_spawn_area_in_view
from lerobot_env_cronos.scene.scenes import BODIES, Scene
from lerobot_env_cronos.simulation.simulation import Simulation

MAX_RECEPTACLE_TILT_RAD = np.deg2rad(60)

LOW_HAND_M, HAND_HALF_M = 0.15, 0.06
"""Below this height of the end effector, a body is not put back under the hand [m]."""
DROP_HEIGHT_M = 0.10
"""From where a body falls for which there is no free place [m]."""
MAX_VIEW_DRAWS = 100
"""Draws for a place that the camera sees; in a spawn area without one the last draw is taken."""


class Unsuitable(StrEnum):
    """Why a body has to be put back."""

    OUTSIDE = "outside"
    """Its centre is where the end effector does not get to, seen from above."""
    FALLEN = "fallen"
    """Its centre is below the table's surface, or a receptacle lies on its edge."""
    UNSEEN = "unseen"
    """Its centre is outside the picture of the front camera."""


def find_unsuitable(simulation: Simulation) -> dict[Unsuitable, np.ndarray]:
    """Return for each reason which bodies of which simulations it applies to, (n, bodies) bool."""
    position = simulation.body_poses()[..., :3]
    arm = simulation.scene.robot
    flat = np.array([name in simulation.scene.receptacles for name in simulation.scene.bodies])
    # Lying upside down is as good as lying upright.
    upright = np.abs(simulation.body_rotations()[..., 2, 2])
    on_edge = flat & (upright < np.cos(MAX_RECEPTACLE_TILT_RAD))
    return {
        Unsuitable.OUTSIDE: np.asarray(~arm.is_within(position[..., :2])),
        Unsuitable.FALLEN: np.asarray((position[..., 2] < 0.0) | on_edge),
        Unsuitable.UNSEEN: np.asarray(~arm.sees(position)),
    }


def _draw_place_in_view(scene: Scene, body: str, rng: np.random.Generator) -> Place:
    for _ in range(MAX_VIEW_DRAWS):
        xy, yaw = draw_spawn_place(scene, body, rng)
        if scene.robot.sees(np.array([*xy, BODIES[body].size[2] / 2])):
            break
    return xy, yaw


def find_free_pose(simulation: Simulation, stream: int, body: str, rng: np.random.Generator) -> np.ndarray:
    """Draw a pose (7,) on the table's spawn area, in view, clear of the other bodies and of a low hand.

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
    draw = None if is_spawn_area_in_view(scene, BODIES[body]) else partial(_draw_place_in_view, scene)
    try:
        return sample_place(scene, body, others, rng, draw)[0]
    except RuntimeError:
        pose = sample_place(scene, body, [], rng, draw)[0]
        pose[2] += DROP_HEIGHT_M
        return pose
