"""The scripted expert in scenes that reset-free streams end up in: stacked, fallen and crowded objects."""

import numpy as np
from env_rollouts import run_expert
from lerobot_env_cronos import SCENES, CronosVectorEnv, Task

SCENE = SCENES["kitchen_3x3"]
BEAR, SHOVEL, BOTTLE, PLATE, CLOTH, CARPET = range(6)


def yawed(x: float, y: float, z: float, yaw: float = 0.0) -> list[float]:
    return [x, y, z, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]


def tidy() -> np.ndarray:
    """Poses (6, 7): receptacles at the back, objects far from each other at the front."""
    return np.array(
        [
            yawed(0.36, 0.14, 0.0283),
            yawed(0.38, -0.02, 0.0107, np.pi / 2),
            yawed(0.36, -0.14, 0.0105),
            yawed(0.22, -0.14, 0.0030),
            yawed(0.22, 0.00, 0.0047),
            yawed(0.22, 0.14, 0.0019),
        ]
    )


def make(poses: np.ndarray, task: Task) -> CronosVectorEnv:
    """One stream for each of `poses` (n, 6, 7), bodies at rest."""
    env = CronosVectorEnv(len(poses), SCENE.name, obs_type="environment_state_agent_pos")
    everyone = np.arange(len(poses))
    env.place_bodies(everyone, poses)
    env.simulation.settle(everyone)
    env.set_task(everyone, [task] * len(poses))
    return env


def test_what_lies_on_top_is_put_on_the_table_first():
    yaws = np.array([0.0, 0.6, 1.2, 1.8])
    poses = np.stack([tidy()] * len(yaws))
    poses[:, BOTTLE] = yawed(0.33, 0.0, 0.0105, np.pi / 2)
    # The shovel's handle lies across the bottle's belly.
    for pose, yaw in zip(poses, yaws):
        along = np.array([-np.sin(yaw), np.cos(yaw)])
        x, y = np.array([0.34, 0.0]) - 0.02 * along
        pose[SHOVEL] = yawed(x, y, 0.034, yaw)
    env = make(poses, Task("ketchup bottle", "cloth"))
    shovel_before = env.simulation.body_pose("kitchen shovel")[:, :2].copy()
    assert (env.simulation.body_pose("kitchen shovel")[:, 2] > 0.013).all()
    success = run_expert(env)
    moved = np.linalg.norm(env.simulation.body_pose("kitchen shovel")[:, :2] - shovel_before, axis=1)
    assert success.all()
    assert (moved > 0.02).all()
    # The bottle may then be set down against it, so that it leans.
    assert env.simulation.is_on_table("kitchen shovel").sum() >= 3


def test_room_is_made_on_a_full_receptacle():
    poses = np.stack([tidy()] * 2)
    # The bear and the bottle leave the shovel no room on the carpet ...
    poses[:, BEAR] = yawed(0.235, 0.150, 0.0320)
    poses[:, BOTTLE] = yawed(0.200, 0.140, 0.0142)
    # ... and in the second stream they are elsewhere.
    poses[1] = tidy()
    env = make(poses, Task("kitchen shovel", "carpet"))
    before = env.simulation.body_poses()[:, [BEAR, BOTTLE], :2].copy()
    success = run_expert(env)
    moved = np.linalg.norm(env.simulation.body_poses()[:, [BEAR, BOTTLE], :2] - before, axis=-1).max(1)
    assert success.all()
    assert moved[0] > 0.05
    assert moved[1] < 0.001


def test_a_fallen_bear_is_picked_up():
    poses = np.stack([tidy()] * 6)
    half_turn = np.sqrt(0.5)
    # On its back, on its face, on its sides, on its head, and on a side turned by 45 degrees.
    falls = [
        (0, -half_turn, 0),
        (0, half_turn, 0),
        (half_turn, 0, 0),
        (-half_turn, 0, 0),
    ]
    for pose, axis in zip(poses, falls):
        pose[BEAR] = [0.33, 0.10, 0.024, half_turn, *axis]
    poses[4, BEAR] = [0.33, 0.10, 0.029, 0, 1, 0, 0]
    poses[5, BEAR] = [0.33, 0.10, 0.024, 0.653, 0.653, 0.271, 0.271]
    env = make(poses, Task("toy bear", "yellow plate"))
    assert (env.simulation.body_rotations()[:, BEAR, 2, 2] < 0.3).all()
    assert run_expert(env).all()
