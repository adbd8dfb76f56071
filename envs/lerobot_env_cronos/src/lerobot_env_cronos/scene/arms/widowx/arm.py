"""The WidowX as a value: what its actions mean, what it feels, where it gets to.

The action is a delta of the end effector's TARGET pose (facts of the Bridge set-up: the delta is applied to the
previous target, not to the measured pose) and a gripper command. Targets become joint targets by inverse
kinematics and are ramped over most of the control step.
"""

from collections.abc import Callable

import numpy as np

from lerobot_env_cronos.scene.arms.arm import Arm, Camera, Pose, Reading
from lerobot_env_cronos.scene.arms.widowx.geometry import (
    EE_HIGH,
    EE_LOW,
    FINGER_CLOSED,
    FINGER_OPEN,
    FINGERTIP_REACH,
    HOME_QPOS,
)
from lerobot_env_cronos.scene.arms.widowx.kinematics import forward_kinematics, inverse_kinematics
from lerobot_env_cronos.scene.rotations import rotation_vector_to_matrix

TIMESTEP_S = 0.008
RAMP_CHUNKS, RAMP_SHARE = 8, 0.9
"""The joint targets move linearly in 8 chunks over most of a control step. Without that, what is held slips."""


def _ramp(fps: int) -> tuple[tuple[float, int], ...]:
    """Chunks of a control step, see `Arm.chunks`; the rest of the time is the last one's."""
    substeps = round(1 / (fps * TIMESTEP_S))
    of_chunk = round(RAMP_SHARE * substeps / RAMP_CHUNKS)
    last = substeps - (RAMP_CHUNKS - 1) * of_chunk
    return tuple((k / RAMP_CHUNKS, last if k == RAMP_CHUNKS else of_chunk) for k in range(1, RAMP_CHUNKS + 1))


class WidowX(Arm):
    """The WidowX-250S on the Bridge table."""

    name, robot_type = "widowx", "widowx"
    fps, steps_per_task = 5, 80

    action_names = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
    # q01 and q99 of `bridge_orig`, the range that OpenVLA's action tokens span: m, rad, gripper (1 open).
    # Rotations here are a rotation vector. Those of `bridge_orig` are Euler angles, up to .77 degrees apart.
    action_low = np.array([-0.028727253, -0.0417035, -0.026093859, -0.08092105, -0.092886995, -0.20718276, 0.0])
    action_high = np.array([0.028309678, 0.040855255, 0.040161587, 0.0819204776, 0.0779285, 0.203825745, 1.0])
    push = (action_high - action_low)[:-1] / 2
    # End-effector position [m], the first two columns of its rotation matrix, gripper opening (0 closed, 1 open),
    # and the commanded minus the measured position [m].
    state_names = (
        *(f"ee.{axis}" for axis in "xyz"),
        *(f"ee.r{row}{column}" for column in (1, 2) for row in (1, 2, 3)),
        "gripper.opening",
        *(f"ee_target_offset.{axis}" for axis in "xyz"),
    )
    state_limit = 10.0

    num_joints = 6
    home_qpos = np.array([*HOME_QPOS, FINGER_OPEN, -FINGER_OPEN])
    home_gripper = FINGER_OPEN
    timestep_s, sleep_tolerance = TIMESTEP_S, 1e-3
    chunks = _ramp(fps)
    steps_per_reading = 1

    cameras = {  # noqa: RUF012 - a value, the same for every scene
        # A front view, 45 degrees down through a long lens: bodies at the edges of the widened spawn area just fit
        # the width of a square picture, and little is lost behind the arm.
        "front": Camera((1.03, 0, 0.82), (0, 1, 0, -1, 0, 1), 27.0),
        # The Bridge set-up's third-person Logitech C920, as identified by SimplerEnv.
        "bridge": Camera((0.0, -0.16, 0.36), (0.483933, -0.875105, 0.0, 0.602558, 0.333214, 0.725184), 42.1004),
    }
    hand = "gripper_link"
    fingers = (("geom", "left_pad"), ("geom", "right_pad"))
    max_width_m = 0.044
    low, high = EE_LOW, EE_HIGH
    workspace = f"x {EE_LOW[0]} to {EE_HIGH[0]}, y {EE_LOW[1]} to {EE_HIGH[1]}"

    roomy_spawn = "x 0.17 to 0.42 and y -0.15 to 0.15"

    def is_within(self, xy: np.ndarray) -> np.ndarray:
        """See `Arm`: in the box that the end effector's target is clamped to."""
        return np.asarray(((xy >= EE_LOW[:2]) & (xy <= EE_HIGH[:2])).all(-1))

    def forward_kinematics(self, q: np.ndarray) -> Pose:
        """See `Arm`; with the Jacobian (n, 6, 6)."""
        return forward_kinematics(q)

    def next_target(
        self, target: np.ndarray, actions: np.ndarray, pose: Callable[[np.ndarray], Pose]
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Arm`."""
        p, R, jacobian = pose(target)
        R_next = rotation_vector_to_matrix(actions[:, 3:6]) @ R
        p_next = np.clip(p + actions[:, :3], EE_LOW, EE_HIGH)
        # The fingertips' target stays above the table, however the hand is tilted.
        p_next[:, 2] = np.maximum(p_next[:, 2], 0.001 - FINGERTIP_REACH * np.minimum(R_next[:, 2, 0], 0.0))
        goal = inverse_kinematics(target, p_next, R_next, pose=(p, R, jacobian))
        return goal, np.where(actions[:, 6] > 0.5, FINGER_OPEN, FINGER_CLOSED)

    def hold(self, target: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(target), 1))

    def gripper_opening(self, qpos: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return np.clip((qpos[:, self.num_joints] - FINGER_CLOSED) / (FINGER_OPEN - FINGER_CLOSED), 0.0, 1.0)

    def closing_axis(self, rotation: np.ndarray) -> np.ndarray:
        """See `Arm`."""
        return rotation[:, :, 1]

    def proprioception(self, reading: Reading) -> np.ndarray:
        """See `Arm`."""
        p, R = reading.end_effector()
        offset = reading.target_position() - p
        columns = (p, R[:, :, 0], R[:, :, 1], reading.gripper_opening()[:, None], offset)
        return np.concatenate(columns, axis=1, dtype=np.float32)


WIDOWX = WidowX()
