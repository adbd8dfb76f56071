"""What the expert knows of a hand: its sizes, what is easy for it, and how it goes where the expert wants it.

A grasp is a point in the middle between the pads and a closing axis; the hand points down. Shapes lead with n, the
number of streams; c is the number of grasps or places that are compared.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from lerobot_env_cronos.scene.arms.arm import Pose
from lerobot_env_cronos.scene.arms.so101 import kinematics as so101
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM, from_joints
from lerobot_env_cronos.scene.arms.so101.geometry import FINGERTIP_REACH as SO101_FINGERTIP_REACH
from lerobot_env_cronos.scene.arms.so101.geometry import SERVO_KP
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from lerobot_env_cronos.scene.arms.widowx.geometry import (
    EE_OFFSET,
    FINGER_OPEN,
    FINGER_POS,
    FINGERTIP_REACH,
    HOME_QPOS,
    PAD_HALF_SIZE,
    PAD_POS,
)
from lerobot_env_cronos.scene.arms.widowx.kinematics import forward_kinematics, inverse_kinematics
from lerobot_env_cronos.scene.rotations import matrix_to_rotation_vector

OPEN, CLOSE = 1.0, 0.0
WRIST_LIMIT = 2.6
"""Turn of the last joint beyond which a grasp or a place is not chosen [rad]."""


class Command(NamedTuple):
    """What the hands of n streams should do."""

    position: np.ndarray
    """(n, 3) where the end effector should go [m]."""
    closing: np.ndarray
    """(n, 3) the horizontal direction that its closing axis should have."""
    gripper: np.ndarray
    """(n, 1) OPEN or CLOSE."""


class Hand(ABC):
    """A hand and its arm, as the expert sees them. Lengths in m."""

    pad_half: tuple[float, float, float]
    """Half extents of a pad: along the fingers, of its thickness, across."""
    palm_half: tuple[float, float]
    """Of the palm: along the closing axis, across."""
    palm_height: float
    """Of the palm's underside above the middle of the pads."""
    tip_reach: float
    """How far the fingertips extend beyond the end effector."""
    tip_clearance: float
    """The fingertips stay this far above what lies under them, give or take 2 mm."""
    max_width: float
    """Widest graspable side, with room for each finger."""
    hover: float
    """Height above the grasp or the place at which the hand travels."""
    lift = 0.0
    """Height above the place to which what is held is lifted until that counts as carried; a fast arm needs it."""
    retreat: float
    """Height at which the hand waits once the task is complete."""
    near, far = 0.0, 0.0
    """Distances from the robot's axis between which a hand that points down goes everywhere with ease."""
    empty_opening: float
    """Gripper opening (0 to 1) below which there is nothing between the fingers."""
    widest_opening: float
    """Gripper opening from which on fingers press on a side too wide for them, which is no grasp."""
    closes_along: int
    """Column of the end effector's rotation that is the closing axis."""

    def reach_cost(self, point: np.ndarray) -> np.ndarray:
        """Cost (...) of points (..., 2 or 3) that the arm only reaches stretched out, or folded up [m]."""
        r = np.linalg.norm(point[..., :2], axis=-1)
        return 40.0 * np.maximum(r - self.far, 0.0) + 40.0 * np.maximum(self.near - r, 0.0)

    def wrist_cost(self, arm: np.ndarray, point: np.ndarray, hand_yaw: np.ndarray) -> np.ndarray:
        """Cost (...) of turning a hand that points down to a yaw of its closing axis, far from the wrist's limits.

        Args:
            arm: (..., j) joint positions [rad].
            point: (..., 2 or 3) where [m].
            hand_yaw: (...,) [rad].
        """
        wrist = self.wrist_at(np.arctan2(point[..., 1], point[..., 0]), hand_yaw)
        turn = wrist - arm[..., -1]
        return 0.25 * np.abs(turn) + 0.15 * np.abs(wrist) + 10.0 * (np.abs(wrist) > WRIST_LIMIT)

    @abstractmethod
    def wrist_at(self, azimuth: np.ndarray, hand_yaw: np.ndarray) -> np.ndarray:
        """The last joint of a hand that points down, at an azimuth and a yaw of its closing axis [rad]."""

    @abstractmethod
    def pad_offsets(self, width: np.ndarray) -> tuple[np.ndarray | float, ...]:
        """Signed distances along the closing axis at which the pads come past things, around a side of a width."""

    @abstractmethod
    def to_end_effector(self, middle: np.ndarray, closing: np.ndarray, width: np.ndarray) -> np.ndarray:
        """Where the end effector is (n, 3) when an open hand is around (n, 3), a side of a width (n,)."""

    @abstractmethod
    def to_middle(self, position: np.ndarray, closing: np.ndarray, width: np.ndarray) -> np.ndarray:
        """The middle of the pads (n, 3) that hold a side of a width (n,), the end effector being at (n, 3)."""

    @abstractmethod
    def target_pose(self, target: np.ndarray) -> Pose:
        """The end effector's pose that joint targets (n, j) are meant for."""

    @abstractmethod
    def held_width(self, opening: np.ndarray) -> np.ndarray:
        """Width (n,) of what is between closed fingers, from their opening (n,)."""

    @abstractmethod
    def still_opening(self, opening: np.ndarray, width: np.ndarray) -> np.ndarray:
        """Height (n,) above the grasp at which fingers that are still opening wait."""

    @abstractmethod
    def has_let_go(self, opening: np.ndarray, width: np.ndarray) -> np.ndarray:
        """Whether the fingers are open enough (n,) to leave what was between them."""

    @abstractmethod
    def act(self, target: np.ndarray, command: Command, width: np.ndarray) -> np.ndarray:
        """The action (n, a) that follows a command, within bounds.

        Args:
            target: (n, j) the last joint targets [rad].
            command: see there.
            width: (n,) of the side to grasp, or that is held.
        """

    @abstractmethod
    def gets_to(self, position: np.ndarray, yaw: float) -> np.ndarray:
        """Whether the hand gets to positions (n, 3), closing along a yaw and pointing down: (n,) bool."""


def horizontal(v: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) as horizontal unit vectors."""
    v = v * [1, 1, 0]
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-6)


def wrap(angle: np.ndarray) -> np.ndarray:
    """Angles wrapped into [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


PAD_BELOW_EE = FINGER_POS[0] + PAD_POS[0] - EE_OFFSET[0]
"""Height of the WidowX's end-effector site above the centre of the pads when the hand points down [m]."""
FINGER_Y = FINGER_OPEN - abs(PAD_POS[1])
"""Distance of an open pad from the middle of the hand [m]."""
POSITION_TOLERANCE_M, TILT_TOLERANCE_RAD = 0.004, np.deg2rad(5)
"""The hand is there, and points down, within these."""
IK_ITERATIONS = 40
"""Enough to converge from home to anywhere in the workspace."""


class WidowXHand(Hand):
    """The parallel gripper of the WidowX, whose target moves by bounded steps."""

    pad_half = PAD_HALF_SIZE
    palm_half = (0.045, 0.022)
    palm_height = PAD_BELOW_EE + FINGERTIP_REACH
    tip_reach, tip_clearance = FINGERTIP_REACH, 0.002
    max_width = 2 * (FINGER_Y - PAD_HALF_SIZE[1]) - 0.006
    hover, retreat = 0.07, 0.13
    far = 0.44
    empty_opening, widest_opening = 0.06, 0.95
    closes_along = 1

    def wrist_at(self, azimuth: np.ndarray, hand_yaw: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return wrap(azimuth + np.pi / 2 - hand_yaw)

    def pad_offsets(self, width: np.ndarray) -> tuple[np.ndarray | float, ...]:
        """See `Hand`: they always open as far as they can."""
        return (-FINGER_Y, FINGER_Y, -0.018, 0.018)

    def to_end_effector(self, middle: np.ndarray, closing: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return middle + np.array([0, 0, PAD_BELOW_EE])

    def to_middle(self, position: np.ndarray, closing: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return position - np.array([0, 0, PAD_BELOW_EE])

    def target_pose(self, target: np.ndarray) -> Pose:
        """See `Hand`."""
        return forward_kinematics(target)[:2]

    def held_width(self, opening: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return 2 * (FINGER_Y - PAD_HALF_SIZE[1]) * opening

    def still_opening(self, opening: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return 0.05 * np.clip(0.9 - opening, 0.0, 0.5) / 0.5

    def has_let_go(self, opening: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return opening > 0.5

    def act(self, target: np.ndarray, command: Command, width: np.ndarray) -> np.ndarray:
        """See `Hand`: a step of the target pose, the hand pointing down."""
        p, R = self.target_pose(target)
        closing = horizontal(command.closing)
        zeros = np.zeros(len(closing))
        down = np.stack([zeros, zeros, zeros - 1], 1)
        across = np.stack([closing[:, 1], -closing[:, 0], zeros], 1)
        goal_R = np.stack([down, closing, across], 2)
        turn = matrix_to_rotation_vector(goal_R @ R.transpose(0, 2, 1))
        turn[:, 2] = self._away_from_wrist_limit(target, R, turn[:, 2])
        action = np.concatenate([command.position - p, turn, command.gripper], 1)
        return np.clip(action, WIDOWX.action_low, WIDOWX.action_high)

    def _away_from_wrist_limit(self, target: np.ndarray, rotation: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Turn (n,) the long way round where the short one would hit the wrist's limit."""
        blocked = (rotation[:, 2, 0] < -0.7) & (np.abs(target[:, 5] - turn) > 3.1)
        return np.where(blocked, turn - 2 * np.pi * np.sign(turn), turn)

    def gets_to(self, position: np.ndarray, yaw: float) -> np.ndarray:
        """See `Hand`."""
        c, s = np.cos(yaw), np.sin(yaw)
        # Columns: the fingers' direction, the closing axis, and what is across both.
        rotation = np.array([[0.0, c, s], [0.0, s, -c], [-1.0, 0.0, 0.0]])
        q = np.tile(HOME_QPOS, (len(position), 1))
        q = inverse_kinematics(q, position, np.broadcast_to(rotation, (len(position), 3, 3)), IK_ITERATIONS)
        p, R, _ = forward_kinematics(q)
        reached = np.linalg.norm(p - position, axis=1) < POSITION_TOLERANCE_M
        return reached & (-R[:, 2, 0] > np.cos(TILT_TOLERANCE_RAD))


FIXED_GAP, MOVING_GAP = 0.006, 0.014
"""Room between a side to grasp and the open jaws. A fixed jaw closer than 4 mm comes down on the side."""
JAW_OPENING_M = np.array([0.0019, 0.0158, 0.030, 0.044, 0.058, 0.071, 0.110])
JAW_ANGLE_DEG = np.array([-10, 0, 10, 20, 30, 40, 100])
"""Of the jaws at their tips, by the angle of the gripper's joint."""
PREFERRED_TILTS = (np.array([0.225, 0.285]), np.deg2rad([0.0, 15.0]))
"""Distance from the pan axis [m], and tilt of the fingers there [rad]: far out they lean outwards."""
MORE_TILT = np.deg2rad(np.arange(0, 42.5, 2.5))
"""What the wrist needs on top where it cannot bend as far, high up."""
MAX_STEP_M, MAX_STEP_RAD, MAX_ROLL_RAD = 0.007, 0.035, 0.08
"""Of the target in a control step: along and up, around the pan axis, and of the wrist."""
SAG_ROUNDS = 4
"""A round comes seven times as close to what a target with its sag was meant for."""
PAD_ABOVE_EE = 0.0037
"""Height of the middle of the pads above the end effector when the SO-101's hand points down."""


class SO101Hand(Hand):
    """The jaws of the SO-101, one fixed and one that turns, and servos that sag under the arm's weight."""

    pad_half = (0.010, 0.004, 0.006)
    palm_half = (0.040, 0.024)
    palm_height = 0.049
    tip_reach, tip_clearance = SO101_FINGERTIP_REACH, 0.005
    max_width = 0.0455
    hover, lift, retreat = 0.05, 0.03, 0.075
    near, far = 0.11, 0.285
    empty_opening, widest_opening = 0.03, 0.45
    closes_along = 0

    def wrist_at(self, azimuth: np.ndarray, hand_yaw: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return wrap(hand_yaw - azimuth)

    def pad_offsets(self, width: np.ndarray) -> tuple[np.ndarray | float, ...]:
        """See `Hand`: the fixed jaw comes from below along the axis, the moving one from above."""
        half = width / 2 + self.pad_half[1]
        return (-(half + FIXED_GAP), half + MOVING_GAP, -half, half + MOVING_GAP / 2)

    def to_end_effector(self, middle: np.ndarray, closing: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`: it is on the fixed jaw."""
        return middle - (width / 2 + FIXED_GAP)[:, None] * closing - np.array([0, 0, PAD_ABOVE_EE])

    def to_middle(self, position: np.ndarray, closing: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return position + (width / 2)[:, None] * closing + np.array([0, 0, PAD_ABOVE_EE])

    def target_pose(self, target: np.ndarray) -> Pose:
        """See `Hand`: the servos are asked for more than is wanted. The closing axis is that of no tilt."""
        q = self._without_sag(target)
        return so101.forward_kinematics(q)[0], so101.hand_rotation(-q[:, 0], q[:, 4], np.zeros(len(q)))

    def _without_sag(self, target: np.ndarray) -> np.ndarray:
        q = target
        for _ in range(SAG_ROUNDS):
            q = target - so101.gravity_torque(q) / SERVO_KP
        return q

    def _opening(self, width: np.ndarray) -> np.ndarray:
        """Opening (n,), 0 to 1, at which the jaws have their gaps to a side of a width (n,)."""
        degrees = np.interp(width + FIXED_GAP + MOVING_GAP, JAW_OPENING_M, JAW_ANGLE_DEG)
        return (degrees - JAW_ANGLE_DEG[0]) / (JAW_ANGLE_DEG[-1] - JAW_ANGLE_DEG[0])

    def held_width(self, opening: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        degrees = JAW_ANGLE_DEG[0] + opening * (JAW_ANGLE_DEG[-1] - JAW_ANGLE_DEG[0])
        return np.interp(degrees, JAW_ANGLE_DEG, JAW_OPENING_M)

    def still_opening(self, opening: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return 0.04 * np.clip((self._opening(width) - 0.02 - opening) / 0.05, 0.0, 1.0)

    def has_let_go(self, opening: np.ndarray, width: np.ndarray) -> np.ndarray:
        """See `Hand`."""
        return opening > self._opening(width) - 0.05

    def act(self, target: np.ndarray, command: Command, width: np.ndarray) -> np.ndarray:
        """See `Hand`: joint targets a step further around the robot, not through it."""
        q = self._without_sag(target)
        p, _ = so101.forward_kinematics(q)
        r, azimuth, z = np.hypot(p[:, 0], p[:, 1]), np.arctan2(p[:, 1], p[:, 0]), p[:, 2]
        x, y, height = command.position.T
        r_goal, azimuth_goal = np.hypot(x, y), np.arctan2(y, x)
        closing = np.arctan2(command.closing[:, 1], command.closing[:, 0])
        roll = q[:, 4] - q[:, 0] - azimuth
        roll = roll + np.clip(self.wrist_at(azimuth_goal, closing) - roll, -MAX_ROLL_RAD, MAX_ROLL_RAD)
        r = r + np.clip(np.maximum(r_goal, self.near - 0.03) - r, -MAX_STEP_M, MAX_STEP_M)
        azimuth = azimuth + np.clip(azimuth_goal - azimuth, -MAX_STEP_RAD, MAX_STEP_RAD)
        z = z + np.clip(height - z, -MAX_STEP_M, MAX_STEP_M)
        p = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], 1)
        q = point_down(p, azimuth + roll)[0]
        gripper = np.where(command.gripper[:, 0] == OPEN, self._opening(width), 0.0)
        action = from_joints(np.concatenate([q + so101.gravity_torque(q) / SERVO_KP, gripper[:, None]], 1))
        action[:, 5] = 100 * gripper
        return np.clip(action, SO101_ARM.action_low, SO101_ARM.action_high)

    def gets_to(self, position: np.ndarray, yaw: float) -> np.ndarray:
        """See `Hand`, tilted as little as it can be."""
        closing = np.arctan2(position[:, 1], position[:, 0]) + yaw
        return point_down(position, closing)[1] & SO101_ARM.is_within(position[:, :2])


def point_down(p: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions (n, 5) of the SO-101 at (n, 3), closing along a yaw (n,), tilted as little as it can be.

    Second, whether it gets there (n,) bool; where it does not, the joints are at their limits.
    """
    least = np.interp(np.hypot(p[:, 0], p[:, 1]), *PREFERRED_TILTS)
    q, found = so101.inverse_kinematics(p, yaw, least)
    for more in MORE_TILT[1:]:
        missing = np.flatnonzero(~found)
        if not len(missing):
            break
        q[missing], found[missing] = so101.inverse_kinematics(p[missing], yaw[missing], least[missing] + more)
    return q, found


HANDS: dict[str, Hand] = {WIDOWX.name: WidowXHand(), SO101_ARM.name: SO101Hand()}
"""By the name of the arm."""
