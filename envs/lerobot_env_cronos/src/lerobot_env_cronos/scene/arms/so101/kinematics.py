"""Kinematics of the SO-101 in closed form, and what gravity asks of its servos, for many streams at once.

Frames: w the world (= robot base), e the end effector, which has the axes of the body `gripper`: the fingers point
along -z, the jaws close along x. Shapes lead with n, the number of streams; the five joints are those of the arm.
"""

import numpy as np

from lerobot_env_cronos.scene.arms.so101.geometry import (
    BASE_POS,
    BASE_QUAT,
    EE_OFFSET,
    JOINT_HIGH,
    JOINT_LOW,
    LINKS,
)
from lerobot_env_cronos.scene.rotations import quaternion_to_matrix

NUM_JOINTS = 5
GRAVITY = 9.81

_POS = np.array([link.pos for link in LINKS])
_ROTATION = quaternion_to_matrix(np.array([link.quat for link in LINKS]))
_BASE_POS, _BASE_ROTATION = np.array(BASE_POS), quaternion_to_matrix(np.array(BASE_QUAT))
_COM, _MASS = np.array([link.com for link in LINKS]), np.array([link.mass for link in LINKS])


def _frames(q: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Origins (n, 3) and rotations (n, 3, 3) of the five links' frames, after their joints turned by q (n, 5)."""
    n = len(q)
    cos, sin = np.cos(q), np.sin(q)
    p, R = np.broadcast_to(_BASE_POS, (n, 3)), np.broadcast_to(_BASE_ROTATION, (n, 3, 3))
    origins, rotations = [], []
    for j in range(NUM_JOINTS):
        p = p + R @ _POS[j]
        A = R @ _ROTATION[j]
        c, s = cos[:, j, None], sin[:, j, None]
        # All joints turn about the z axis of their link.
        R = np.stack([c * A[..., 0] + s * A[..., 1], c * A[..., 1] - s * A[..., 0], A[..., 2]], axis=-1)
        origins.append(p)
        rotations.append(R)
    return origins, rotations


def forward_kinematics(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position p_we (n, 3) [m] and rotation R_we (n, 3, 3) of the end effector at joint positions (n, 5) [rad]."""
    origins, rotations = _frames(q)
    return origins[-1] + rotations[-1] @ EE_OFFSET, rotations[-1]


def gravity_torque(q: np.ndarray) -> np.ndarray:
    """Torque (n, 5) that holds the empty arm at joint positions (n, 5) [N m]; the jaw counts as closed."""
    origins, rotations = _frames(q)
    coms = [p + R @ com for p, R, com in zip(origins, rotations, _COM, strict=False)]
    coms.append(origins[-1] + rotations[-1] @ (_POS[-1] + _ROTATION[-1] @ _COM[-1]))
    torque = np.zeros((len(q), NUM_JOINTS))
    for j in range(NUM_JOINTS):
        axis = rotations[j][..., 2]
        for com, mass in zip(coms[j:], _MASS[j:], strict=True):
            lever = com - origins[j]
            # The vertical part of the axis times the lever: how much a turn lifts the mass.
            torque[:, j] += mass * GRAVITY * (axis[:, 0] * lever[:, 1] - axis[:, 1] * lever[:, 0])
    return torque


def _side_view() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radius and height of the lift axis (2,), and upper arm and forearm as vectors (2,), at the zero pose [m]."""
    lift, elbow, wrist = (p[0, [0, 2]] for p in _frames(np.zeros((1, NUM_JOINTS)))[0][1:4])
    return lift, elbow - lift, wrist - elbow


_SHOULDER, *_SEGMENTS = _side_view()
_UPPER, _FORE = (float(np.hypot(*segment)) for segment in _SEGMENTS)
_UPPER_ANGLE, _FORE_ANGLE = (float(np.arctan2(z, r)) for r, z in _SEGMENTS)
_WRIST_TO_HAND = float(np.linalg.norm(_POS[4][:2]))
"""From the wrist's axis to the origin of the hand's frame, along the fingers [m]."""
_ASIDE = float(_frames(np.zeros((1, NUM_JOINTS)))[0][4][0, 1])
"""Of that origin from the plane through the pan axis in which the arm bends [m]."""


def inverse_kinematics(p: np.ndarray, yaw: np.ndarray, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The joint positions at which the hand points down, or tilts outwards.

    Args:
        p: (n, 3) of the end effector [m].
        yaw: (n,) of the closing axis, from the fixed to the moving jaw, seen from above [rad].
        tilt: (n,) of the fingers away from the robot, from straight down [rad].

    Returns:
        (n, 5) joint positions within their ranges [rad], and (n,) bool, whether the hand gets there with them.
    """
    azimuth = np.arctan2(p[:, 1], p[:, 0])
    # The end effector is 8 mm off the plane in which the arm bends: three rounds are exact to a hundredth of that.
    for _ in range(3):
        hand = p - hand_rotation(azimuth, yaw - azimuth, tilt) @ EE_OFFSET
        away = np.hypot(hand[:, 0], hand[:, 1])
        azimuth = np.arctan2(hand[:, 1], hand[:, 0]) - np.arcsin(_ASIDE / np.maximum(away, abs(_ASIDE)))
    # Near the pan axis, or beyond it, they are not.
    is_exact = np.linalg.norm(p - hand_rotation(azimuth, yaw - azimuth, tilt) @ EE_OFFSET - hand, axis=1) < 1e-3
    r = away - _WRIST_TO_HAND * np.sin(tilt) - _SHOULDER[0]
    z = hand[:, 2] + _WRIST_TO_HAND * np.cos(tilt) - _SHOULDER[1]
    distance, angle = np.maximum(np.hypot(r, z), 1e-6), np.arctan2(z, r)
    upper = (_UPPER**2 + distance**2 - _FORE**2) / (2 * _UPPER * distance)
    fore = (_FORE**2 + distance**2 - _UPPER**2) / (2 * _FORE * distance)
    # The elbow points up. A larger joint angle turns what follows down.
    lift = _UPPER_ANGLE - (angle + np.arccos(np.clip(upper, -1, 1)))
    elbow = _FORE_ANGLE - (angle - np.arccos(np.clip(fore, -1, 1))) - lift
    roll = (yaw - azimuth + np.pi) % (2 * np.pi) - np.pi
    q = np.stack([-azimuth, lift, elbow, np.pi / 2 - tilt - lift - elbow, roll], axis=1)
    within = np.clip(q, JOINT_LOW[:NUM_JOINTS], JOINT_HIGH[:NUM_JOINTS])
    return within, is_exact & (within == q).all(1) & (np.abs(upper) <= 1) & (np.abs(fore) <= 1)


def hand_rotation(azimuth: np.ndarray, roll: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Rotation (n, 3, 3) of a hand in the arm's plane at `azimuth`, tilted outwards and then rolled."""
    ca, sa, ct, st = np.cos(azimuth), np.sin(azimuth), np.cos(tilt), np.sin(tilt)
    # At no roll: closing outwards along the plane, fingers down along -z.
    x = np.stack([ct * ca, ct * sa, st], 1)
    z = np.stack([-st * ca, -st * sa, ct], 1)
    y = np.cross(z, x)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * x + s * y, c * y - s * x, z], axis=2)
