"""What users of Gymnasium rely on: seeds, limits, vectors, autoreset, copies, forks, imports."""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from forked_commands import run_forked
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from lerobot_env_cronos import (
    CronosEnv,
    CronosGymVectorEnv,
    CronosVectorEnv,
    IndependentVectorEnv,
    SequentialVectorEnv,
    check_environment_id,
    get_scene,
)

ID = "lerobot_env_cronos/kitchen_2x2-v1"
STATE = {"obs_type": "environment_state_agent_pos"}
TASKS = get_scene("kitchen_2x2").tasks
STILL = np.zeros(7, dtype=np.float32)


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
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    else:
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("options", [{}, STATE, {"flat_observation": True}])
def test_gymnasium_checker_has_no_complaint(options):
    env = gym.make(ID, render_mode="rgb_array", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions are in metres and radians, on purpose.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(env.unwrapped)
    env.close()


IMPORTS = """
import sys
for name in ("lerobot", "torch", "transformers", "pyarrow", "huggingface_hub"):
    sys.modules[name] = None  # an import of it fails
import gymnasium as gym, lerobot_env_cronos
assert "mujoco" not in sys.modules
state = {"obs_type": "environment_state_agent_pos"}
gym.make("lerobot_env_cronos/kitchen_2x2-v1", **state).reset(seed=0)
gym.make_vec("lerobot_env_cronos/kitchen_2x2-v1", num_envs=2, **state).reset(seed=0)
"""


def test_gymnasium_needs_neither_lerobot_nor_torch():
    subprocess.run([sys.executable, "-c", IMPORTS], check=True)


# Episodes ------------------------------------------------------------------------------------------------


def test_the_limit_of_steps_is_what_make_is_told():
    assert gym.spec(ID).max_episode_steps == 80
    for limit in (3, 100):
        given = {"max_episode_steps": limit}
        env = gym.make(ID, **STATE, **given)
        vector = gym.make_vec(ID, num_envs=1, autoreset_mode="Disabled", **STATE, **given)
        env.reset(seed=0)
        vector.reset(seed=0)
        single = [env.step(STILL)[3] for _ in range(limit)]
        many = [vector.step(STILL[None])[3][0] for _ in range(limit)]
        assert single == many == [False] * (limit - 1) + [True]


@pytest.mark.parametrize("seed", [np.int64(3), [3], np.array([3])])
def test_any_seed_decides_what_later_resets_draw(seed):
    for make in (lambda: CronosVectorEnv(1, **STATE), lambda: gym.make_vec(ID, num_envs=1, **STATE)):
        starts = []
        for _ in range(2):
            env = make()
            env.reset(seed=seed)
            starts.append([env.reset()[0]["environment_state"] for _ in range(3)])
        assert_equal(*starts)
    single = gym.make(ID, **STATE)
    assert_equal(single.reset(seed=np.int64(3)), single.reset(seed=3))


def test_the_task_is_a_number_and_its_text_an_attribute():
    env = gym.make(ID, task=TASKS[2].instruction, **STATE)
    _, info = env.reset(seed=0)
    assert info["task"] == 2
    assert env.unwrapped.task_description == TASKS[2].instruction
    vector = gym.make_vec(ID, num_envs=3, **STATE)
    _, info = vector.reset(seed=0)
    assert info["task"].dtype.kind == "i"
    assert [TASKS[i].instruction for i in info["task"]] == vector.unwrapped.instructions
    assert all(value.dtype.kind in "bif" for value in vector.step(actions(3, 1)[0])[4].values())


def test_a_flat_observation_has_the_same_images_beside_the_state():
    nested, flat = (
        CronosVectorEnv(1, camera_name="front,bridge", flat_observation=flat) for flat in (False, True)
    )
    spaces = flat.single_observation_space
    assert set(spaces) == {"agent_pos", "pixels_front", "pixels_bridge"}
    assert all(isinstance(space, gym.spaces.Box) for space in spaces.values())
    pixels, observation = nested.reset(seed=0)[0]["pixels"], flat.reset(seed=0)[0]
    assert flat.observation_space.contains(observation)
    for camera, image in pixels.items():
        np.testing.assert_array_equal(observation[f"pixels_{camera}"], image)


def test_a_single_environment_speaks_python_and_stays_over(monkeypatch):
    env = CronosEnv(task=TASKS[0].instruction, **STATE)
    _, info = env.reset(seed=0)
    assert {type(info[name]) for name in ("is_success", "is_grasped")} == {bool}
    with monkeypatch.context() as patched:
        patched.setattr(env._env.simulation, "is_on", lambda obj, receptacle: np.array([True]))
        last, reward, terminated, truncated, _ = env.step(STILL)
    assert (reward, terminated, truncated) == (1.0, True, False)
    again, reward, terminated, truncated, info = env.step(STILL + 1)
    assert (reward, terminated, truncated, info["is_success"]) == (0.0, True, False, False)
    assert_equal(again, last)
    env.reset()
    assert env.step(STILL)[2:4] == (False, False)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: gym.make(ID, **STATE).unwrapped.step(np.zeros(6)), r"\(7,\), got \(6,\)"),
        (lambda: gym.make(ID, **STATE).reset(options={"config": 3}), "config"),
        (lambda: gym.make(ID, **STATE).reset(options={"configuration": 64}), "64"),
        (lambda: CronosVectorEnv(1, **STATE).reset(options=["configuration"]), "options"),
        (lambda: CronosVectorEnv(2.0, **STATE), "num_envs"),
        (lambda: CronosVectorEnv(1, render_size=64, **STATE), "render_size"),
        (lambda: gym.make_vec(ID, num_envs=1, max_episode_steps=0, **STATE), "max_episode_steps"),
        (lambda: gym.make_vec(ID, num_envs=1, autoreset_mode="later", **STATE), "autoreset_mode"),
        (lambda: IndependentVectorEnv(1, task=TASKS[0], configurations=[64], **STATE), "configurations"),
        (lambda: IndependentVectorEnv(1, task=TASKS[0], configurations=[True, False], **STATE), "configurations"),
    ],
)
def test_what_is_wrong_is_named(make, named):
    with pytest.raises(ValueError, match=named):
        make()


# Vectors -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_make_vec_is_gymnasiums_own_vector_of_single_environments(mode):
    """The same seeds and actions, over the ends of episodes at different times."""
    ours = gym.make_vec(ID, num_envs=2, autoreset_mode=mode, **STATE)
    assert type(ours.unwrapped) is CronosGymVectorEnv
    assert ours.metadata["autoreset_mode"] is mode
    singles = SyncVectorEnv([lambda: TimeLimit(CronosEnv(**STATE), 80)] * 2, autoreset_mode=mode)
    assert_equal(ours.reset(seed=3), singles.reset(seed=3))
    for i, elapsed in enumerate((60, 70)):
        ours.unwrapped._elapsed[i] = singles.envs[i]._elapsed_steps = elapsed
    ends = []
    for step, action in enumerate(actions(2, 25), start=1):
        mine, theirs = ours.step(action), singles.step(action)
        ends += [(step, int(i)) for i in np.flatnonzero(mine[3])]
        for a, b in zip(mine[:4], theirs[:4], strict=True):
            assert_equal(a, b)
        info = {key: value for key, value in mine[4].items() if key in theirs[4]}
        for key in ("diverged", "_diverged"):
            # Nothing is said of it by Gymnasium's vector where the step was a reset.
            info.pop(key, None), theirs[4].pop(key, None)
        assert_equal(info, theirs[4])
    assert ends == [(10, 1), (20, 0)]


def test_without_autoreset_the_mask_says_who_starts_again():
    env = gym.make_vec(ID, num_envs=3, autoreset_mode="Disabled", **STATE)
    env.reset(seed=0, options={"configuration": 7})
    poses = env.unwrapped.benchmark.configurations["train"]
    np.testing.assert_allclose(env.unwrapped.simulation.body_poses(), np.stack([poses[7]] * 3), atol=1e-9)
    env.unwrapped._elapsed[:] = 79
    env.step(np.tile(STILL, (3, 1)))
    before = env.unwrapped.simulation.qpos.copy()
    env.reset(options={"reset_mask": np.array([False, True, False]), "configuration": 9})
    assert env.unwrapped.done.tolist() == [True, False, True]
    np.testing.assert_array_equal(env.unwrapped.simulation.qpos[[0, 2]], before[[0, 2]])
    np.testing.assert_allclose(env.unwrapped.simulation.body_poses()[1], poses[9], atol=1e-9)
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(3, dtype=bool)})


def test_a_vector_draws_only_if_it_is_told_to():
    silent, drawing = (gym.make_vec(ID, num_envs=2, render_mode=mode, **STATE) for mode in (None, "rgb_array"))
    assert silent.render() is None
    assert [frame.shape for frame in drawing.render()] == [(480, 640, 3)] * 2
    drawing.close()


# Copies and states ---------------------------------------------------------------------------------------

MAKERS = [
    lambda: CronosVectorEnv(2, **STATE),
    lambda: SequentialVectorEnv(2, ordering=TASKS[::-1], window=5, end_effector_reset=True, **STATE),
    lambda: IndependentVectorEnv(2, task=TASKS[0], max_episode_steps=9, **STATE),
    lambda: gym.make_vec(ID, num_envs=2, max_episode_steps=9, **STATE).unwrapped,
]


@pytest.mark.parametrize(
    "make", [*MAKERS, lambda: CronosVectorEnv(2, observation_height=32, observation_width=32)]
)
def test_a_copy_goes_on_bit_for_bit(make):
    env = make()
    env.reset(seed=5)
    tape = actions(2, 12)
    for action in tape[:6]:
        env.step(action)
    other = copy.deepcopy(pickle.loads(pickle.dumps(env)))
    for action in tape[6:]:
        assert_equal(list(env.step(action)), list(other.step(action)))
    # Random starts, too.
    assert_equal(env.reset(), other.reset())


@pytest.mark.parametrize("make", MAKERS)
def test_a_state_is_gone_back_to_from_beyond_the_end_of_the_episode(make):
    env = make()
    env.reset(seed=5)
    tape = actions(2, 15)
    for action in tape[:3]:
        env.step(action)
    state = env.get_state()
    first = [list(env.step(action)) for action in tape[3:]]
    env.set_state(state)
    for action, expected in zip(tape[3:], first, strict=True):
        assert_equal(expected, list(env.step(action)))


@pytest.mark.parametrize("make", MAKERS)
def test_a_state_of_something_else_is_refused_and_changes_nothing(make):
    env = make()
    env.reset(seed=5)
    env.step(actions(2, 1)[0])
    state = env.get_state()
    short = {name: array for name, array in state.items() if name != "is_grasped"}
    shapes = state | {"qvel": state["qvel"][:, 1:]}
    # Of as many bodies, in arrays of the same shapes.
    playroom = CronosVectorEnv(2, "playroom_2x2", **STATE).get_state()
    for other in (state | playroom, shapes, short, CronosVectorEnv(3, **STATE).get_state(), {}):
        with pytest.raises(ValueError, match="state"):
            env.set_state(other)
        assert_equal(env.get_state(), state)


# Versions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["lerobot_env_cronos/kitchen_2x2-v0", "kitchen_2x2", "PushT-v1", None, ""])
def test_only_this_version_is_accepted(text):
    assert check_environment_id(ID, "run outputs/train") == "kitchen_2x2"
    with pytest.raises(ValueError, match=r"^dataset me/streams .*record it anew"):
        check_environment_id(text, "dataset me/streams", "record it anew")


# Processes -----------------------------------------------------------------------------------------------


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
    assert "context='spawn'" in done.stdout, done.stderr[-2000:]
