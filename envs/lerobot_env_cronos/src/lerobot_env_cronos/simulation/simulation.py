"""Many copies of one scene on MuJoCo's batched engine: control, contacts, and putting things somewhere.

What an action means is the arm's: it becomes targets of the joints and of the gripper.
"""

import os
import zlib
from functools import cached_property

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from lerobot_env_cronos.benchmark.version import VERSION
from lerobot_env_cronos.scene.arms.arm import Arm, Pose
from lerobot_env_cronos.scene.model import SETTLE_CHUNK_S, build_model
from lerobot_env_cronos.scene.rotations import quaternion_to_matrix
from lerobot_env_cronos.scene.scenes import BODIES, Scene
from lerobot_env_cronos.simulation.judging import Judge

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


class LastPose:
    """An arm's kinematics that remember their last answer: a control step asks for the same arm more than once."""

    def __init__(self, arm: Arm) -> None:
        self._forward = arm.forward_kinematics
        self._q = np.empty((0, arm.num_joints))
        self._pose = self._forward(self._q)

    def __call__(self, q: np.ndarray) -> Pose:
        """See `Arm.forward_kinematics`; what it returns must not be changed."""
        if not np.array_equal(q, self._q):
            self._q, self._pose = q.copy(), self._forward(q)
        return self._pose


class Simulation:
    """`num_sims` copies of `scene`, stepped together on `num_threads` threads (bit-identical at any number).

    Attributes are live arrays: `qpos` (n, nq), `qvel` (n, nv), `sensordata` (n, nsensor). `num_threads` is at
    least 1, with all cores counted.
    """

    def __init__(self, scene: Scene, num_sims: int, num_threads: int = 0):
        if num_threads < 0:
            raise ValueError(f"num_threads must be 0 (all cores) or more, got {num_threads}")
        self.scene, self.num_sims, self.arm = scene, num_sims, scene.robot
        self._joints, self._robot = self.arm.num_joints, self.arm.num_robot_joints
        self.num_threads = num_threads or num_cores()
        self.model = build_model(scene, looks=False)
        self._batch = Batch(self.model, num_sims, self.num_threads, persistent=True)
        self.qpos, self.qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self.sensordata = self._batch.bind("ctrl"), self._batch.bind("sensordata")
        self._qpos_slice = {
            name: slice(self._robot + 7 * i, self._robot + 7 * (i + 1)) for i, name in enumerate(scene.bodies)
        }
        self._sensor_slice = self._find_sensors()
        self.arm_target = np.tile(self.arm.home_qpos[: self._joints], (num_sims, 1))
        self.gripper_target = np.full(num_sims, self.arm.home_gripper)
        self._measured_pose, self._target_pose = LastPose(self.arm), LastPose(self.arm)
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
            actions: (len(ids), a) in physical units, within bounds.
            ids: (k,) indices of the simulations.

        Returns:
            (k,) bool, the simulations that diverged; each is back in its state before the step, at rest.
        """
        before = self.qpos[ids].copy()
        start = self.arm_target[ids]
        goal, gripper = self.arm.next_target(start, actions, self._target_pose)
        self.arm_target[ids], self.gripper_target[ids] = goal, gripper
        self._ctrl[ids, self._joints] = gripper
        broken = np.zeros(self.num_sims, dtype=bool)
        for share, substeps in self.arm.chunks:
            self._ctrl[ids, : self._joints] = start + share * (goal - start)
            broken |= self._advance(ids, substeps)
            self.judge.look(ids)
        diverged = broken[ids] | self._is_diverged(ids)
        if diverged.any():
            self._restore(ids[diverged], before[diverged])
        due = self.judge.is_due(ids)
        self._read(ids[due])
        self._read_grasps(ids[~due])
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
        velocity = self.qvel[ids, self._robot :].reshape(len(ids), len(self.scene.bodies), 2, 3)
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
        self.qvel[ids[mine], self._robot :] = limited.reshape(len(limited), -1)

    def _is_diverged(self, ids: np.ndarray) -> np.ndarray:
        finite = np.isfinite(self.qpos[ids]).all(1) & np.isfinite(self.qvel[ids]).all(1)
        with np.errstate(invalid="ignore"):
            return ~finite | (np.abs(self.qvel[ids]).max(1) > MAX_SPEED)

    # Interventions ----------------------------------------------------------------------------------------

    def _restore(self, ids: np.ndarray, qpos: np.ndarray) -> None:
        """Put the simulations into `qpos` at rest, everything awake, targets where the arm is."""
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.judge.forget(ids)
        self.qpos[ids] = qpos
        self.qvel[ids] = 0.0
        self.arm_target[ids] = qpos[:, : self._joints]
        self._ctrl[ids, : self._joints] = self.arm_target[ids]
        self._ctrl[ids, self._joints] = self.gripper_target[ids]
        self._batch.forward(ids)

    def place(self, ids: np.ndarray, poses: np.ndarray) -> None:
        """Put every body of the simulations `ids` at `poses` (k, bodies, 7) and the arm home."""
        if not len(ids):
            return
        qpos = np.empty((len(ids), self.model.nq))
        poses = np.asarray(poses)
        qpos[:, self._robot :] = poses.reshape(len(ids), -1)
        self._home(ids, qpos)
        self.judge.put(ids, poses[:, : len(self.scene.objects)])

    def send_arm_home(self, ids: np.ndarray) -> None:
        """Put the arm home with an open gripper; bodies stay, and those that were held fall and settle."""
        self._home(ids, self.qpos[ids].copy())
        self.settle(ids)
        self._read(ids, settled=True)

    def _home(self, ids: np.ndarray, qpos: np.ndarray) -> None:
        qpos[:, : self._robot] = self.arm.home_qpos
        self.gripper_target[ids] = self.arm.home_gripper
        self._restore(ids, qpos)

    def move_arm(self, ids: np.ndarray, arm_qpos: np.ndarray) -> None:
        """Put the arm at joint positions (k, j) [rad], gripper as it is; bodies stay where they are."""
        qpos = self.qpos[ids].copy()
        qpos[:, : self._joints] = arm_qpos
        self._restore(ids, qpos)
        self._read(ids)

    def move_body(self, ids: np.ndarray, body: str, poses: np.ndarray) -> None:
        """Put one body at `poses` (k, 7); all else stays where it is."""
        qpos = self.qpos[ids].copy()
        arm_target = self.arm_target[ids].copy()
        qpos[:, self._qpos_slice[body]] = poses
        self._restore(ids, qpos)
        self.arm_target[ids] = arm_target
        self._ctrl[ids, : self._joints] = arm_target
        self.judge.put_one(ids, body)
        self._read(ids, stepped=False)

    def settle(self, ids: np.ndarray) -> None:
        """Let the bodies of the simulations come to rest, the arm holding still.

        One that diverges is put back to where it began, at rest.
        """
        before = self.qpos[ids].copy()
        for _ in range(SETTLE_MAX_CHUNKS):
            broken = self._advance(ids, round(SETTLE_CHUNK_S / self.arm.timestep_s))
            diverged = broken[ids] | self._is_diverged(ids)
            if diverged.any():
                self._restore(ids[diverged], before[diverged])
            moving = np.abs(self.qvel[ids, self._robot :]).max(1) > SETTLE_SPEED
            ids, before = ids[moving], before[moving]
            if not len(ids):
                return

    # Readings ---------------------------------------------------------------------------------------------

    def end_effector(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured pose of the end-effector site: p_we (n, 3) [m] and R_we (n, 3, 3)."""
        p, R, *_ = self._measured_pose(self.qpos[:, : self._joints])
        return p, R

    def target_position(self) -> np.ndarray:
        """Position of the end effector's target (n, 3) [m]."""
        return self._target_pose(self.arm_target)[0]

    def gripper_opening(self) -> np.ndarray:
        """Opening of the gripper (n,), 0 closed to 1 open."""
        return self.arm.gripper_opening(self.qpos)

    def body_pose(self, body: str) -> np.ndarray:
        """Pose of a body (n, 7): position [m] and quaternion (w, x, y, z)."""
        return self.qpos[:, self._qpos_slice[body]]

    def body_poses(self) -> np.ndarray:
        """Poses of all bodies (n, bodies, 7), in the scene's order."""
        return self.qpos[:, self._robot :].reshape(self.num_sims, -1, 7)

    def force(self, sensor: str) -> np.ndarray:
        """Net contact force (n, 3) of a sensor [N], world frame."""
        return self.sensordata[:, self._sensor_slice[sensor]]

    def _read(self, ids: np.ndarray, *, settled: bool = False, stepped: bool = True) -> None:
        """Let the judge see the simulations `ids` as they are now."""
        if len(ids):
            self.judge.read(ids, self._closing_axis(ids), settled=settled, stepped=stepped)

    def _read_grasps(self, ids: np.ndarray) -> None:
        """The same between two readings: what the hands hold, and nothing else."""
        if len(ids):
            self.judge.read_grasps(ids, self._closing_axis(ids))

    def _closing_axis(self, ids: np.ndarray) -> np.ndarray:
        """(k, 3), world frame."""
        return self.arm.closing_axis(self._measured_pose(self.qpos[ids, : self._joints])[1])

    def is_grasped(self, obj: str) -> np.ndarray:
        """Both fingers press on the object (n,); see `Judge.is_grasped`."""
        return self.judge.is_grasped(obj)

    def is_on(self, obj: str, receptacle: str) -> np.ndarray:
        """The object is placed on the receptacle (n,); see `Judge.is_on`."""
        return self.judge.is_on(obj, receptacle)

    def is_on_table(self, obj: str) -> np.ndarray:
        """The object is released and rests on the table within reach, on no receptacle (n,)."""
        return self.judge.is_on_table(obj) & self.arm.is_within(self.body_pose(obj)[:, :2])

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
