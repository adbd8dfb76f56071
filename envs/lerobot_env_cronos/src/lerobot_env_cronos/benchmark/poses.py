"""What can be wrong with the poses of somebody else's configurations."""

from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from lerobot_env_cronos.scene.arms.arm import Arm
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.scene.scenes import Scene

SAME_PLACE_M, SAME_ANGLE_RAD = 0.005, np.deg2rad(5)
"""Two configurations are the same if no body is further away than this from where it is in the other."""
MAX_OVERLAP_M = 0.0015
"""How deep bodies may stand in one another; at rest on something they sink in by less than a millimetre."""


def find_fault(arm: Arm, pose: np.ndarray) -> str | None:
    """What is wrong with the pose (7,) of a body by itself, for an arm, if anything."""
    if not np.isfinite(pose).all():
        return f"has a pose that is not finite: {pose.tolist()}"
    if not arm.is_within(pose[:2]):
        return f"at {pose[:2].tolist()} m is out of the arm's reach ({arm.workspace} m)"
    if not 0 <= pose[2] <= arm.high[2]:
        return f"must be between the table and the top of the workspace, 0 to {arm.high[2]} m, got z = {pose[2]} m"
    norm = np.linalg.norm(pose[3:])
    return None if abs(norm - 1) < 1e-3 else f"has a quaternion of length {norm:.4f}, not 1"


def are_same(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which pairs of configurations, poses (n, bodies, 7) and (m, bodies, 7), are the same, (n, m) bool.

    A quaternion and its negative are one orientation.
    """
    same = np.empty((len(poses), len(others)), dtype=bool)
    for row, pose in zip(same, poses, strict=True):
        distance = np.linalg.norm(others[..., :3] - pose[:, :3], axis=-1)
        norms = np.linalg.norm(others[..., 3:], axis=-1) * np.linalg.norm(pose[:, 3:], axis=-1)
        cosine = np.abs((others[..., 3:] * pose[:, 3:]).sum(-1)) / norms
        angle = 2 * np.arccos(np.minimum(cosine, 1.0))
        row[:] = ((distance <= SAME_PLACE_M) & (angle <= SAME_ANGLE_RAD)).all(-1)
    return same


def find_overlaps(scene: Scene, poses: np.ndarray) -> Iterator[str | None]:
    """For each configuration of `poses` (n, bodies, 7), what stands deepest in what, if anything does."""
    return map(make_overlap_finder(scene), poses)


def make_overlap_finder(scene: Scene) -> Callable[[np.ndarray], str | None]:
    """A function of a configuration (bodies, 7) that says what stands deepest in what, if anything does.

    The shapes are those that collide in the simulation, with the arm at home: bodies may lie on one another.
    """
    model = build_model(scene, looks=False)
    data = mujoco.MjData(model)

    def find_overlap(configuration: np.ndarray) -> str | None:
        data.qpos[:] = [*scene.robot.home_qpos, *configuration.ravel()]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        touching = [c for c in data.contact if set(scene.bodies) & {_name(model, geom) for geom in c.geom}]
        deepest = min(touching, key=lambda contact: contact.dist, default=None)
        if deepest is None or deepest.dist > -MAX_OVERLAP_M:
            return None
        first, second = sorted(
            (_name(model, geom) for geom in deepest.geom), key=lambda name: name not in scene.bodies
        )
        return f"the {first} stands {-1000 * deepest.dist:.1f} mm deep in the {second}"

    return find_overlap


def find_bad_row(scene: Scene, poses: np.ndarray) -> tuple[int, str] | None:
    """The first of the configurations (n, bodies, 7) that cannot be used, and why."""
    for i, configuration in enumerate(poses):
        for body, pose in zip(scene.bodies, configuration, strict=True):
            if why := find_fault(scene.robot, pose):
                return i, f"the {body} {why}"
    return next(((i, why) for i, why in enumerate(find_overlaps(scene, poses)) if why is not None), None)


def find_shared_row(held_out: np.ndarray, train: np.ndarray) -> tuple[int, str] | None:
    """The first of the held-out configurations (n, bodies, 7) that is a training configuration, and which."""
    for i, same in enumerate(are_same(held_out, train)):
        if same.any():
            return i, f"the same as training configuration {np.argmax(same)}: it is not held out"
    return None


def _name(model: mujoco.MjModel, geom: int) -> str:
    body = model.geom_bodyid[geom]
    return model.body(body).name if body else model.geom(geom).name
