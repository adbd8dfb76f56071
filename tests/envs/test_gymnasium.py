"""What users of Gymnasium rely on: vectors, autoreset, Python's bools, copies, forks."""

import copy
import pickle
import sys

import gymnasium as gym
import numpy as np
import pytest
from forked_commands import run_forked
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from lerobot_env_cronos import CronosEnv, CronosVectorEnv, IndependentVectorEnv, SequentialVectorEnv, get_scene
from lerobot_env_cronos.autoreset import CronosGymVectorEnv
from lerobot_env_cronos.scene.physics import PHYSICS_V0

ID = "lerobot_env_cronos/kitchen_2x2-v1"
STATE = {"obs_type": "environment_state_agent_pos"}
TASKS = get_scene("kitchen_2x2").tasks
INSTRUCTIONS = [task.instruction for task in TASKS]


def actions(n, steps, seed=0):
    env = CronosVectorEnv(n, **STATE)
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(steps)]


def assert_equal(a, b):
    """Nested dicts of arrays, lists and numbers, equal to the last bit."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, tuple | list) or (isinstance(a, np.ndarray) and a.dtype == object):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    else:
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_make_vec_is_gymnasiums_own_vector_of_single_environments(mode):
    """The same seeds and actions, over the ends of episodes, one of them 30 steps early."""
    ours = gym.make_vec(ID, num_envs=2, autoreset_mode=mode, **STATE)
    assert type(ours.unwrapped) is CronosGymVectorEnv
    assert ours.metadata["autoreset_mode"] is mode
    singles = SyncVectorEnv([lambda: CronosEnv(**STATE)] * 2, autoreset_mode=mode)
    assert_equal(ours.reset(seed=3), singles.reset(seed=3))
    ours.unwrapped._elapsed[1] = singles.envs[1]._env._elapsed[0] = 30
    ends = []
    for step, action in enumerate(actions(2, 90), start=1):
        mine, theirs = ours.step(action), singles.step(action)
        ends += [(step, int(i)) for i in np.flatnonzero(mine[3])]
        for a, b in zip(mine[:4], theirs[:4], strict=True):
            assert_equal(a, b)
        info = {key: value for key, value in mine[4].items() if key in theirs[4]}
        for key in ("diverged", "_diverged"):
            # Nothing is said of it by Gymnasium's vector where the step was a reset.
            info.pop(key, None), theirs[4].pop(key, None)
        assert_equal(info, theirs[4])
    assert ends == [(50, 1), (80, 0)]


def test_next_step_starts_an_episode_with_the_step_after_the_end():
    env = gym.make_vec(ID, num_envs=2, task=TASKS[1].instruction, **STATE)
    env.reset(seed=0)
    env.unwrapped._elapsed[:] = [79, 0]
    still = np.zeros((2, 7), dtype=np.float32)
    last, *_, truncated, _ = env.step(still)
    assert truncated.tolist() == [True, False]
    first, reward, terminated, truncated, info = env.step(still)
    assert not terminated.any()
    assert not truncated.any()
    assert reward[0] == 0.0
    assert np.abs(first["environment_state"][0] - last["environment_state"][0]).max() > 0.01
    assert info["task"].tolist() == [TASKS[1].instruction] * 2
    assert env.unwrapped._elapsed.tolist() == [0, 2]


def test_episode_statistics_of_gymnasiums_wrapper():
    for mode, length in ((AutoresetMode.NEXT_STEP, 80), (AutoresetMode.SAME_STEP, 80)):
        env = RecordEpisodeStatistics(gym.make_vec(ID, num_envs=2, autoreset_mode=mode, **STATE))
        env.reset(seed=0)
        infos = [env.step(np.zeros((2, 7), dtype=np.float32))[4] for _ in range(162)]
        ended = [step for step, info in enumerate(infos, start=1) if "episode" in info]
        # With NEXT_STEP the 81st step is the reset's.
        assert ended == ([80, 161] if mode is AutoresetMode.NEXT_STEP else [80, 160])
        assert all(infos[step - 1]["episode"]["l"].tolist() == [length, length] for step in ended)


def test_without_autoreset_the_mask_says_who_starts_again():
    env = gym.make_vec(ID, num_envs=3, autoreset_mode="Disabled", **STATE)
    env.reset(seed=0, options={"configuration": 7})
    poses = env.unwrapped.benchmark.configurations["train"]
    np.testing.assert_allclose(env.unwrapped.simulation.body_poses(), np.stack([poses[7]] * 3), atol=1e-9)
    env.unwrapped._elapsed[:] = 79
    still = np.zeros((3, 7), dtype=np.float32)
    env.step(still)
    before = env.unwrapped.simulation.qpos.copy()
    assert env.unwrapped.done.all()
    env.reset(options={"reset_mask": np.array([False, True, False]), "configuration": 9})
    assert env.unwrapped.done.tolist() == [True, False, True]
    np.testing.assert_array_equal(env.unwrapped.simulation.qpos[[0, 2]], before[[0, 2]])
    np.testing.assert_allclose(env.unwrapped.simulation.body_poses()[1], poses[9], atol=1e-9)
    # Seeds as Gymnasium's other vector environments take them.
    seeds = [3, 1, 2]
    for given in (seeds, np.array(seeds), tuple(seeds)):
        assert (env.reset(seed=given)[0]["agent_pos"] == env.reset(seed=seeds)[0]["agent_pos"]).all()
    with pytest.raises(ValueError, match=r"reset_mask must be \(3,\) bool with a True in it"):
        env.reset(options={"reset_mask": np.zeros(3, dtype=bool)})
    with pytest.raises(
        ValueError, match=r"unknown autoreset_mode 'later'; valid values: \['NextStep', 'SameStep', 'D"
    ):
        gym.make_vec(ID, num_envs=1, autoreset_mode="later", **STATE)


def test_a_vector_draws_only_if_it_is_told_to():
    silent, drawing = (gym.make_vec(ID, num_envs=2, render_mode=mode, **STATE) for mode in (None, "rgb_array"))
    assert (silent.render_mode, silent.render()) == (None, None)
    assert drawing.render_mode == "rgb_array"
    assert [frame.shape for frame in drawing.render()] == [(480, 640, 3)] * 2
    silent.close()
    drawing.close()


def test_a_single_environment_speaks_python_and_stays_over():
    env = gym.make(ID, **STATE)
    _, info = env.reset(seed=0)
    assert (type(info["is_success"]), type(info["is_grasped"])) == (bool, bool)
    env.unwrapped._env._elapsed[:] = 79
    last, _, terminated, truncated, info = env.step(np.zeros(7, dtype=np.float32))
    assert {name: type(info[name]) for name in ("is_success", "is_grasped", "diverged")} == dict.fromkeys(
        ("is_success", "is_grasped", "diverged"), bool
    )
    assert (terminated, truncated) == (False, True)
    for _ in range(2):
        again, reward, terminated, truncated, info = env.step(np.ones(7, dtype=np.float32))
        assert (reward, terminated, truncated, info["is_success"]) == (0.0, False, True, False)
        assert_equal(again, last)
    env.reset()
    assert env.step(np.zeros(7, dtype=np.float32))[2:4] == (False, False)


def test_options_of_a_reset_are_followed_or_refused():
    valid = r"\['configuration', 'lerobot_new_rollout'\]"
    with pytest.raises(ValueError, match=rf"unknown options \['config'\] of reset; valid options: {valid}"):
        gym.make(ID, **STATE).reset(options={"config": 3})
    with pytest.raises(ValueError, match=r"configuration must be in 0\.\.63, got 'three'"):
        gym.make(ID, **STATE).reset(options={"configuration": "three"})
    makers = [
        lambda: CronosVectorEnv(1, **STATE),
        lambda: IndependentVectorEnv(1, task=TASKS[0], **STATE),
        lambda: SequentialVectorEnv(1, ordering=TASKS, **STATE),
    ]
    for make in makers:
        make().reset(seed=0, options={"lerobot_new_rollout": True})
        with pytest.raises(ValueError, match=r"unknown options \['configuration'\].*\['lerobot_new_rollout'\]"):
            make().reset(seed=0, options={"configuration": 3})


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("make", [
    lambda: CronosVectorEnv(2, **STATE),
    lambda: SequentialVectorEnv(2, ordering=TASKS[::-1], advance="on_success", **STATE),
    lambda: gym.make_vec(ID, num_envs=2, **STATE),
    lambda: CronosVectorEnv(2, observation_height=32, observation_width=32),
])  # fmt: skip
def test_a_copy_goes_on_bit_for_bit(make, duplicate):
    env = make()
    env.reset(seed=5)
    tape = actions(2, 30)
    for action in tape[:10]:
        env.step(action)
    other = duplicate(env)
    for action in tape[10:]:
        assert_equal(list(env.step(action)), list(other.step(action)))
    # Random starts, too.
    assert_equal(env.reset(), other.reset())
    env.close()
    other.close()


@pytest.mark.parametrize("make", [
    lambda: IndependentVectorEnv(2, task=TASKS[0], **STATE),
    lambda: SequentialVectorEnv(2, ordering=TASKS[::-1], window=5, end_effector_reset=True, **STATE),
    lambda: gym.make_vec(ID, num_envs=2, **STATE),
    lambda: gym.make_vec(ID, num_envs=2, autoreset_mode=AutoresetMode.DISABLED, **STATE),
])  # fmt: skip
def test_a_state_is_gone_back_to_from_beyond_the_end_of_the_episode(make):
    env = make().unwrapped
    env.reset(seed=5)
    tape = actions(2, 100)
    for action in tape[:3]:
        env.step(action)
    state = env.get_state()
    first = [list(env.step(action)) for action in tape[3:]]
    assert any(truncated.any() for _, _, _, truncated, _ in first)
    env.set_state(state)
    for action, expected in zip(tape[3:], first, strict=True):
        assert_equal(expected, list(env.step(action)))
    env.close()


def test_a_copy_has_the_physics_of_what_was_copied():
    class Slower(CronosVectorEnv):
        physics = PHYSICS_V0

    env = Slower(1, **STATE)
    assert copy.deepcopy(env).simulation.model.opt.timestep == env.simulation.model.opt.timestep == 0.005


def test_lerobots_rollout_can_run_what_gymnasium_makes():
    single = SyncVectorEnv([lambda: gym.make(ID, disable_env_checker=True, **STATE)])
    for env in (single, gym.make_vec(ID, num_envs=1, **STATE)):
        env.reset(seed=[0], options={"lerobot_new_rollout": True})
        assert env.call("_max_episode_steps") == (80,)
        assert env.call("task_description")[0] in INSTRUCTIONS
    assert single.call("task")[0] in INSTRUCTIONS


def test_a_single_environment_can_be_copied():
    env = gym.make(ID, **STATE)
    env.reset(seed=5)
    env.step(np.zeros(7, dtype=np.float32))
    other = pickle.loads(pickle.dumps(env))
    assert_equal(list(env.step(np.ones(7, dtype=np.float32))), list(other.step(np.ones(7, dtype=np.float32))))
    assert_equal(env.reset(), other.reset())


FORK = """
import warnings; warnings.simplefilter("ignore")
import gymnasium as gym, lerobot_env_cronos
from functools import partial
small = {"observation_height": 32, "observation_width": 32}
make = partial(gym.make, "lerobot_env_cronos/kitchen_2x2-v1", disable_env_checker=True, **small)
def vector():
    return gym.vector.AsyncVectorEnv([make], context="fork")
early = vector()
assert early.reset(seed=0)[0]["pixels"]["front"].shape == (1, 32, 32, 3)
early.close()
make().reset(seed=0)
try:
    vector().reset(seed=0)
except RuntimeError as error:
    print(error)
"""


def test_a_fork_after_the_first_frame_is_told_at_once():
    """Mesa's drawing threads are gone in the child, which would wait for them for ever."""
    done = run_forked([sys.executable, "-c", FORK])
    assert "forked from one that had drawn" in done.stdout, done.stderr[-2000:]
    assert "context='spawn'" in done.stdout
