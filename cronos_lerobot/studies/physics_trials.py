"""Trials of the physics that tasks rely on: friction, rest, grasp, tracking, random actions; no policy learns.

Every trial draws what it needs from its own seed, so that two versions of the physics meet the same placements and
actions. `cronos_lerobot.studies.physics_check` runs and prints them.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from lerobot_env_cronos import CronosVectorEnv, get_scene
from lerobot_env_cronos.expert.ceiling import STATE_OBSERVATIONS, has_lost_body
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.scene.model import FLOOR_Z, TABLE_HIGH, TABLE_LOW, build_model
from lerobot_env_cronos.scene.physics import PHYSICS, Physics
from lerobot_env_cronos.scene.scenes import BODIES, STEPS_PER_TASK
from lerobot_env_cronos.simulation.simulation import ACTION_HIGH, ACTION_LOW, NUM_ARM_JOINTS
from tqdm import trange

GRAVITY = 9.81
LIFTED_Z = 0.05
"""An object whose centre is higher is off the table and off every receptacle [m]."""


def make_env(num_streams: int, scene: str, physics: Physics) -> CronosVectorEnv:
    """The environment under another physics, observing the privileged state."""
    kind = type("PhysicsEnv", (CronosVectorEnv,), {"physics": physics})
    return kind(num_streams, scene, obs_type=STATE_OBSERVATIONS)


# One body in plain MuJoCo, sleep and motors off: what contacts and friction alone do -------------------------


def bodies_at_rest(
    scene: str, poses: dict[str, tuple[float, float, float]], physics: Physics
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data of `scene` after half a second, nothing asleep, no motors, the arm at home.

    Args:
        scene: its name.
        poses: x, y and height of the underside by body [m]; the other bodies wait at the table's edge.
        physics: time step and integrator.
    """
    model = build_model(get_scene(scene), False, physics)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    data = mujoco.MjData(model)
    data.qpos[:8] = make_env(1, scene, physics).simulation.qpos[0, :8]
    for i, name in enumerate(get_scene(scene).bodies):
        x, y, z = poses.get(name, (-0.10, -0.36 + 0.14 * i, 0.0))
        data.joint(name).qpos[:] = [x, y, z + BODIES[name].size[2] / 2, 1, 0, 0, 0]
    advance(model, data, 0.5)
    return model, data


def advance(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    """Step for a time [s]."""
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)


def slide(scene: str, body: str, slope: float, seconds: float = 1.0, physics: Physics = PHYSICS) -> float:
    """How far `body` moves down a table inclined by `slope` (the tangent of its angle) in a time [m]."""
    model, data = bodies_at_rest(scene, {body: (0.30, 0.0, 0.0)}, physics)
    angle = np.arctan(slope)
    model.opt.gravity[:] = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    before = data.joint(body).qpos[0]
    advance(model, data, seconds)
    return float(data.joint(body).qpos[0] - before)


def coast(scene: str, body: str, speed: float = 0.5, physics: Physics = PHYSICS) -> float:
    """How far `body` slides on the table when it is let go at `speed` [m/s]; Coulomb's is v^2 / (2 mu g) [m]."""
    model, data = bodies_at_rest(scene, {body: (0.30, 0.0, 0.0)}, physics)
    before = data.joint(body).qpos[:2].copy()
    data.joint(body).qvel[0] = speed
    advance(model, data, 2.0)
    return float(np.linalg.norm(data.joint(body).qpos[:2] - before))


@dataclass(frozen=True)
class Rest:
    """Of bodies that nothing touches."""

    depth: float
    """Deepest penetration of any contact between bodies and table [m]."""
    drift: float
    """Longest way any body moved [m]."""
    speed: float
    """Fastest any body moved [m/s]."""


def rest(
    scene: str, poses: dict[str, tuple[float, float, float]], control_steps: int, physics: Physics = PHYSICS
) -> Rest:
    """Bodies placed at `poses` (see `bodies_at_rest`), watched over a number of control steps."""
    model, data = bodies_at_rest(scene, poses, physics)
    ids = [model.body(name).id for name in poses]
    dofs = np.concatenate([np.arange(3) + model.joint(name).dofadr[0] for name in poses])
    before, depth, drift, speed = data.xpos[ids].copy(), 0.0, 0.0, 0.0
    for _ in range(control_steps):
        advance(model, data, 0.2)
        depth = max(depth, -float(data.contact.dist.min(initial=0.0)))
        drift = max(drift, float(np.linalg.norm(data.xpos[ids] - before, axis=1).max()))
        speed = max(speed, float(np.abs(data.qvel[dofs]).max()))
    return Rest(depth, drift, speed)


# In the hand -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Slip:
    """Of one object in the closed hand, in the streams where the expert lifted it; (k,) [m]."""

    fast: np.ndarray
    """Way in the hand's frame over 20 steps at full speed, to and fro."""
    still: np.ndarray
    """The same over 40 steps without motion before that."""


def slip(scene: str, obj: str, num_streams: int = 64, physics: Physics = PHYSICS) -> Slip:
    """The expert lifts `obj` from training configurations; then it is held still, then swung at full speed."""
    env = make_env(num_streams, scene, physics)
    everyone, sim = np.arange(num_streams), env.simulation
    env.set_task(everyone, [next(task for task in env.scene.tasks if task.object == obj)] * num_streams)
    expert, lifted = ScriptedExpert(env), np.zeros(num_streams, dtype=bool)
    for _ in range(40):
        lifted |= sim.is_grasped(obj) & (sim.body_pose(obj)[:, 2] > LIFTED_Z)
        env.step(np.where(lifted[:, None], 0.0, expert.act()))

    def in_hand() -> np.ndarray:
        p, R = sim.end_effector()
        return np.einsum("nji,nj->ni", R, sim.body_pose(obj)[:, :3] - p)

    start = in_hand()
    for _ in range(40):
        env.step(np.zeros((num_streams, 7)))
    middle = in_hand()
    towards_centre = np.where(sim.end_effector()[0][:, 1] > 0, ACTION_LOW[1], ACTION_HIGH[1])
    for step in range(20):
        action = np.zeros((num_streams, 7))
        action[:, 1] = towards_centre if (step // 5) % 2 == 0 else -towards_centre
        env.step(action)
    moved = (np.linalg.norm(b - a, axis=1)[lifted] for a, b in ((middle, in_hand()), (start, middle)))
    return Slip(*moved)


# Random actions --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mishaps:
    """What random actions led to."""

    control_steps: int
    episodes: int
    diverged: int
    """Control steps that diverged."""
    lost: int
    """Episodes of 80 steps that ended with a body outside the reach of the arm or below the table."""
    through_table: int
    """Episodes that ended with a body beneath the table top, between it and the floor, over its area."""
    tracking_error: float
    """Mean over joints and control steps of the distance to the target at the step's end [rad]."""
    worst_tracking: float
    """99th percentile of the largest such distance of a control step [rad]."""


def random_actions(
    scene: str, control_steps: int, num_streams: int = 64, seed: int = 0, physics: Physics = PHYSICS
) -> Mishaps:
    """Episodes of 80 steps of uniformly random actions."""
    env = make_env(num_streams, scene, physics)
    rng, everyone, sim = np.random.default_rng(seed), np.arange(num_streams), env.simulation
    rounds = max(1, round(control_steps / (num_streams * STEPS_PER_TASK)))
    diverged = lost = through = 0
    errors = []
    for k in trange(rounds, desc=f"random actions in {scene}", leave=False):
        env.scene_reset(everyone, (everyone + k * num_streams) % 64)
        for _ in range(STEPS_PER_TASK):
            action = rng.uniform(ACTION_LOW, ACTION_HIGH, (num_streams, 7))
            *_, info = env.step(action)
            diverged += int(info["diverged"].sum())
            errors.append(np.abs(sim.qpos[:, :NUM_ARM_JOINTS] - sim.arm_target))
        lost += int(has_lost_body(env).sum())
        through += int(_under_the_table(sim.body_poses()[..., :3]).any(1).sum())
    error = np.stack(errors)
    return Mishaps(
        rounds * num_streams * STEPS_PER_TASK, rounds * num_streams, diverged, lost, through,
        float(error.mean()), float(np.quantile(error.max(-1), 0.99)),
    )  # fmt: skip


def _under_the_table(position: np.ndarray) -> np.ndarray:
    over = ((position[..., :2] > TABLE_LOW) & (position[..., :2] < TABLE_HIGH)).all(-1)
    # What fell over the edge may have rolled below the table: that lies on the floor.
    return np.asarray(over & (position[..., 2] < -0.005) & (position[..., 2] > FLOOR_Z + 0.2))
