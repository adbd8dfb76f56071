"""The SO-101: link frames and inertias of TheRobotStudio's model (new calibration, Apache-2.0), and its servo.

Lengths in m, masses in kg, inertias in kg m^2, angles in rad, quaternions (w, x, y, z), everything in the parent's
frame. The base frame is the world frame: x forward, y left, z up, table surface at z = 0; the pan axis is at its
origin.
"""

import numpy as np

from lerobot_env_cronos.scene.arms.arm import Link

HALF = np.sqrt(0.5)
BASE_POS, BASE_QUAT = (-0.023075, -0.020791, -0.0301), (HALF, 0.0, 0.0, HALF)
"""Of the body `base`, whose foot stands on the table."""


def _degrees(low: float, high: float) -> tuple[float, float]:
    return float(np.deg2rad(low)), float(np.deg2rad(high))


# The elbow's range is symmetric, as those of the others: LeRobot's 0 is the middle of what was calibrated.
LINKS = (
    Link("shoulder", "base", (0.020791, -0.023075, 0.094882), 0.100006, (-0.03076, -1.7e-05, -0.025271),
         (0.999865, 0.001496, 0.009708, 0.013204), (8.3784e-05, 8.1039e-05, 2.3955e-05),
         "shoulder_pan", (0, 0, 1), _degrees(-110, 110), (0.0, -HALF, -HALF, 0.0)),
    Link("upper_arm", "shoulder", (-0.030399, -0.018278, -0.0542), 0.103, (-0.089847, -0.008382, 0.018409),
         (0.453195, 0.454063, 0.541891, 0.542951), (0.000150873, 0.000142487, 3.7245e-05),
         "shoulder_lift", (0, 0, 1), _degrees(-100, 100), (0.5, -0.5, -0.5, -0.5)),
    Link("lower_arm", "upper_arm", (-0.11257, -0.028, 0.0), 0.104, (-0.09807, 0.003244, 0.018283),
         (0.510729, 0.517006, 0.487966, 0.483477), (0.000160262, 0.000145304, 2.8312e-05),
         "elbow_flex", (0, 0, 1), _degrees(-96.8, 96.8), (HALF, 0.0, 0.0, HALF)),
    Link("wrist", "lower_arm", (-0.1349, 0.0052, 0.0), 0.079, (-0.000103, -0.038614, 0.028116),
         (0.967143, 0.254226, 0.001622, -0.000146), (3.6826e-05, 2.7447e-05, 1.8943e-05),
         "wrist_flex", (0, 0, 1), _degrees(-95, 95), (HALF, 0.0, 0.0, -HALF)),
    Link("gripper", "wrist", (0.0, -0.0611, 0.0181), 0.087, (0.000214, 0.000245, -0.025187),
         (0.600717, 0.355993, 0.35863, 0.61951), (4.3373e-05, 3.7723e-05, 2.4284e-05),
         "wrist_roll", (0, 0, 1), _degrees(-160, 160), (0.0, 0.0, -HALF, -HALF)),
    Link("moving_jaw", "gripper", (0.0202, 0.0188, -0.0234), 0.012, (-0.001575, -0.030024, 0.019276),
         (0.695265, 0.717965, -0.024562, -0.02301), (6.636e-06, 5.291e-06, 1.865e-06),
         "gripper", (0, 0, 1), _degrees(-10, 100), (HALF, HALF, 0.0, 0.0)),
)  # fmt: skip
"""Each with its joint; the last joint is the gripper's."""
JOINTS = tuple(link.joint for link in LINKS)
JOINT_LOW, JOINT_HIGH = (np.array([link.range[i] for link in LINKS]) for i in range(2))

EE_SITE = "end_effector"
EE_OFFSET = np.array([-0.0079, -0.000218, -0.098127])
"""The end effector in the frame of `gripper`: on the fixed jaw's inner face [m]. Fingers point along -z."""
FINGERTIP_REACH = 0.0063
"""How far the fingertips extend beyond the end effector along the fingers [m]."""

# Rhoban's identification of the STS3215 has 18.8 N m/rad at P = 32 and 7.4 V; LeRobot writes P = 16, and half of
# the torque to the gripper. Other public models are 50 times as stiff, which does not fit the measured law.
SERVO_KP, SERVO_DAMPING, SERVO_FRICTIONLOSS, SERVO_ARMATURE = 8.9, 0.6, 0.052, 0.028
"""N m/rad, N m s/rad, N m, kg m^2."""
SERVO_TORQUE, GRIPPER_TORQUE = 3.35, 1.67
"""What a servo stalls at [N m]."""

PAD_FRICTION = (1.0, 0.02, 0.001)
Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lowest and highest corner in a body's frame [m]."""
# The steps of the jaws are those of the meshes: on one flat pad things slip twice as far.
FIXED_JAW: tuple[Box, ...] = (
    ((-0.0152, -0.0050, -0.1044), (-0.0079, 0.0046, -0.0944)),
    ((-0.0185, -0.0064, -0.0944), (-0.0099, 0.0060, -0.0844)),
    ((-0.0226, -0.0078, -0.0844), (-0.0116, 0.0074, -0.0648)),
    ((-0.0300, -0.0108, -0.0648), (-0.0133, 0.0104, -0.0451)),
)
MOVING_JAW: tuple[Box, ...] = (
    ((-0.0123, -0.0810, 0.0141), (-0.0055, -0.0720, 0.0237)),
    ((-0.0103, -0.0720, 0.0128), (0.0005, -0.0620, 0.0250)),
    ((-0.0083, -0.0620, 0.0106), (0.0045, -0.0220, 0.0272)),
)
HOUSINGS: dict[str, tuple[Box, ...]] = {
    "base": (((-0.0347, -0.0489, 0.0301), (0.0763, 0.0467, 0.1021)),),
    "shoulder": (((-0.0506, -0.0264, -0.0644), (0.0122, 0.0287, 0.0300)),),
    "upper_arm": (((-0.1302, -0.0382, -0.0135), (0.0120, 0.0120, 0.0538)),),
    "lower_arm": (((-0.1451, -0.0150, -0.0120), (0.0120, 0.0219, 0.0524)),),
    "wrist": (((-0.0200, -0.0658, -0.0090), (0.0157, 0.0120, 0.0533)),),
    "gripper": (
        ((-0.0352, -0.0162, -0.0451), (-0.0150, 0.0158, -0.0330)),
        ((-0.0350, -0.0240, -0.0371), (0.0300, 0.0240, -0.0050)),
    ),
    "moving_jaw": (((-0.0100, -0.0210, -0.0040), (0.0085, 0.0, 0.0420)),),
}
"""What else of the arm collides, by body: no workspace keeps absolute joint targets above the table."""
