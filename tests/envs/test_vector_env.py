"""The native vector env: interventions, rewards, determinism, refusal of bad actions."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from env_rollouts import STILL, keep_still, make
from lerobot_env_cronos import CronosVectorEnv, Task
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from lerobot_env_cronos.scene.arms.widowx.geometry import HOME_QPOS
from lerobot_env_cronos.simulation import rendering

BOTTLE, PLATE = "ketchup bottle", "yellow plate"


def random_actions(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(WIDOWX.action_low, WIDOWX.action_high, (n, 7))


def roll(env: CronosVectorEnv, steps: int, seed: int = 0) -> np.ndarray:
    rng, states = np.random.default_rng(seed), []
    for _ in range(steps):
        observation, *_ = env.step(random_actions(rng, env.num_envs))
        states.append(np.concatenate([observation["environment_state"], observation["agent_pos"]], axis=1))
    return np.stack(states)


def hold_bottle(env: CronosVectorEnv) -> None:
    """Put the bottle between the fingers of a raised hand and close them."""
    p, _ = env.simulation.end_effector()
    pose = np.tile([0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (env.num_envs, 1))
    pose[:, :3] = p + np.array([0, 0, -0.015])
    env.simulation.move_body(np.arange(env.num_envs), BOTTLE, pose)
    for _ in range(4):
        env.step(np.zeros((env.num_envs, 7)))


def put_on_plate(env: CronosVectorEnv) -> None:
    plate = env.simulation.body_pose(PLATE)[0]
    on_plate = np.array([[*plate[:2], plate[2] + 0.0135, 1, 0, 0, 0]])
    env.simulation.move_body(np.array([0]), BOTTLE, on_plate)


# Determinism ---------------------------------------------------------------------------------------------


def test_same_seed_same_streams_at_one_and_two_threads():
    streams = []
    for threads in (1, 2):
        env = make(8, num_threads=threads)
        env.reset(seed=3)
        streams.append(roll(env, 30))
    np.testing.assert_array_equal(*streams)


def test_observations_share_no_memory():
    env = make(2, obs_type="pixels_agent_pos", privileged_state=True, observation_height=32, observation_width=32)
    before, _ = env.reset(seed=0)
    pixels = before["pixels"]["front"]
    arrays = [before["agent_pos"], before["environment_state"], pixels]
    copies = [array.copy() for array in arrays]
    env.step(np.tile([0.02, 0.02, 0.02, 0, 0, 0, 0], (2, 1)))
    for array, copy in zip(arrays, copies, strict=True):
        np.testing.assert_array_equal(array, copy)
    assert env.observation_space.contains(env.observe())


# Actions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_executed_action_is_clipped_and_does_the_same_again(dtype):
    env, other = make(4), make(4)
    for each in (env, other):
        each.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        actions = (3 * random_actions(rng, 4)).astype(np.float32).astype(dtype)
        seen, *_, info = env.step(actions)
        executed = info["executed_action"]
        assert executed.dtype == np.float32
        assert env.action_space.contains(executed)
        np.testing.assert_allclose(executed, np.clip(actions, WIDOWX.action_low, WIDOWX.action_high), atol=2e-8)
        again, *_, replayed = other.step(executed)
        np.testing.assert_array_equal(again["environment_state"], seen["environment_state"])
        np.testing.assert_array_equal(replayed["executed_action"], executed)


def test_bad_actions_are_refused():
    env = make(2)
    with pytest.raises(ValueError, match=r"shape \(2, 7\)"):
        env.step(STILL)
    bad = np.tile(STILL, (2, 1))
    bad[1, 3] = np.nan
    with pytest.raises(ValueError, match=r"\[1\]"):
        env.step(bad)


def test_a_diverged_simulation_is_reported_and_the_others_go_on():
    env, healthy = make(3), make(3)
    env.reset(seed=0)
    healthy.reset(seed=0)
    env.simulation.qvel[1] = 1e6
    observation, _, terminated, truncated, info = env.step(np.tile(STILL, (3, 1)))
    expected, *_ = healthy.step(np.tile(STILL, (3, 1)))
    assert info["diverged"].tolist() == [False, True, False]
    assert not (terminated | truncated).any()
    for key in observation:
        assert np.isfinite(observation[key]).all()
        np.testing.assert_array_equal(observation[key][[0, 2]], expected[key][[0, 2]])
    env.scene_reset(np.array([1]), np.array([1]))
    assert not env.step(np.tile(STILL, (3, 1)))[4]["diverged"].any()


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


# Interventions -------------------------------------------------------------------------------------------


def test_end_effector_reset_moves_the_arm_and_no_object():
    env = make(4)
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
    assert np.abs(env.simulation.qvel[:, 8:14]).max() < 0.05
    # It lies on the table or on something that does.
    assert (env.simulation.body_pose(BOTTLE)[:, 2] < 0.05).all()


def test_scene_reset_restores_only_its_streams():
    env = make(4)
    start, _ = env.reset(seed=0)
    roll(env, 10)
    elsewhere = env.observe()["environment_state"]
    env.scene_reset(np.array([1]), np.array([1]))
    after = env.observe()["environment_state"]
    np.testing.assert_allclose(after[1], start["environment_state"][1], atol=1e-5)
    np.testing.assert_array_equal(after[[0, 2, 3]], elsewhere[[0, 2, 3]])


INTERVENTIONS = {
    "set_task": lambda env, ids: env.set_task(ids, [env.scene.tasks[1]] * len(ids)),
    "observe": lambda env, ids: env.observe(ids),
    "scene_reset": lambda env, ids: env.scene_reset(ids, np.zeros(len(ids), dtype=int)),
    "end_effector_reset": lambda env, ids: env.end_effector_reset(ids),
    "step_streams": lambda env, ids: env.step_streams(np.tile(STILL, (3, 1)), ids),
}


@pytest.mark.parametrize("name", INTERVENTIONS)
def test_ids_that_are_none_are_refused_and_change_nothing(name):
    """A mask would count as streams 0 and 1."""
    env = make(3)
    env.reset(seed=0)
    intervene, before = INTERVENTIONS[name], env.get_state()
    for ids in (np.array([True, False, True]), [0.0, 1.0], [-1, 0], [0, 3], [[0], [1]]):
        with pytest.raises(ValueError, match="flatnonzero"):
            intervene(env, ids)
    for key, value in env.get_state().items():
        np.testing.assert_array_equal(value, before[key])
    for ids in ([], np.array([], dtype=int), range(2), [0, 2]):
        intervene(env, ids)


def test_no_stream_gets_its_task_where_one_is_unknown():
    env = make(2)
    before = list(env.current_tasks)
    other = next(task for task in env.scene.tasks if task != before[0])
    for tasks in ([other, other.instruction], [other]):
        with pytest.raises(ValueError):  # noqa: PT011
            env.set_task([0, 1], tasks)
    assert env.current_tasks == before


# Rewards -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward", ["difference", "level"])
def test_rewards_of_grasp_and_success(reward):
    """Levels 0 -> 0.1 (grasped) -> 1.0 (on the plate): paid each step, or as their differences."""
    env = make(1, reward=reward)
    env.reset(seed=0)
    hold_bottle(env)
    _, held, *_ = env.step(np.zeros((1, 7)))
    put_on_plate(env)
    rewards = [env.step(STILL[None])[1][0] for _ in range(4)]
    assert env.is_success.all()
    if reward == "level":
        assert held[0] == pytest.approx(0.1)
        assert rewards[-1] == pytest.approx(1.0)
    else:
        assert held[0] == rewards[-1] == 0.0
        assert sum(rewards) == pytest.approx(0.9)


def test_a_new_task_pays_no_difference_for_what_was_already_there():
    env = make(1)
    env.reset(seed=0)
    hold_bottle(env)
    for task in (Task("kitchen shovel", PLATE), Task(BOTTLE, "cloth")):
        env.set_task([0], [task])
        assert env.step(np.zeros((1, 7)))[1][0] == pytest.approx(0.0)
    assert env.is_grasped.all()


def test_success_is_not_judged_from_a_sleeping_contact():
    """MuJoCo puts resting bodies to sleep; a bottle that lies on the plate for long stays a success."""
    env = make(1)
    env.reset(seed=0)
    put_on_plate(env)
    assert keep_still(env, 60)[5:].all()


# Pictures ------------------------------------------------------------------------------------------------


def test_environments_render_from_many_threads_at_once():
    """Mesa's software rasteriser crashes when two threads draw at once; LeRobot may evaluate in threads."""

    def frames(_: int) -> np.ndarray:
        env = make(2, obs_type="pixels_agent_pos", observation_height=32, observation_width=32)
        env.reset(seed=0)
        seen = [env.step(np.tile(STILL, (2, 1)))[0]["pixels"]["front"] for _ in range(3)]
        env.close()
        return np.stack(seen)

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(frames, range(4))
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_where_nothing_can_be_drawn_the_cause_is_told(monkeypatch):
    def fail(*_):
        raise RuntimeError("MUJOCO_EGL_DEVICE_ID must be between 0 and 0, got 7")

    monkeypatch.setattr(rendering, "Canvas", fail)
    with pytest.raises(RuntimeError, match="MUJOCO_EGL_DEVICE_ID must be between 0 and 0, got 7"):
        make(1, obs_type="pixels_agent_pos").observe()


@pytest.mark.parametrize(
    "wrong", [{"reward": "dense"}, {"num_threads": -3}, {"observation_height": 0}, {"render_size": (1, 2, 3)}]
)
def test_errors_name_the_argument(wrong):
    """Those that the config leaves to the environment."""
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        make(1, **wrong)
