"""What every scene must offer: tasks that an expert solves and doing nothing does not, and bodies that stay."""

import numpy as np
import pytest
from lerobot_env_cronos import SCENES, CronosVectorEnv, Task
from lerobot_env_cronos.benchmark.configurations import (
    NUM_CONFIGURATIONS,
    SPLITS,
    footprint_corners,
    load_configurations,
)
from lerobot_env_cronos.expert.ceiling import has_lost_body, measure_reset_free, run_segment
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.scene.robot import HOME_QPOS
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.scene.view import is_in_view
from lerobot_env_cronos.simulation.kinematics import forward_kinematics, inverse_kinematics

# kitchen_2x2 has tests of its own, on all configurations: test_expert.py.
NEW_SCENES = ("kitchen_3x3", "playroom_2x2")
CONFIGURATIONS = 16
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])


def make(scene: str, num_envs: int) -> CronosVectorEnv:
    return CronosVectorEnv(num_envs, scene, obs_type="environment_state_agent_pos")


@pytest.mark.parametrize(
    ("name", "instructions"),
    [
        (
            "kitchen_3x3",
            [
                f"put the {obj} on the {receptacle}"
                for obj in ("toy bear", "kitchen shovel", "ketchup bottle")
                for receptacle in ("yellow plate", "cloth", "carpet")
            ],
        ),
        (
            "playroom_2x2",
            [
                "put the toy bear on the newspaper",
                "put the toy bear on the carpet",
                "put the plastic bottle on the newspaper",
                "put the plastic bottle on the carpet",
            ],
        ),
    ],
)
def test_tasks_of_the_paper(name, instructions):
    assert [task.instruction for task in SCENES[name].tasks] == instructions


def test_published_sizes_and_densities_give_these_masses():
    masses = {}
    for name in NEW_SCENES:
        model = make(name, 1).simulation.model
        masses |= {body: model.body(body).mass[0] for body in SCENES[name].bodies}
    assert masses["carpet"] == pytest.approx(0.110 * 0.0943 * 0.0037 * 2815)
    assert masses["newspaper"] == pytest.approx(0.0815 * 0.1161 * 0.0041 * 2278)
    # A body of 55 % of the height, and a head that is 0.75 as deep and 0.85 as wide.
    share = 0.55 + 0.45 * 0.75 * 0.85
    assert masses["toy bear"] == pytest.approx(share * 0.0426 * 0.0386 * 0.0564 * 667)
    # A belly of 72 % of the length and a neck 0.55 as thick.
    share = 0.72 + 0.28 * 0.55**2
    assert masses["plastic bottle"] == pytest.approx(share * 0.0361 * 0.1216 * 0.0390 * 1916)


# Tasks --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", NEW_SCENES)
def test_expert_solves_every_task(scene):
    tasks = SCENES[scene].tasks
    env = make(scene, CONFIGURATIONS * len(tasks))
    everyone = np.arange(env.num_envs)
    env.scene_reset(everyone, everyone % CONFIGURATIONS, "held_out")
    env.set_task(everyone, [tasks[i // CONFIGURATIONS] for i in everyone])
    assert not env.is_success.any()
    success = run_segment(env, ScriptedExpert(env).act, stop_early=True).reshape(len(tasks), CONFIGURATIONS)
    by_task = {task.instruction: rate for task, rate in zip(tasks, success.mean(1))}
    assert min(by_task.values()) >= 0.9, by_task
    assert success.mean() >= 0.97


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("scene", NEW_SCENES)
def test_doing_nothing_solves_nothing_and_moves_nothing(scene, split):
    env = make(scene, NUM_CONFIGURATIONS)
    everyone = np.arange(NUM_CONFIGURATIONS)
    env.scene_reset(everyone, everyone, split)
    before = env.simulation.body_poses().copy()
    for _ in range(80):
        env.step(np.tile(STILL, (NUM_CONFIGURATIONS, 1)))
        for task in env.scene.tasks:
            assert not env.simulation.is_on(task.object, task.receptacle).any()
    after = env.simulation.body_poses()
    assert np.abs(after - before)[..., :3].max() < 1e-4
    assert np.abs(after - before)[..., 3:].max() < 1e-3
    assert np.abs(env.simulation.qvel[:, 8:]).max() < 1e-6
    assert not has_lost_body(env).any()


@pytest.mark.parametrize("scene", NEW_SCENES)
def test_expert_keeps_succeeding_without_scene_resets(scene):
    streams = measure_reset_free(scene, num_streams=len(SCENES[scene].tasks), num_segments=8)
    assert streams.success.mean() >= 0.93
    assert streams.lost.mean() <= 0.25


@pytest.mark.parametrize("scene", SCENES)
def test_expert_puts_objects_back_on_the_table(scene):
    streams = measure_reset_free(scene, num_streams=12, num_segments=4, reset_tasks=True)
    is_reset = np.char.endswith(streams.instructions, "on the table")
    assert (is_reset == (np.arange(4) % 2 == 1)[:, None]).all()
    assert streams.success[is_reset].mean() >= 0.9


def test_reset_task_wants_the_object_released_on_the_table_within_reach():
    scene = SCENES["playroom_2x2"]
    bear, carpet = scene.bodies.index("toy bear"), scene.bodies.index("carpet")
    poses = np.tile(load_configurations(scene.name, "train")[:1], (4, 1, 1))
    on_carpet, out_of_reach, in_hand = 1, 2, 3
    poses[on_carpet, bear, :3] = poses[on_carpet, carpet, :3] + [0, 0, 0.0301]
    poses[out_of_reach, bear, :2] = [0.55, 0.0]
    env, everyone = make(scene.name, 4), np.arange(4)
    env.place_bodies(everyone, poses)
    env.set_task(everyone, [Task("toy bear", None)] * 4)
    expert = ScriptedExpert(env)
    pick = Task("toy bear", "carpet")
    env.set_task([in_hand], [pick])
    for _ in range(80):
        is_held = env.simulation.is_grasped("toy bear")[in_hand]
        if is_held:
            break
        env.step(np.where((everyone == in_hand)[:, None], expert.act(), STILL))
    assert is_held
    # Still touching the table, but between the fingers.
    assert np.linalg.norm(env.simulation.force("toy bear/table")[in_hand]) > 0.03
    np.testing.assert_array_equal(env.simulation.is_on_table("toy bear"), [True, False, False, False])


# Bodies -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
def test_every_body_is_in_the_picture_and_in_reach(scene):
    for split in SPLITS:
        poses = load_configurations(scene, split)
        for i, name in enumerate(SCENES[scene].bodies):
            yaws = 2 * np.arctan2(poses[:, i, 6], poses[:, i, 3])
            corners = np.stack([footprint_corners(name, p[:2], yaw) for p, yaw in zip(poses[:, i], yaws)])
            for height in (0.0, BODIES[name].size[2]):
                points = np.concatenate([corners, np.full((*corners.shape[:2], 1), height)], -1)
                assert is_in_view(points).all()
        # A hand that points down and across the line to the robot, just above every body.
        goal = poses[..., :3].reshape(-1, 3) + np.array([0, 0, 0.03])
        n = len(goal)
        bearing = np.arctan2(goal[:, 1], goal[:, 0])
        closing = np.stack([-np.sin(bearing), np.cos(bearing), 0 * bearing], 1)
        down = np.tile([0.0, 0.0, -1.0], (n, 1))
        R = np.stack([down, closing, np.cross(down, closing)], 2)
        q = np.tile(HOME_QPOS, (n, 1))
        start, _, _ = forward_kinematics(q)
        for way in np.linspace(0.05, 1.0, 20)[:, None]:
            q = inverse_kinematics(q, start + way * (goal - start), R)
        reached, R_reached, _ = forward_kinematics(q)
        assert np.linalg.norm(reached - goal, axis=1).max() < 0.001
        assert (R_reached[:, 2, 0] < -0.999).all()


def test_the_bear_stands_up_to_a_nudge():
    env = make("playroom_2x2", CONFIGURATIONS)
    angle = 2 * np.pi * np.arange(CONFIGURATIONS) / CONFIGURATIONS
    # Below sqrt(2 g h), h what its centre of mass rises by before it topples: some 0.25 m/s.
    env.simulation.qvel[:, 8:10] = 0.15 * np.stack([np.cos(angle), np.sin(angle)], 1)
    for _ in range(10):
        env.step(np.tile(STILL, (CONFIGURATIONS, 1)))
    assert (env.simulation.body_rotations()[:, 0, 2, 2] > 0.99).all()


def test_a_bottle_that_is_pushed_does_not_roll_away():
    env = make("playroom_2x2", CONFIGURATIONS)
    i = env.scene.bodies.index("plastic bottle")
    before = env.simulation.body_pose("plastic bottle")[:, :2].copy()
    angle = 2 * np.pi * np.arange(CONFIGURATIONS) / CONFIGURATIONS
    env.simulation.qvel[:, 8 + 6 * i : 10 + 6 * i] = 0.1 * np.stack([np.cos(angle), np.sin(angle)], 1)
    for _ in range(10):
        env.step(np.tile(STILL, (CONFIGURATIONS, 1)))
    travelled = np.linalg.norm(env.simulation.body_pose("plastic bottle")[:, :2] - before, axis=1)
    assert np.median(travelled) > 0.0001
    assert travelled.max() < 0.01
