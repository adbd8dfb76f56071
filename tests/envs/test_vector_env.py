"""The native vector env: interventions, rewards, determinism, refusal of bad actions."""

import numpy as np
import pytest
from lerobot_env_cronos import CronosVectorEnv, Task, get_scene
from lerobot_env_cronos.scene.robot import HOME_QPOS
from lerobot_env_cronos.simulation.simulation import ACTION_HIGH, ACTION_LOW

STATE = "environment_state_agent_pos"
BOTTLE, PLATE = "ketchup bottle", "yellow plate"
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])


def make(n: int = 4, **kwargs) -> CronosVectorEnv:
    return CronosVectorEnv(n, **({"obs_type": STATE} | kwargs))


def random_actions(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(ACTION_LOW, ACTION_HIGH, (n, 7))


def roll(env: CronosVectorEnv, steps: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    states = []
    for _ in range(steps):
        observation, *_ = env.step(random_actions(rng, env.num_envs))
        states.append(np.concatenate([observation["environment_state"], observation["agent_pos"]], axis=1))
    return np.stack(states)


def hold_bottle(env: CronosVectorEnv) -> None:
    """Put the bottle between the fingers of a raised hand and close them."""
    p, _ = env.simulation.end_effector()
    everyone = np.arange(env.num_envs)
    pose = np.tile([0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (env.num_envs, 1))
    pose[:, :3] = p + np.array([0, 0, -0.015])
    env.simulation.move_body(everyone, BOTTLE, pose)
    for _ in range(4):
        env.step(np.tile([0, 0, 0, 0, 0, 0, 0.0], (env.num_envs, 1)))


def test_tasks_are_in_the_order_of_appendix_e():
    assert [task.instruction for task in get_scene("kitchen_2x2").tasks] == [
        "put the ketchup bottle on the yellow plate",
        "put the ketchup bottle on the cloth",
        "put the kitchen shovel on the yellow plate",
        "put the kitchen shovel on the cloth",
    ]
    assert Task(BOTTLE, None).instruction == "put the ketchup bottle on the table"


def test_published_sizes_and_masses():
    model = make(1).simulation.model
    # Volume of the disc and of the slab by hand, times the published densities.
    assert model.body(PLATE).mass[0] == pytest.approx(np.pi * 0.055**2 * 0.006 * 1003)
    assert model.body("cloth").mass[0] == pytest.approx(0.110 * 0.110 * 0.0094 * 6975)
    arm = [0.480879, 0.430811, 0.234589, 0.220991, 0.084957, 0.110084]
    names = ["shoulder", "upper_arm", "upper_forearm", "lower_forearm", "wrist", "gripper"]
    assert [model.body(f"{name}_link").mass[0] for name in names] == pytest.approx(arm)


def test_same_seed_same_streams_at_one_and_two_threads():
    streams = []
    for threads in (1, 2):
        env = make(8, num_threads=threads)
        env.reset(seed=3)
        streams.append(roll(env, 30))
    np.testing.assert_array_equal(*streams)


def test_other_seed_other_streams():
    first, second = make(), make()
    a, _ = first.reset(seed=0)
    b, _ = second.reset(seed=1)
    assert not np.array_equal(a["environment_state"], b["environment_state"])


def test_a_loaded_state_continues_bit_for_bit():
    env, other = make(), make()
    env.reset(seed=0)
    env.set_task([1, 2], [env.scene.tasks[3], env.scene.tasks[1]])
    roll(env, 20)
    state = env.get_state()
    expected = roll(env, 20, seed=5)
    other.set_state(state)
    assert other.instructions == [env.scene.tasks[i].instruction for i in (0, 3, 1, 0)]
    np.testing.assert_array_equal(roll(other, 20, seed=5), expected)


def test_observations_share_no_memory():
    env = make(2, obs_type="pixels_agent_pos", privileged_state=True, observation_height=32, observation_width=32)
    before, _ = env.reset(seed=0)
    copies = {k: v.copy() for k, v in before.items() if k != "pixels"}
    pixels = before["pixels"]["front"].copy()
    env.step(np.tile([0.02, 0.02, 0.02, 0, 0, 0, 0], (2, 1)))
    for key, copy in copies.items():
        np.testing.assert_array_equal(before[key], copy)
    np.testing.assert_array_equal(before["pixels"]["front"], pixels)
    assert env.observation_space.contains(env.observe())


def test_end_effector_reset_moves_the_arm_and_no_object():
    env = make()
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.tile([0.0, 0.03, 0.03, 0, 0, 0.1, 0], (4, 1)))
    bodies, arm = env.simulation.body_poses().copy(), env.simulation.qpos[:, :6].copy()
    env.end_effector_reset(np.array([0, 2]))
    np.testing.assert_allclose(env.simulation.body_poses(), bodies, atol=1e-4)
    np.testing.assert_allclose(env.simulation.qpos[[0, 2], :6], np.tile(HOME_QPOS, (2, 1)), atol=2e-2)
    np.testing.assert_array_equal(env.simulation.qpos[[1, 3], :6], arm[[1, 3]])
    assert (env.simulation.gripper_opening()[[0, 2]] > 0.95).all()


def test_end_effector_reset_drops_a_held_object():
    env = make(2)
    env.reset(seed=0)
    hold_bottle(env)
    assert env.is_grasped.all()
    env.end_effector_reset(np.arange(2))
    assert not env.is_grasped.any()
    speed = np.abs(env.simulation.qvel[:, 8:14]).max()
    assert speed < 0.05
    # It lies on the table or on something that does.
    assert (env.simulation.body_pose(BOTTLE)[:, 2] < 0.05).all()


def test_no_stream_may_be_helped():
    env = CronosVectorEnv(2, obs_type="environment_state_agent_pos")
    env.scene_reset(np.arange(2), np.arange(2))
    before, nobody = env.simulation.qpos.copy(), np.flatnonzero([False, False])
    env.scene_reset(nobody, nobody)
    env.place_bodies(nobody, np.empty((0, 4, 7)))
    env.end_effector_reset(nobody)
    np.testing.assert_array_equal(env.simulation.qpos, before)


def test_scene_reset_restores_only_its_streams():
    env = make()
    start, _ = env.reset(seed=0)
    roll(env, 10)
    elsewhere = env.observe()["environment_state"]
    env.scene_reset(np.array([1]), np.array([1]))
    after = env.observe()
    np.testing.assert_allclose(after["environment_state"][1], start["environment_state"][1], atol=1e-5)
    np.testing.assert_array_equal(after["environment_state"][[0, 2, 3]], elsewhere[[0, 2, 3]])


def test_put_back_moves_one_body_into_the_spawn_area():
    env = make()
    env.reset(seed=0)
    far = np.array([[0.9, 0.0, -0.7, 1, 0, 0, 0]])
    env.simulation.move_body(np.array([2]), "cloth", far)
    before = env.simulation.body_poses().copy()
    env.put_back(2, "cloth", np.random.default_rng(0))
    after = env.simulation.body_poses()
    cloth = env.scene.bodies.index("cloth")
    moved = np.abs(after - before).max(axis=2) > 1e-6
    assert moved.sum() == 1
    assert moved[2, cloth]
    assert (after[2, cloth, :2] >= env.scene.spawn_low).all()
    assert (after[2, cloth, :2] <= env.scene.spawn_high).all()


@pytest.mark.parametrize("reward", ["difference", "level"])
def test_rewards_of_grasp_and_success(reward):
    """Levels 0 -> 0.1 (grasped) -> 1.0 (on the plate): paid each step, or as their differences."""
    env = make(1, reward=reward)
    env.reset(seed=0)
    hold_bottle(env)
    assert env.is_grasped.all()
    _, r_held, *_ = env.step(STILL[None] * [0, 0, 0, 0, 0, 0, 0])
    plate = env.simulation.body_pose(PLATE)[0].copy()
    on_plate = np.array([[*plate[:2], plate[2] + 0.0135, 1, 0, 0, 0]])
    env.simulation.move_body(np.array([0]), BOTTLE, on_plate)
    rewards = [env.step(STILL[None])[1][0] for _ in range(4)]
    assert env.is_success.all()
    if reward == "level":
        assert r_held[0] == pytest.approx(0.1)
        assert rewards[-1] == pytest.approx(1.0)
    else:
        assert r_held[0] == pytest.approx(0.0)
        assert sum(rewards) == pytest.approx(0.9)
        assert rewards[-1] == pytest.approx(0.0)


def test_a_new_task_pays_no_difference_for_what_was_already_there():
    env = make(1)
    env.reset(seed=0)
    hold_bottle(env)
    env.set_task([0], [Task("kitchen shovel", PLATE)])
    _, reward, *_ = env.step(np.zeros((1, 7)))
    assert reward[0] == 0.0
    env.set_task([0], [Task(BOTTLE, "cloth")])
    _, reward, *_ = env.step(np.zeros((1, 7)))
    assert reward[0] == pytest.approx(0.0)
    assert env.is_grasped.all()


def test_success_is_not_judged_from_a_sleeping_contact():
    """MuJoCo puts resting bodies to sleep; a bottle that lies on the plate for long stays a success."""
    env = make(1)
    env.reset(seed=0)
    plate = env.simulation.body_pose(PLATE)[0].copy()
    env.simulation.move_body(np.array([0]), BOTTLE, np.array([[*plate[:2], plate[2] + 0.0135, 1, 0, 0, 0]]))
    success = [env.step(STILL[None])[4]["is_success"][0] for _ in range(60)]
    assert all(success[5:])


def test_bad_actions_are_refused_and_large_ones_clipped():
    env, other = make(2), make(2)
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(2, 7\), got \(7,\)"):
        env.step(STILL)
    bad = np.tile(STILL, (2, 1))
    bad[1, 3] = np.nan
    with pytest.raises(ValueError, match=r"\[1\] are not finite"):
        env.step(bad)
    large, _, *_ = env.step(np.full((2, 7), 1e9))
    bound, _, *_ = other.step(np.tile(ACTION_HIGH, (2, 1)))
    np.testing.assert_array_equal(large["agent_pos"], bound["agent_pos"])


def test_a_diverged_simulation_is_reported_and_the_others_go_on():
    env, healthy = make(3), make(3)
    env.reset(seed=0)
    healthy.reset(seed=0)
    env.simulation.qvel[1] = 1e6
    observation, _, terminated, truncated, info = env.step(np.tile(STILL, (3, 1)))
    expected, *_ = healthy.step(np.tile(STILL, (3, 1)))
    assert info["diverged"].tolist() == [False, True, False]
    assert not terminated.any()
    assert not truncated.any()
    for key in observation:
        assert np.isfinite(observation[key]).all()
        np.testing.assert_array_equal(observation[key][[0, 2]], expected[key][[0, 2]])
    env.scene_reset(np.array([1]), np.array([1]))
    _, _, _, _, info = env.step(np.tile(STILL, (3, 1)))
    assert not info["diverged"].any()


def test_a_simulation_that_diverges_while_its_bodies_settle_is_put_back(monkeypatch):
    env, healthy = make(3), make(3)
    for each in (env, healthy):
        each.reset(seed=0)
    bodies = env.simulation.body_poses()[1].copy()
    advance = env.simulation._advance

    def break_one(ids, nstep):
        broken = advance(ids, nstep)
        if 1 in ids:
            env.simulation.qvel[1] = np.nan
        return broken

    monkeypatch.setattr(env.simulation, "_advance", break_one)
    for each in (env, healthy):
        each.end_effector_reset(np.arange(3))
    np.testing.assert_array_equal(env.simulation.body_poses()[1], bodies)
    np.testing.assert_array_equal(env.simulation.qvel[1], 0.0)
    np.testing.assert_array_equal(env.simulation.qpos[[0, 2]], healthy.simulation.qpos[[0, 2]])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"scene": "garage"}, "unknown scene 'garage'.*kitchen_2x2"),
        ({"reward": "dense"}, "unknown reward 'dense'.*difference.*level"),
        ({"obs_type": "pixels"}, "unknown obs_type 'pixels'.*pixels_agent_pos"),
        ({"num_threads": -3}, "num_threads must be at least 0 .*got -3"),
        ({"camera_name": "top"}, "unknown camera 'top'.*bridge.*front"),
        ({"observation_height": 0}, "must be at least 1, got 0, 128 and"),
        ({"render_size": (1, 2, 3)}, r"must be at least 1, got 128, 128 and \(1, 2, 3\)"),
    ],
)
def test_errors_name_the_bad_value_and_the_valid_ones(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(1, **kwargs)
    with pytest.raises(ValueError, match="unknown task"):
        make(1).set_task([0], [Task("banana", PLATE)])
    with pytest.raises(ValueError, match=r"seeds must be whole numbers, .*got \[1, None\]"):
        make(2).reset(seed=[1, None])


INTERVENTIONS = {
    "set_task": lambda env, ids: env.set_task(ids, [env.scene.tasks[1]] * len(ids)),
    "observe": lambda env, ids: env.observe(ids),
    "scene_reset": lambda env, ids: env.scene_reset(ids, np.zeros(len(ids), dtype=int)),
    "place_bodies": lambda env, ids: env.place_bodies(ids, env.simulation.body_poses()[: len(ids)].copy()),
    "end_effector_reset": lambda env, ids: env.end_effector_reset(ids),
    "step_streams": lambda env, ids: env.step_streams(np.tile(STILL, (3, 1)), ids),
}
ANY_ORDER = ("set_task", "observe")


@pytest.mark.parametrize("name", INTERVENTIONS)
def test_ids_that_are_none_are_refused_and_change_nothing(name):
    env = make(3)
    env.reset(seed=0)
    intervene, before, tasks = INTERVENTIONS[name], env.get_state(), list(env.tasks)
    bad = [np.array([True, False, True]), [0.0, 1.0], [-1, 0], [0, 3], [[0], [1]]]
    for ids in bad if name in ANY_ORDER else [*bad, [2, 1], np.array([1, 1])]:
        with pytest.raises(ValueError, match=r"ids must be integers in 0\.\.2.*np\.flatnonzero\(mask\)"):
            intervene(env, ids)
    assert env.tasks == tasks
    for key, value in env.get_state().items():
        np.testing.assert_array_equal(value, before[key])
    for ids in ([], np.array([], dtype=int), range(2), [0, 2], np.flatnonzero([True, False, True])):
        intervene(env, ids)


def test_a_body_is_put_back_in_a_stream_that_there_is():
    env = make(2)
    for stream in (2, -1, True):
        with pytest.raises(ValueError, match=r"ids must be integers in 0\.\.1"):
            env.put_back(stream, BOTTLE, np.random.default_rng(0))


def test_no_stream_gets_its_task_where_one_is_unknown():
    env = make(2)
    env.reset(seed=0)
    before = list(env.tasks)
    other = next(task for task in env.scene.tasks if task != before[0])
    with pytest.raises(ValueError, match=r"a Task, not its instruction, is needed; valid tasks: .*Task"):
        env.set_task([0, 1], [other, other.instruction])
    with pytest.raises(ValueError, match="shorter"):
        env.set_task([0, 1], [other])
    assert env.tasks == before


def test_environments_render_from_many_threads_at_once():
    """Mesa's software rasteriser crashes when two threads draw at once; LeRobot may evaluate in threads."""
    from concurrent.futures import ThreadPoolExecutor

    def frames(_: int) -> np.ndarray:
        env = make(2, obs_type="pixels_agent_pos", observation_height=32, observation_width=32)
        env.reset(seed=0)
        seen = [env.step(np.tile(STILL, (2, 1)))[0]["pixels"]["front"] for _ in range(5)]
        env.close()
        return np.stack(seen)

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(frames, range(8)))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])
