"""The scripted expert, which is the ceiling of the benchmark, and the physics that it relies on."""

import numpy as np
import pytest
from env_rollouts import STILL, keep_still, make, run_expert
from lerobot_env_cronos import SCENES, CronosVectorEnv, ScriptedExpert, Task, get_scene
from lerobot_env_cronos.benchmark.configurations import load_configurations
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX

TASKS = get_scene("kitchen_2x2").tasks
N = 16
EVERYONE = np.arange(N)


@pytest.fixture(scope="module")
def env() -> CronosVectorEnv:
    return make(N)


def start(env: CronosVectorEnv, split: str = "train") -> ScriptedExpert:
    """Every stream at its own configuration, tasks in turn."""
    env.scene_reset(EVERYONE, EVERYONE, split)
    env.set_task(EVERYONE, [TASKS[i % len(TASKS)] for i in EVERYONE])
    return ScriptedExpert(env)


# Success -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
def test_it_solves_every_task_from_held_out_configurations(scene):
    tasks, each = SCENES[scene].tasks, 8
    env = make(each * len(tasks), scene)
    everyone = np.arange(env.num_envs)
    env.scene_reset(everyone, everyone % each, "held_out")
    env.set_task(everyone, [tasks[i // each] for i in everyone])
    assert not env.is_success.any()
    success = run_expert(env).reshape(len(tasks), each)
    assert success.mean(1).min() >= 0.8
    assert success.mean() >= 0.97


@pytest.mark.parametrize("scene", SCENES)
def test_it_keeps_succeeding_without_scene_resets_and_puts_objects_back(scene):
    """Streams that alternate a task and the reset task of its object, each from its own place in the cycle."""
    n, tasks = 8, SCENES[scene].tasks
    env, successes = make(n, scene), []
    expert, everyone = ScriptedExpert(env), np.arange(n)
    for segment in range(6):
        chosen = [tasks[(segment // 2 + i) % len(tasks)] for i in range(n)]
        env.set_task(everyone, [Task(t.object, None) for t in chosen] if segment % 2 else chosen)
        successes.append(run_expert(env, expert=expert))
        if segment < 2:  # It needs no arm at home, either.
            env.end_effector_reset(everyone)
    assert np.mean(successes) >= 0.93
    assert env.unsuitable_bodies().any(axis=1).mean() <= 0.25


def test_it_starts_from_any_arm_pose_and_recovers_from_perturbed_actions(env):
    rng, expert = np.random.default_rng(0), start(env)
    for _ in range(8):
        action = rng.uniform(WIDOWX.action_low, WIDOWX.action_high, (N, 7))
        for _ in range(5):
            env.step(action)
    expert.reset(EVERYONE)
    bias, left = np.zeros((N, 7)), np.zeros(N, dtype=int)
    success = np.zeros(N, dtype=bool)
    for _ in range(80):
        new = (left == 0) & (rng.random(N) < 0.08)
        bias[new] = rng.uniform(WIDOWX.action_low, WIDOWX.action_high, (new.sum(), 7))
        left = np.where(new, 3, np.maximum(left - 1, 0))
        success |= env.step(np.where((left > 0)[:, None], bias, expert.act()))[-1]["is_success"]
    assert success.mean() >= 0.8


# Contract ------------------------------------------------------------------------------------------------


def test_an_expert_of_some_streams_acts_there_as_one_of_all():
    env, rng, streams = make(4), np.random.default_rng(0), np.array([3, 1])
    env.set_task(np.arange(4), env.scene.tasks)
    for _ in range(12):
        # Wherever arms and bodies are.
        env.step(rng.uniform(-0.03, 0.03, (4, 7)))
    everyone, some = ScriptedExpert(env), ScriptedExpert(env, streams=streams)
    closed = False
    for _ in range(40):
        actions = everyone.act()
        np.testing.assert_allclose(some.act(), actions[streams], atol=1e-9)
        closed |= bool((actions[streams, 6] < 0.5).any())
        env.step(actions)
    # Far enough to grasp and to choose a place.
    assert closed


# Physics that the tasks rely on --------------------------------------------------------------------------


@pytest.mark.parametrize("obj", get_scene("kitchen_2x2").objects)
def test_grasped_objects_do_not_slip_at_full_speed(env, obj):
    env.scene_reset(EVERYONE, EVERYONE)
    env.set_task(EVERYONE, [next(task for task in TASKS if task.object == obj)] * N)
    expert, sim, lifted = ScriptedExpert(env), env.simulation, np.zeros(N, dtype=bool)
    for _ in range(40):
        # Streams that hold the object at carrying height wait for the others.
        lifted |= sim.is_grasped(obj) & (sim.body_pose(obj)[:, 2] > 0.05)
        env.step(np.where(lifted[:, None], 0 * STILL, expert.act()))
    assert lifted.mean() > 0.97

    def in_hand() -> np.ndarray:
        p, R = sim.end_effector()
        return np.einsum("nji,nj->ni", R, sim.body_pose(obj)[:, :3] - p)

    start_pose = in_hand()
    towards_centre = np.where(sim.end_effector()[0][:, 1] > 0, WIDOWX.action_low[1], WIDOWX.action_high[1])
    for step in range(20):
        action = np.zeros((N, 7))
        action[:, 1] = towards_centre if (step // 5) % 2 == 0 else -towards_centre
        env.step(action)
    slip = np.linalg.norm(in_hand() - start_pose, axis=1)
    assert (slip[lifted] < 0.005).mean() >= 0.97


@pytest.mark.parametrize(
    ("scene", "body"), [("kitchen_2x2", "ketchup bottle"), ("playroom_2x2", "plastic bottle")]
)
def test_pushed_bottles_come_to_rest(scene, body):
    env = make(N, scene)
    env.scene_reset(EVERYONE, EVERYONE)
    i, angle = env.scene.bodies.index(body), 2 * np.pi * EVERYONE / N
    before = env.simulation.body_pose(body)[:, :3].copy()
    env.simulation.qvel[:, 8 + 6 * i : 8 + 6 * i + 2] = 0.1 * np.stack([np.cos(angle), np.sin(angle)], 1)
    keep_still(env, 10)
    travelled = np.linalg.norm(env.simulation.body_pose(body)[:, :3] - before, axis=1)
    # Sliding at 0.1 m/s with friction 1 ends after v^2 / (2 g) = 0.5 mm; receptacles are in test_physics.py.
    assert 0.0001 < np.median(travelled) < 0.01


def test_the_bear_stands_up_to_a_nudge():
    env, angle = make(16, "playroom_2x2"), 2 * np.pi * np.arange(16) / 16
    # Below sqrt(2 g h), h what its centre of mass rises by before it topples: some 0.25 m/s.
    env.simulation.qvel[:, 8:10] = 0.15 * np.stack([np.cos(angle), np.sin(angle)], 1)
    keep_still(env, 10)
    assert (env.simulation.body_rotations()[:, 0, 2, 2] > 0.99).all()


def test_a_reset_task_wants_the_object_released_on_the_table_within_reach():
    scene = SCENES["playroom_2x2"]
    bear, carpet = scene.bodies.index("toy bear"), scene.bodies.index("carpet")
    poses = np.tile(load_configurations(scene.name, "train")[:1], (4, 1, 1))
    on_carpet, out_of_reach, in_hand = 1, 2, 3
    poses[on_carpet, bear, :3] = poses[on_carpet, carpet, :3] + [0, 0, 0.0301]
    poses[out_of_reach, bear, :2] = [0.55, 0.0]
    env, everyone = make(4, scene.name), np.arange(4)
    env.place_bodies(everyone, poses)
    env.set_task(everyone, [Task("toy bear", None)] * 4)
    expert = ScriptedExpert(env)
    env.set_task([in_hand], [Task("toy bear", "carpet")])
    for _ in range(80):
        if env.simulation.is_grasped("toy bear")[in_hand]:
            break
        env.step(np.where((everyone == in_hand)[:, None], expert.act(), STILL))
    # Still touching the table, but between the fingers.
    assert np.linalg.norm(env.simulation.force("toy bear/table")[in_hand]) > 0.03
    np.testing.assert_array_equal(env.simulation.is_on_table("toy bear"), [True, False, False, False])
