"""The scripted expert, which is the ceiling of the benchmark, and the physics that it relies on."""

import numpy as np
import pytest
from lerobot_env_cronos import CronosVectorEnv, get_scene
from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS, SPLITS
from lerobot_env_cronos.expert.ceiling import (
    has_lost_body,
    measure_independent,
    measure_reset_free,
    run_segment,
    success_rate,
    write_csv,
)
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.simulation.simulation import ACTION_HIGH, ACTION_LOW

SCENE = "kitchen_2x2"
TASKS = get_scene(SCENE).tasks
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])
N = NUM_CONFIGURATIONS // 2
EVERYONE = np.arange(N)


@pytest.fixture(scope="module")
def env() -> CronosVectorEnv:
    return CronosVectorEnv(N, SCENE, obs_type="environment_state_agent_pos")


@pytest.fixture(scope="module")
def every_configuration() -> CronosVectorEnv:
    return CronosVectorEnv(NUM_CONFIGURATIONS, SCENE, obs_type="environment_state_agent_pos")


def start(env: CronosVectorEnv, split: str = "train") -> ScriptedExpert:
    """Every stream at its own configuration, tasks in turn."""
    env.scene_reset(EVERYONE, EVERYONE, split)
    env.set_task(EVERYONE, [TASKS[i % len(TASKS)] for i in EVERYONE])
    return ScriptedExpert(env)


def roll(env: CronosVectorEnv, expert: ScriptedExpert, steps: int) -> np.ndarray:
    success = np.zeros(env.num_envs, dtype=bool)
    for _ in range(steps):
        success |= env.step(expert.act())[-1]["is_success"]
    return success


# Success ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.instruction)
def test_expert_succeeds_from_held_out_configurations(every_configuration, task):
    assert measure_independent(SCENE, "held_out", task, every_configuration).mean() >= 0.95


def test_expert_keeps_succeeding_without_scene_resets():
    streams = measure_reset_free(SCENE, num_streams=16, num_segments=5)
    assert streams.success.shape == streams.instructions.shape == (5, 16)
    assert streams.success.mean() >= 0.95
    assert streams.lost.mean() <= 0.05
    # Every stream goes round the cycle, each from its own offset.
    assert (streams.instructions[0] == streams.instructions[len(TASKS)]).all()
    assert streams.instructions[1, 0] == streams.instructions[0, 1] == TASKS[1].instruction


def test_expert_needs_no_end_effector_reset():
    streams = measure_reset_free(SCENE, num_streams=16, num_segments=3, end_effector_reset=False)
    assert streams.success.mean() >= 0.95


def test_expert_puts_objects_back_on_the_table(env):
    assert roll(env, start(env), 30).mean() >= 0.95
    resets = {task.object: task for task in env.scene.reset_tasks}
    env.set_task(EVERYONE, [resets[task.object] for task in env.tasks])
    assert env.is_success.mean() < 0.05
    assert roll(env, ScriptedExpert(env), 40).mean() >= 0.95


def test_expert_recovers_from_perturbed_actions(env):
    expert, rng = start(env), np.random.default_rng(0)
    bias, left = np.zeros((N, 7)), np.zeros(N, dtype=int)
    success = np.zeros(N, dtype=bool)
    for _ in range(80):
        new = (left == 0) & (rng.random(N) < 0.08)
        bias[new] = rng.uniform(ACTION_LOW, ACTION_HIGH, (new.sum(), 7))
        left = np.where(new, 3, np.maximum(left - 1, 0))
        success |= env.step(np.where((left > 0)[:, None], bias, expert.act()))[-1]["is_success"]
    assert success.mean() >= 0.9


def test_expert_starts_from_any_arm_pose(env):
    rng = np.random.default_rng(0)
    expert = start(env)
    for _ in range(8):
        action = rng.uniform(ACTION_LOW, ACTION_HIGH, (N, 7))
        for _ in range(5):
            env.step(action)
    expert.reset(EVERYONE)
    assert run_segment(env, expert.act, stop_early=True).mean() >= 0.85


# Contract -----------------------------------------------------------------------------------------------


def test_actions_are_within_bounds_deterministic_and_leave_the_env_alone(env):
    actions = []
    for _ in range(2):
        expert = start(env)
        taken = []
        for _ in range(20):
            before = env.simulation.qpos.copy()
            action = expert.act()
            np.testing.assert_array_equal(env.simulation.qpos, before)
            taken.append(action)
            env.step(action)
        actions.append(np.stack(taken))
    np.testing.assert_array_equal(actions[0], actions[1])
    assert actions[0].shape == (20, N, 7)
    assert (actions[0] >= ACTION_LOW).all()
    assert (actions[0] <= ACTION_HIGH).all()


def test_what_is_complete_stays_complete(env):
    expert = start(env)
    roll(env, expert, 50)
    complete, bodies = env.is_success.copy(), env.simulation.body_poses()[..., :3].copy()
    assert complete.mean() > 0.9
    expert.reset(EVERYONE)
    roll(env, expert, 10)
    assert env.is_success[complete].all()
    moved = np.linalg.norm(env.simulation.body_poses()[..., :3] - bodies, axis=-1).max(1)
    assert (moved[complete] < 0.002).mean() > 0.95


# Physics that the tasks rely on -------------------------------------------------------------------------


@pytest.mark.parametrize("split", SPLITS)
def test_doing_nothing_completes_nothing_and_moves_nothing(every_configuration, split):
    env, everyone = every_configuration, np.arange(NUM_CONFIGURATIONS)
    env.scene_reset(everyone, everyone, split)
    before = env.simulation.body_poses()[..., :3].copy()
    for _ in range(80):
        env.step(np.tile(STILL, (NUM_CONFIGURATIONS, 1)))
        for task in TASKS:
            assert not env.simulation.is_on(task.object, task.receptacle).any()
    assert np.abs(env.simulation.body_poses()[..., :3] - before).max() < 0.001
    assert not has_lost_body(env).any()


@pytest.mark.parametrize("obj", get_scene(SCENE).objects)
def test_grasped_objects_do_not_slip_at_full_speed(env, obj):
    env.scene_reset(EVERYONE, EVERYONE)
    env.set_task(EVERYONE, [next(task for task in TASKS if task.object == obj)] * N)
    expert = ScriptedExpert(env)
    sim = env.simulation
    lifted = np.zeros(N, dtype=bool)
    for _ in range(40):
        # Streams that hold the object at carrying height wait for the others.
        lifted |= sim.is_grasped(obj) & (sim.body_pose(obj)[:, 2] > 0.05)
        env.step(np.where(lifted[:, None], STILL * [0, 0, 0, 0, 0, 0, 0], expert.act()))
    assert lifted.mean() > 0.97

    def in_hand() -> np.ndarray:
        p, R = sim.end_effector()
        return np.einsum("nji,nj->ni", R, sim.body_pose(obj)[:, :3] - p)

    start_pose = in_hand()
    towards_centre = np.where(sim.end_effector()[0][:, 1] > 0, ACTION_LOW[1], ACTION_HIGH[1])
    for step in range(20):
        action = np.zeros((N, 7))
        action[:, 1] = towards_centre if (step // 5) % 2 == 0 else -towards_centre
        env.step(action)
    slip = np.linalg.norm(in_hand() - start_pose, axis=1)
    assert (slip[lifted] < 0.005).mean() >= 0.97


@pytest.mark.parametrize(("body", "limit"), [("yellow plate", 0.003), ("cloth", 0.003), ("ketchup bottle", 0.01)])
def test_pushed_bodies_come_to_rest(env, body, limit):
    env.scene_reset(EVERYONE, EVERYONE)
    i = env.scene.bodies.index(body)
    before = env.simulation.body_pose(body)[:, :3].copy()
    angle = 2 * np.pi * EVERYONE / N
    env.simulation.qvel[:, 8 + 6 * i : 8 + 6 * i + 2] = 0.1 * np.stack([np.cos(angle), np.sin(angle)], 1)
    for _ in range(10):
        env.step(np.tile(STILL, (N, 1)))
    travelled = np.linalg.norm(env.simulation.body_pose(body)[:, :3] - before, axis=1)
    # Sliding at 0.1 m/s with friction 1 ends after v^2 / (2 g) = 0.5 mm.
    assert 0.0001 < np.median(travelled) < limit


def test_end_effector_reset_moves_no_unheld_body(env):
    roll(env, start(env), 30)
    held = np.any([env.simulation.is_grasped(name) for name in env.scene.objects], axis=0)
    before = env.simulation.body_poses()[..., :3].copy()
    env.end_effector_reset(EVERYONE)
    moved = np.linalg.norm(env.simulation.body_poses()[..., :3] - before, axis=-1).max(1)
    assert (~held).mean() > 0.9
    assert moved[~held].max() < 0.002


# The report ---------------------------------------------------------------------------------------------


def test_csv_has_one_row_per_rate(tmp_path):
    rates = [success_rate("train", "all", np.array([True, False, True, True]))]
    write_csv(tmp_path / "rates.csv", rates)
    header, row = (tmp_path / "rates.csv").read_text().splitlines()
    assert header == "group,task,successes,n,rate,low,high"
    assert row.startswith("train,all,3,4,0.75,")
