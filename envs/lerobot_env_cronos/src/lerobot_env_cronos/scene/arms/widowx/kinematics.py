"""Batched forward and inverse kinematics of the WidowX, in numpy, for many streams at once.

Frames: w the world (= robot base), e the end-effector site. Shapes lead with n, the number of streams.
"""

import numpy as np

from lerobot_env_cronos.scene.arms.widowx.geometry import EE_OFFSET, LINKS
from lerobot_env_cronos.scene.rotations import matrix_to_rotation_vector

_OFFSETS = np.array([link.pos for link in LINKS])  # (6, 3) joint positions in the parent frame [m]
_AXES = np.array([link.axis for link in LINKS], dtype=float)  # (6, 3)
_AXIS_INDEX = _AXES.argmax(axis=1)
JOINT_LOW = np.array([link.range[0] for link in LINKS])
JOINT_HIGH = np.array([link.range[1] for link in LINKS])
TARGET_LOW = np.maximum(JOINT_LOW, [-1.6, -np.inf, -1.2, -1.6, 0.1, -np.inf])
TARGET_HIGH = np.minimum(JOINT_HIGH, [1.6, np.inf, np.inf, 1.6, np.inf, np.inf])
"""Range of the joint targets [rad]. It keeps the arm on the branch of its home pose: facing the table, elbow up,
wrist down. On another branch small motions of the hand lead nowhere but into the joint limits, for good."""


def forward_kinematics(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose and geometric Jacobian of the end-effector site.

    Args:
        q: (n, 6) joint positions [rad].

    Returns:
        p_we (n, 3) [m], R_we (n, 3, 3), and the Jacobian (n, 6, 6): linear rows, then angular rows, world frame.
    """
    n = len(q)
    R = np.broadcast_to(np.eye(3), (n, 3, 3))
    p = np.zeros((n, 3))
    origins, axes = np.empty((6, 3, n)), np.empty((6, 3, n))
    turns = _joint_rotations(q)
    for j in range(6):
        p = p + R @ _OFFSETS[j]
        origins[j], axes[j] = p.T, R[:, :, _AXIS_INDEX[j]].T
        R = R @ turns[j]
    p = p + R @ EE_OFFSET
    (ax, ay, az), (x, y, z) = axes.swapaxes(0, 1), (p.T - origins).swapaxes(0, 1)
    # The cross product of each axis with its lever, written out: this is called several times a control step.
    linear = np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x])
    jacobian = np.concatenate([linear, axes.swapaxes(0, 1)]).transpose(2, 0, 1)
    return p, R, np.ascontiguousarray(jacobian)


def _joint_rotations(q: np.ndarray) -> np.ndarray:
    """Rotations (6, n, 3, 3) of the joints at positions (n, 6)."""
    joints, k = np.arange(6), _AXIS_INDEX
    i, j = (k + 1) % 3, (k + 2) % 3
    cos, sin = np.cos(q).T, np.sin(q).T
    turns = np.zeros((6, len(q), 3, 3))
    turns[joints, :, k, k] = 1.0
    turns[joints, :, i, i] = turns[joints, :, j, j] = cos
    turns[joints, :, i, j], turns[joints, :, j, i] = -sin, sin
    return turns


def inverse_kinematics(
    q: np.ndarray,
    p_target: np.ndarray,
    R_target: np.ndarray,
    iterations: int = 4,
    damping: float = 0.02,
    pose: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Damped least squares from `q` towards a target pose (Nakamura and Hanafusa 1986).

    Args:
        q: (n, 6) joint positions to start from [rad].
        p_target: (n, 3) [m].
        R_target: (n, 3, 3).
        iterations: steps towards it.
        damping: of the least squares.
        pose: `forward_kinematics(q)`, if it is known.

    Returns:
        (n, 6) joint positions between TARGET_LOW and TARGET_HIGH; the closest that `iterations` steps found.
    """
    for k in range(iterations):
        p, R, jacobian = pose if k == 0 and pose is not None else forward_kinematics(q)
        error = np.concatenate([p_target - p, matrix_to_rotation_vector(R_target @ R.transpose(0, 2, 1))], axis=1)
        # Rotations weigh 0.3 m/rad, so that a position error is not traded for a tiny rotation error.
        weight = np.array([1, 1, 1, 0.3, 0.3, 0.3])
        Jw, ew = jacobian * weight[:, None], error * weight
        JJt = Jw @ Jw.transpose(0, 2, 1) + damping**2 * np.eye(6)
        step = (Jw.transpose(0, 2, 1) @ np.linalg.solve(JJt, ew[..., None]))[..., 0]
        q = np.clip(q + np.clip(step, -0.4, 0.4), TARGET_LOW, TARGET_HIGH)
    return q
