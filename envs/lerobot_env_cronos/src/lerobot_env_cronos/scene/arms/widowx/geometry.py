"""The WidowX-250 6-DoF arm (WX250S): kinematics and inertias as published by Interbotix.

Lengths in m, masses in kg, inertias in kg m^2, angles in rad, quaternions (w, x, y, z), everything in the
parent's frame. The base frame is the world frame: x forward, y left, z up, table surface at z = 0.
"""

import numpy as np

from lerobot_env_cronos.scene.arms.arm import Link

HOME_QPOS = np.array([-0.01840777, 0.0398835, 0.22242722, -0.00460194, 1.36524296, 0.00153398])
"""Start pose of the six arm joints, measured on the Bridge set-up by SimplerEnv [rad]."""

ARM_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
FINGER_OPEN, FINGER_CLOSED = 0.037, 0.015
"""Joint positions of the left finger; the right one mirrors it [m]."""

EE_SITE = "end_effector"
EE_OFFSET = np.array([0.093, 0.0, 0.0])
"""The URDF's ee_gripper_link in the frame of gripper_link: between the finger pads [m]."""

EE_LOW, EE_HIGH = np.array([0.10, -0.30, 0.0]), np.array([0.50, 0.30, 0.35])
"""The workspace: the box that the end effector's target is clamped to [m]."""

FINGERTIP_REACH = 0.031
"""How far the fingertips extend beyond the end-effector site along the fingers [m]."""

ARM_KP, ARM_ARMATURE = 400.0, 0.1
GRIPPER_KP, GRIPPER_FORCE_LIMIT = 1000.0, 20.0
ARM_FORCE_LIMIT = (200.0, 200.0, 100.0, 100.0, 100.0, 100.0)
"""Torque limits of SimplerEnv's system identification [N m]."""

PALM_SOLREF = (0.02, 1.0)

LINKS = (
    Link("shoulder_link", "base_link", (0, 0, 0.072), 0.480879, (2.23482e-05, 4.14609e-05, 0.0066287),
         (0.0130352, 0.706387, 0.012996, 0.707586), (0.000588946, 0.000555655, 0.000378999),
         "waist", (0, 0, 1), (-3.14158, 3.14158)),
    Link("upper_arm_link", "shoulder_link", (0, 0, 0.03865), 0.430811, (0.0171605, 2.725e-07, 0.191323),
         (0.705539, 0.0470667, -0.0470667, 0.705539), (0.00364425, 0.003463, 0.000399348),
         "shoulder", (0, 1, 0), (-1.88496, 1.98968)),
    Link("upper_forearm_link", "upper_arm_link", (0.04975, 0, 0.25), 0.234589, (0.107963, 0.000115876, 0),
         (0.000980829, 0.707106, -0.000980829, 0.707106), (0.000888, 0.000887807, 3.97035e-05),
         "elbow", (0, 1, 0), (-2.14675, 1.6057)),
    Link("lower_forearm_link", "upper_forearm_link", (0.175, 0, 0), 0.220991, (0.0374395, 0.00522252, 0),
         (-0.0732511, 0.703302, 0.0732511, 0.703302), (0.0001834, 0.000172527, 5.88633e-05),
         "forearm_roll", (1, 0, 0), (-3.14158, 3.14158)),
    Link("wrist_link", "lower_forearm_link", (0.075, 0, 0), 0.084957, (0.04236, -1.0663e-05, 0.010577),
         (0.608721, 0.363497, -0.359175, 0.606895), (3.29057e-05, 3.082e-05, 2.68343e-05),
         "wrist_angle", (0, 1, 0), (-1.74533, 2.14675)),
    Link("gripper_link", "wrist_link", (0.065, 0, 0), 0.110084, (0.0325296, 4.2061e-07, 0.0090959),
         (0.546081, 0.419626, 0.62801, 0.362371), (0.00307592, 0.00307326, 0.0030332),
         "wrist_rotate", (1, 0, 0), (-3.14158, 3.14158)),
)  # fmt: skip

FINGER_POS = (0.066, 0.0, 0.0)
FINGER_MASS, FINGER_COM = 0.016246, (0.013816, 0.0, 0.0)
FINGER_DIAGINERTIA = (4.79509e-06, 3.7467e-06, 1.48651e-06)
PAD_POS, PAD_HALF_SIZE = (0.042, -0.009, 0.0), (0.014, 0.003, 0.016)
