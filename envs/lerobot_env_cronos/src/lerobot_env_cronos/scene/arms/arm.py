"""What an arm is to a tabletop scene: its values, and the few functions in which arms differ.

Shapes lead with n, the number of streams; j is the number of the arm's joints without those of its gripper.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Link:
    """One moving link of an arm, with the joint that connects it to its parent; SI units, the parent's frame."""

    name: str
    parent: str
    pos: tuple[float, float, float]
    mass: float
    com: tuple[float, float, float]
    inertia_quat: tuple[float, float, float, float]
    diaginertia: tuple[float, float, float]
    joint: str
    axis: tuple[float, float, float]
    range: tuple[float, float]
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """A camera of a square or wider picture: fixed in the room, or to a body that moves."""

    pos: tuple[float, float, float]
    """In the base frame, or in that of `body` [m]."""
    xyaxes: tuple[float, float, float, float, float, float]
    """The picture's x and y axes, made orthonormal."""
    fovy: float
    """Vertical field of view [deg]."""
    body: str | None = None
    """What it moves with; None for the room."""

    @property
    def rotation(self) -> np.ndarray:
        """Rotation matrix of the camera, which looks along its -z axis."""
        x, y = np.array(self.xyaxes[:3]), np.array(self.xyaxes[3:])
        x = x / np.linalg.norm(x)
        y = y - x * (x @ y)
        y = y / np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)], axis=1)

    def projection(self, height: int, width: int) -> np.ndarray:
        """The matrix (3, 4) of a picture of `height` x `width` pixels.

        Times a point (x, y, z, 1) in the camera's base frame [m] it is (u w, v w, w), w the depth [m]. u to the
        right and v downwards lie in [-1, 1] inside the picture.
        """
        rotation, zoom = self.rotation, 1 / np.tan(np.deg2rad(self.fovy) / 2)
        # A camera looks along its -z axis, and its y axis points up.
        scale = np.diag([zoom * height / width, -zoom, -1.0])
        return scale @ np.concatenate([rotation.T, -(rotation.T @ np.array(self.pos))[:, None]], axis=1)

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Whether points (..., 3) in the camera's base frame [m] lie inside a square picture: (...,) bool."""
        projection = self.projection(1, 1)
        x, y, depth = np.moveaxis(points @ projection[:, :3].T + projection[:, 3], -1, 0)
        return (depth > 0) & (np.abs(x) <= depth) & (np.abs(y) <= depth)


class Reading(Protocol):
    """What proprioception is made from: a simulation of n streams."""

    qpos: np.ndarray

    def end_effector(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured position (n, 3) [m] and rotation (n, 3, 3)."""
        ...

    def target_position(self) -> np.ndarray:
        """Commanded position (n, 3) [m]."""
        ...

    def gripper_opening(self) -> np.ndarray:
        """(n,), 0 closed to 1 open."""
        ...


Pose = tuple[np.ndarray, ...]
"""Position (n, 3) [m] and rotation (n, 3, 3) of the end effector; what follows is the arm's own."""


class Arm(ABC):
    """An arm, its gripper, and the cameras that belong to its set-up; a value, the same for every scene."""

    name: str
    """That `Scene.arm` has."""
    robot_type: str
    """LeRobot's name of the arm, of datasets."""
    fps: int
    """Control steps a second [Hz]."""
    steps_per_task: int
    """K, control steps that a task has."""

    action_names: tuple[str, ...]
    action_low: np.ndarray
    action_high: np.ndarray
    """Bounds, in physical units."""
    push: np.ndarray
    """What noise of scale 1 adds to an action, without the gripper's number (a - 1,)."""
    state_names: tuple[str, ...]
    """Of proprioception, `agent_pos`."""
    state_limit: float
    """Bound of every number of a state observation; a body further away [m] has left the room."""

    num_joints: int
    """Of the arm without its gripper: the first ones of qpos and of the actuators; the gripper's comes next."""
    home_qpos: np.ndarray
    """Joint positions at home, those of the open gripper last."""
    home_gripper: float
    """What the gripper's actuator is told at home."""

    timestep_s: float
    sleep_tolerance: float
    """Speed below which MuJoCo puts bodies to sleep, with the forces that they have then [m/s]."""
    chunks: tuple[tuple[float, int], ...]
    """Of a control step: the share of the way from the last joint target to the next one at which the actuators
    are, and physics steps. The contacts are looked at after each."""
    steps_per_reading: int
    """Control steps between two readings of what lies where: 0.2 s, whatever the arm. Thresholds on what lies
    still and what is carried hold for this time."""

    cameras: Mapping[str, Camera]
    """By name; `front` decides what is seen."""
    hand: str
    """The body whose subtree is the hand: what touches an object that is not let go."""
    fingers: tuple[tuple[str, str], tuple[str, str]]
    """The two sides that grasp: `geom` or `body`, and its name."""
    max_width_m: float
    """What the gripper takes between its fingers."""
    low: np.ndarray
    high: np.ndarray
    """(3,) corners of a box around the workspace, the end effector's [m]."""
    workspace: str
    """The same in words, seen from above, for messages."""
    roomy_spawn: str
    """A spawn area in which large bodies are seen, for messages."""

    @property
    def num_robot_joints(self) -> int:
        """Of arm and gripper."""
        return len(self.home_qpos)

    @property
    def looks_per_reading(self) -> int:
        """How often the contacts are looked at between two readings."""
        return self.steps_per_reading * len(self.chunks)

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Whether the front camera sees points (..., 3) in the base frame [m], whatever is observed."""
        return self.cameras["front"].sees(points)

    def serves(self, xy: np.ndarray) -> np.ndarray:
        """Whether bodies may be put at places (..., 2) of a spawn area [m]: (...,) bool."""
        return self.is_within(xy)

    @abstractmethod
    def is_within(self, xy: np.ndarray) -> np.ndarray:
        """Whether the end effector gets over places (..., 2) [m]: (...,) bool."""

    @abstractmethod
    def forward_kinematics(self, q: np.ndarray) -> Pose:
        """The end effector's pose at joint positions (n, j) [rad]."""

    @abstractmethod
    def next_target(
        self, target: np.ndarray, actions: np.ndarray, pose: Callable[[np.ndarray], Pose]
    ) -> tuple[np.ndarray, np.ndarray]:
        """What an action asks for.

        Args:
            target: (n, j) the last joint targets [rad].
            actions: (n, a) within bounds.
            pose: `forward_kinematics`, which remembers.

        Returns:
            The next joint targets (n, j), and what the gripper's actuator is told (n,).
        """

    @abstractmethod
    def hold(self, target: np.ndarray) -> np.ndarray:
        """Actions (n, a) that leave the arm at joint targets (n, j) [rad], the gripper open."""

    @abstractmethod
    def gripper_opening(self, qpos: np.ndarray) -> np.ndarray:
        """Opening (n,), 0 closed to 1 open, from positions (n, robot joints or more)."""

    @abstractmethod
    def closing_axis(self, rotation: np.ndarray) -> np.ndarray:
        """The direction (n, 3) along which the fingers press, of an end effector's rotation (n, 3, 3)."""

    @abstractmethod
    def proprioception(self, reading: Reading) -> np.ndarray:
        """`agent_pos` (n, len(state_names)) float32, without the task and before it is clipped."""
