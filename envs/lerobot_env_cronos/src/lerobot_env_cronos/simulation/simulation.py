"""Many copies of one scene on MuJoCo's batched engine: control, contacts, and putting things somewhere.

The action is a delta of the end effector's TARGET pose (facts of the Bridge set-up: the delta is applied to the
previous target, not to the measured pose) and a gripper command. Targets become joint targets by inverse
kinematics and are ramped over most of the control step.
"""

import os
import zlib
from functools import cached_property

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from lerobot_env_cronos.benchmark.version import VERSION
from lerobot_env_cronos.scene.model import CHUNK_SUBSTEPS, RAMP_CHUNKS, SETTLE_SUBSTEPS, SUBSTEPS, build_model
from lerobot_env_cronos.scene.robot import EE_HIGH, EE_LOW, FINGER_CLOSED, FINGER_OPEN, FINGERTIP_REACH, HOME_QPOS
from lerobot_env_cronos.scene.scenes import BODIES, Scene
from lerobot_env_cronos.simulation.judging import Judge
from lerobot_env_cronos.simulation.kinematics import (
    LastPose,
    inverse_kinematics,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)

ACTION_LOW = np.array([-0.028727253, -0.0417035, -0.026093859, -0.08092105, -0.092886995, -0.20718276, 0.0])
ACTION_HIGH = np.array([0.028309678, 0.040855255, 0.040161587, 0.0819204776, 0.0779285, 0.203825745, 1.0])
"""q01 and q99 of `bridge_orig`, the range that OpenVLA's action tokens span: m, rad, gripper (1 open).

Rotations here are a rotation vector. Those of `bridge_orig` are Euler angles: up to .77 degrees apart a step."""
ACTION_NAMES = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")


def _round_outwards(bound: np.ndarray, towards: float) -> np.ndarray:
    nearest = bound.astype(np.float32)
    inside = nearest > bound if towards < 0 else nearest < bound
    return np.where(inside, np.nextafter(nearest, np.float32(towards)), nearest)


ACTION_LOW_F32, ACTION_HIGH_F32 = _round_outwards(ACTION_LOW, -np.inf), _round_outwards(ACTION_HIGH, np.inf)
"""The bounds as float32, rounded outwards: an action that was clipped to them does exactly the same again."""

NUM_ARM_JOINTS, NUM_ROBOT_JOINTS = 6, 8
MAX_SPEED = 200.0
"""Joint or body speed beyond which a simulation counts as diverged [m/s, rad/s]."""
BODY_SPEED_LIMITS = np.array([3.0, 50.0])
"""No body moves [m/s] or spins [rad/s] faster, as in engines that limit both by default. A body that jumps out of
a pinch would otherwise spin so fast that the integrator adds to its energy at each step. No task comes near."""
_SLOW_COMPONENTS = (BODY_SPEED_LIMITS / np.sqrt(3))[:, None]

SETTLE_MAX_CHUNKS, SETTLE_SPEED = 10, 0.02
"""After an arm teleport bodies fall for at most 1 s, checked every 0.1 s, until slower than 0.02 m/s."""


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Simulation:
    """`num_sims` copies of `scene`, stepped together on `num_threads` threads (bit-identical at any number).

    Attributes are live arrays: `qpos` (n, nq), `qvel` (n, nv), `sensordata` (n, nsensor). `num_threads` is at
    least 1, with all cores counted.
    """

    def __init__(self, scene: Scene, num_sims: int, num_threads: int = 0):
        if num_threads < 0:
            raise ValueError(f"num_threads must be 0 (all cores) or more, got {num_threads}")
        self.scene, self.num_sims = scene, num_sims
        self.num_threads = num_threads or num_cores()
        self.model = build_model(scene, looks=False)
        self._batch = Batch(self.model, num_sims, self.num_threads, persistent=True)
        self.qpos, self.qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self.sensordata = self._batch.bind("ctrl"), self._batch.bind("sensordata")
        self._qpos_slice = {
            name: slice(NUM_ROBOT_JOINTS + 7 * i, NUM_ROBOT_JOINTS + 7 * (i + 1))
            for i, name in enumerate(scene.bodies)
        }
        self._sensor_slice = self._find_sensors()
        self.arm_target = np.tile(HOME_QPOS, (num_sims, 1))
        self.gripper_target = np.full(num_sims, FINGER_OPEN)
        self._measured_pose, self._target_pose = LastPose(), LastPose()
        self.judge = Judge(scene, self.model, self.sensordata, self.qpos)

    @cached_property
    def render_model(self) -> mujoco.MjModel:
        """The same bodies and joints with their looks."""
        return build_model(self.scene)

    def _find_sensors(self) -> dict[str, slice]:
        sensors = (self.model.sensor(i) for i in range(self.model.nsensor))
        return {s.name: slice(int(s.adr[0]), int(s.adr[0]) + int(s.dim[0])) for s in sensors}

    # Control ----------------------------------------------------------------------------------------------

    def step(self, actions: np.ndarray, ids: np.ndarray) -> np.ndarray:
        """Advance the simulations `ids` by one control step.

        Args:
            actions: (len(ids), 7) in physical units, within bounds.
            ids: (k,) indices of the simulations.

        Returns:
            (k,) bool, the simulations that diverged; each is back in its state before the step, at rest.
        """
        before = self.qpos[ids].copy()
        start = self.arm_target[ids]
        goal = self._next_arm_target(start, actions)
        self.arm_target[ids] = goal
        self.gripper_target[ids] = np.where(actions[:, 6] > 0.5, FINGER_OPEN, FINGER_CLOSED)
        self._ctrl[ids, NUM_ARM_JOINTS] = self.gripper_target[ids]
        broken = np.zeros(self.num_sims, dtype=bool)
        for k in range(1, RAMP_CHUNKS + 1):
            self._ctrl[ids, :NUM_ARM_JOINTS] = start + (k / RAMP_CHUNKS) * (goal - start)
            last = k == RAMP_CHUNKS
            broken |= self._advance(ids, SUBSTEPS - (RAMP_CHUNKS - 1) * CHUNK_SUBSTEPS if last else CHUNK_SUBSTEPS)
            self.judge.look(ids)
        diverged = broken[ids] | self._is_diverged(ids)
        if diverged.any():
            self._restore(ids[diverged], before[diverged])
            self.judge.forget(ids[diverged])
        self._read(ids)
        return diverged

    def _advance(self, ids: np.ndarray, nstep: int) -> np.ndarray:
        broken = np.zeros(self.num_sims, dtype=bool)
        try:
            self._batch.step(ids, nstep=nstep)
        except SimulationError as error:
            broken[error.ids] = True
        self._limit_body_speeds(ids)
        return broken

    def _limit_body_speeds(self, ids: np.ndarray) -> None:
        velocity = self.qvel[ids, NUM_ROBOT_JOINTS:].reshape(len(ids), len(self.scene.bodies), 2, 3)
        # No component is above limit / sqrt(3): hardly ever is there more to look at.
        if (np.abs(velocity) < _SLOW_COMPONENTS).all():
            return
        with np.errstate(invalid="ignore", over="ignore"):
            speed = np.sqrt(np.einsum("nbki,nbki->nbk", velocity, velocity))
            too_fast = speed > BODY_SPEED_LIMITS
            if not too_fast.any():
                return
            mine = too_fast.any((1, 2))
            scale = np.where(too_fast, BODY_SPEED_LIMITS / np.maximum(speed, BODY_SPEED_LIMITS), 1.0)
        limited = (velocity * scale[..., None])[mine]
        self.qvel[ids[mine], NUM_ROBOT_JOINTS:] = limited.reshape(len(limited), -1)

    def _next_arm_target(self, q: np.ndarray, actions: np.ndarray) -> np.ndarray:
        pose = p, R, _ = self._target_pose(q)
        R = rotation_vector_to_matrix(actions[:, 3:6]) @ R
        p = np.clip(p + actions[:, :3], EE_LOW, EE_HIGH)
        # The fingertips' target stays above the table, however the hand is tilted.
        p[:, 2] = np.maximum(p[:, 2], 0.001 - FINGERTIP_REACH * np.minimum(R[:, 2, 0], 0.0))
        return inverse_kinematics(q, p, R, pose=pose)

    def _is_diverged(self, ids: np.ndarray) -> np.ndarray:
        finite = np.isfinite(self.qpos[ids]).all(1) & np.isfinite(self.qvel[ids]).all(1)
        with np.errstate(invalid="ignore"):
            return ~finite | (np.abs(self.qvel[ids]).max(1) > MAX_SPEED)

    # Interventions ----------------------------------------------------------------------------------------

    def _restore(self, ids: np.ndarray, qpos: np.ndarray) -> None:
        """Put the simulations into `qpos` at rest, everything awake, targets where the arm is."""
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[ids] = qpos
        self.qvel[ids] = 0.0
        self.arm_target[ids] = qpos[:, :NUM_ARM_JOINTS]
        self._ctrl[ids, :NUM_ARM_JOINTS] = self.arm_target[ids]
        self._ctrl[ids, NUM_ARM_JOINTS] = self.gripper_target[ids]
        self._batch.forward(ids)

    def place(self, ids: np.ndarray, poses: np.ndarray) -> None:
        """Put every body of the simulations `ids` at `poses` (k, bodies, 7) and the arm home."""
        if not len(ids):
            return
        qpos = np.empty((len(ids), self.model.nq))
        poses = np.asarray(poses)
        qpos[:, NUM_ROBOT_JOINTS:] = poses.reshape(len(ids), -1)
        self._home(ids, qpos)
        self.judge.put(ids, poses[:, : len(self.scene.objects)])

    def send_arm_home(self, ids: np.ndarray) -> None:
        """Put the arm home with an open gripper; bodies stay, and those that were held fall and settle."""
        self._home(ids, self.qpos[ids].copy())
        self.settle(ids)
        self._read(ids, settled=True)

    def _home(self, ids: np.ndarray, qpos: np.ndarray) -> None:
        qpos[:, :NUM_ARM_JOINTS] = HOME_QPOS
        qpos[:, NUM_ARM_JOINTS:NUM_ROBOT_JOINTS] = (FINGER_OPEN, -FINGER_OPEN)
        self.gripper_target[ids] = FINGER_OPEN
        self._restore(ids, qpos)

    def move_arm(self, ids: np.ndarray, arm_qpos: np.ndarray) -> None:
        """Put the arm at joint positions (k, 6) [rad], gripper as it is; bodies stay where they are."""
        qpos = self.qpos[ids].copy()
        qpos[:, :NUM_ARM_JOINTS] = arm_qpos
        self._restore(ids, qpos)
        self._read(ids)

    def move_body(self, ids: np.ndarray, body: str, poses: np.ndarray) -> None:
        """Put one body at `poses` (k, 7); all else stays where it is."""
        qpos = self.qpos[ids].copy()
        arm_target = self.arm_target[ids].copy()
        qpos[:, self._qpos_slice[body]] = poses
        self._restore(ids, qpos)
        self.arm_target[ids] = arm_target
        self._ctrl[ids, :NUM_ARM_JOINTS] = arm_target
        self.judge.put_one(ids, body)
        self._read(ids, stepped=False)

    def settle(self, ids: np.ndarray) -> None:
        """Let the bodies of the simulations come to rest, the arm holding still.

        One that diverges is put back to where it began, at rest.
        """
        before = self.qpos[ids].copy()
        for _ in range(SETTLE_MAX_CHUNKS):
            broken = self._advance(ids, SETTLE_SUBSTEPS)
            diverged = broken[ids] | self._is_diverged(ids)
            if diverged.any():
                self._restore(ids[diverged], before[diverged])
            moving = np.abs(self.qvel[ids, NUM_ROBOT_JOINTS:]).max(1) > SETTLE_SPEED
            ids, before = ids[moving], before[moving]
            if not len(ids):
                return

    # Readings ---------------------------------------------------------------------------------------------

    def end_effector(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured pose of the end-effector site: p_we (n, 3) [m] and R_we (n, 3, 3)."""
        p, R, _ = self._measured_pose(self.qpos[:, :NUM_ARM_JOINTS])
        return p, R

    def target_position(self) -> np.ndarray:
        """Position of the end effector's target (n, 3) [m]."""
        return self._target_pose(self.arm_target)[0]

    def gripper_opening(self) -> np.ndarray:
        """Opening of the gripper (n,), 0 closed to 1 open."""
        left = self.qpos[:, NUM_ARM_JOINTS]
        return np.clip((left - FINGER_CLOSED) / (FINGER_OPEN - FINGER_CLOSED), 0.0, 1.0)

    def body_pose(self, body: str) -> np.ndarray:
        """Pose of a body (n, 7): position [m] and quaternion (w, x, y, z)."""
        return self.qpos[:, self._qpos_slice[body]]

    def body_poses(self) -> np.ndarray:
        """Poses of all bodies (n, bodies, 7), in the scene's order."""
        return self.qpos[:, NUM_ROBOT_JOINTS:].reshape(self.num_sims, -1, 7)

    def force(self, sensor: str) -> np.ndarray:
        """Net contact force (n, 3) of a sensor [N], world frame."""
        return self.sensordata[:, self._sensor_slice[sensor]]

    def _read(self, ids: np.ndarray, *, settled: bool = False, stepped: bool = True) -> None:
        """Let the judge see the simulations `ids` as they are now."""
        _, R, _ = self._measured_pose(self.qpos[ids, :NUM_ARM_JOINTS])
        self.judge.read(ids, R[:, :, 1], settled=settled, stepped=stepped)

    def is_grasped(self, obj: str) -> np.ndarray:
        """Both fingers press on the object (n,); see `Judge.is_grasped`."""
        return self.judge.is_grasped(obj)

    def is_on(self, obj: str, receptacle: str) -> np.ndarray:
        """The object is placed on the receptacle (n,); see `Judge.is_on`."""
        return self.judge.is_on(obj, receptacle)

    def is_on_table(self, obj: str) -> np.ndarray:
        """The object is released and rests on the table within reach, on no receptacle (n,)."""
        xy = self.body_pose(obj)[:, :2]
        return self.judge.is_on_table(obj) & ((xy >= EE_LOW[:2]) & (xy <= EE_HIGH[:2])).all(1)

    def body_rotations(self) -> np.ndarray:
        """Rotation matrices of all bodies (n, bodies, 3, 3)."""
        return quaternion_to_matrix(self.body_poses()[..., 3:])

    # State ------------------------------------------------------------------------------------------------

    def _state_arrays(self) -> dict[str, np.ndarray]:
        """The arrays, with a leading dimension n, that decide the future."""
        bound = {name: self._batch.bind(name) for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "time")}
        targets = {"arm_target": self.arm_target, "gripper_target": self.gripper_target}
        return bound | targets | self.judge.state_arrays()

    @cached_property
    def _scene_number(self) -> np.ndarray:
        """A hash of the scene, for each simulation."""
        scene = (VERSION, self.scene, [BODIES[name] for name in self.scene.bodies])
        return np.full(self.num_sims, zlib.crc32(repr(scene).encode()))

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that decides the future, as arrays with a leading dimension n.

        Bodies that MuJoCo put to sleep are woken by this call, exactly as `set_state` wakes them, so that a
        simulation that continues and one that was loaded stay bit-identical.
        """
        state = {name: array.copy() for name, array in self._state_arrays().items()}
        state["scene"] = self._scene_number.copy()
        self.set_state(state)
        return state

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a state taken by `get_state`.

        Raises:
            ValueError: it is of another scene or number of simulations, or incomplete; nothing changes.
        """
        arrays = self._state_arrays()
        check_state(state, arrays)
        if (state["scene"] != self._scene_number).any():
            raise ValueError(f"the state is of another scene than {self.scene.name}, or of other bodies")
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        for name, array in arrays.items():
            array[:] = state[name]
        self._batch.forward()


def check_state(state: dict[str, np.ndarray], arrays: dict[str, np.ndarray]) -> None:
    """Raise a ValueError unless `state` has all of `arrays`, in their shapes."""
    for name, array in arrays.items():
        found = np.shape(state[name]) if name in state else "nothing"
        if found != array.shape:
            raise ValueError(f"{name} of the state must be of shape {array.shape}, got {found}")
