"""The SO-101 as a value: LeRobot's features and units, where it gets to.

Actions and proprioception are LeRobot's of a calibrated arm: joint positions in degrees, the gripper from 0
(closed) to 100 (open). An action is an absolute target, which the servos try to reach at once.
"""

from collections.abc import Callable

import numpy as np

from lerobot_env_cronos.scene.arms.arm import Arm, Camera, Pose, Reading
from lerobot_env_cronos.scene.arms.so101.geometry import JOINT_HIGH, JOINT_LOW, JOINTS
from lerobot_env_cronos.scene.arms.so101.kinematics import NUM_JOINTS, forward_kinematics

GRIPPER_CLOSED, GRIPPER_OPEN = JOINT_LOW[-1], JOINT_HIGH[-1]
"""Joint positions of the gripper at 0 and 100 [rad]."""
HOME_DEG = (0.0, -45.0, 35.0, 90.0, 0.0)
HOME_GRIPPER = 40.0

REACH_NEAR_M, REACH_FAR_M, REACH_AZIMUTH = 0.09, 0.31, np.deg2rad(100)
"""Where the hand gets down to the table, from the pan axis; nearer it meets its own shoulder."""
SPAWN_NEAR_M, SPAWN_FAR_M, SPAWN_AZIMUTH = 0.12, 0.28, np.deg2rad(80)
"""Where bodies begin."""


def to_joints(positions: np.ndarray) -> np.ndarray:
    """LeRobot's positions (n, 6), degrees and 0 to 100, as joint positions (n, 6) [rad]."""
    gripper = GRIPPER_CLOSED + positions[:, NUM_JOINTS:] / 100 * (GRIPPER_OPEN - GRIPPER_CLOSED)
    return np.concatenate([np.deg2rad(positions[:, :NUM_JOINTS]), gripper], axis=1)


def from_joints(joints: np.ndarray) -> np.ndarray:
    """The inverse of `to_joints`."""
    gripper = 100 * (joints[:, NUM_JOINTS:] - GRIPPER_CLOSED) / (GRIPPER_OPEN - GRIPPER_CLOSED)
    return np.concatenate([np.rad2deg(joints[:, :NUM_JOINTS]), gripper], axis=1)


def _is_in_sector(xy: np.ndarray, near: float, far: float, azimuth: float) -> np.ndarray:
    r = np.linalg.norm(xy, axis=-1)
    return np.asarray((r >= near) & (r <= far) & (np.abs(np.arctan2(xy[..., 1], xy[..., 0])) <= azimuth))


class SO101(Arm):
    """The SO-101 on a desk, clamped to its table top."""

    # LeRobot 0.6.1 writes the same for the SO-100 and the SO-101.
    name, robot_type = "so101", "so_follower"
    fps, steps_per_task = 30, 480

    action_names = tuple(f"{joint}.pos" for joint in JOINTS)
    action_low, action_high = (from_joints(bound[None])[0].round(6) for bound in (JOINT_LOW, JOINT_HIGH))
    # The expert goes on from where it was pushed, so that pushes add up: 6 degrees in 0.2 s.
    push = np.full(NUM_JOINTS, 1.0)
    state_names = action_names
    state_limit = 360.0

    num_joints = NUM_JOINTS
    home_qpos = to_joints(np.array([[*HOME_DEG, HOME_GRIPPER]]))[0]
    home_gripper = float(home_qpos[-1])
    # In small steps what rocks would fall asleep while it does not bear its weight.
    timestep_s, sleep_tolerance = 1 / 240, 1e-4
    chunks = ((1.0, 2),) * 4
    steps_per_reading = 6

    cameras = {  # noqa: RUF012 - a value, the same for every scene
        # From the front, 42 degrees down: it sees all that the hand gets to.
        "front": Camera((0.98, 0.0, 0.80), (0, 1, 0, -0.667, 0, 0.745), 32.5),
        # Above the fingers, on the hand: it looks at their tips.
        "wrist": Camera((0.0, 0.055, -0.045), (1, 0, 0, 0, 0.8419, -0.5396), 62.0, "gripper"),
    }
    # All of the arm: what leans on its foot is not let go either.
    hand = "base"
    fingers = (("body", "fixed_jaw"), ("body", "moving_jaw_pads"))
    max_width_m = 0.045
    low, high = np.array([-0.06, -REACH_FAR_M, 0.0]), np.array([REACH_FAR_M, REACH_FAR_M, 0.25])
    workspace = (
        f"{REACH_NEAR_M} to {REACH_FAR_M} from the pan axis, up to {np.rad2deg(REACH_AZIMUTH):.0f} degrees aside"
    )

    roomy_spawn = "x 0.02 to 0.28 and y -0.28 to 0.28"

    def is_within(self, xy: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return _is_in_sector(xy, REACH_NEAR_M, REACH_FAR_M, REACH_AZIMUTH)

    def serves(self, xy: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return _is_in_sector(xy, SPAWN_NEAR_M, SPAWN_FAR_M, SPAWN_AZIMUTH)

    def forward_kinematics(self, q: np.ndarray) -> Pose:
        """See `Arm`."""
        return forward_kinematics(q)

    def next_target(
        self, target: np.ndarray, actions: np.ndarray, pose: Callable[[np.ndarray], Pose]
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Arm`: the action itself, whatever the last target was."""
        joints = to_joints(actions)
        return joints[:, :NUM_JOINTS], joints[:, NUM_JOINTS]

    def hold(self, target: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return np.concatenate([np.rad2deg(target), np.full((len(target), 1), HOME_GRIPPER)], axis=1)

    def gripper_opening(self, qpos: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return np.clip((qpos[:, NUM_JOINTS] - GRIPPER_CLOSED) / (GRIPPER_OPEN - GRIPPER_CLOSED), 0.0, 1.0)

    def closing_axis(self, rotation: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return rotation[:, :, 0]

    def proprioception(self, reading: Reading) -> np.ndarray:
        """See `Arm`: what LeRobot reads from the servos."""
        return from_joints(reading.qpos[:, : NUM_JOINTS + 1]).astype(np.float32)


SO101_ARM = SO101()
