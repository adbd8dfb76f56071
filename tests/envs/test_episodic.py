"""Evaluation episodes, Gymnasium's checker, and LeRobot's plugin interface."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import SCENES, CronosEnvConfig, IndependentVectorEnv, get_scene, gymnasium_id
from lerobot_env_cronos.benchmark.configurations import load_configurations

STATE = "environment_state_agent_pos"
TASK = get_scene("kitchen_2x2").tasks[0]


@pytest.mark.parametrize("obs_type", ["pixels_agent_pos", STATE])
@pytest.mark.parametrize("scene", SCENES)
def test_gymnasium_checker_has_no_complaint(scene, obs_type):
    env = gym.make(gymnasium_id(scene), obs_type=obs_type, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions are in metres and radians, on purpose.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(env.unwrapped)
    env.close()


def test_configuration_follows_the_seed_whatever_the_batch_size():
    expected = load_configurations("kitchen_2x2", "held_out")
    for n, seeds in ((4, [1000, 1001, 1002, 1003]), (2, [1002, 1003])):
        env = IndependentVectorEnv(n, task=TASK, split="held_out", obs_type=STATE)
        env.reset(seed=seeds)
        for i, seed in enumerate(seeds):
            np.testing.assert_allclose(env.simulation.body_poses()[i], expected[seed % 64], atol=1e-9)


def test_finished_episodes_freeze_and_pay_nothing(monkeypatch):
    env = IndependentVectorEnv(2, task=TASK, obs_type=STATE)
    env.reset(seed=0)
    # What counts as placed has tests of its own.
    monkeypatch.setattr(env.simulation, "is_on", lambda obj, receptacle: np.array([True, False]))
    action = np.tile([0, 0, 0.01, 0, 0, 0, 1.0], (2, 1))
    _, _, terminated, truncated, info = env.step(action)
    assert terminated.tolist() == info["is_success"].tolist() == [True, False]
    assert not truncated.any()
    frozen = env.simulation.qpos[0].copy()
    for step in range(2, 81):
        _, reward, terminated, truncated, info = env.step(action)
        assert reward[0] == 0.0
        assert not terminated.any()
        assert not info["is_success"].any()
        assert truncated.tolist() == [False, step == 80]
    np.testing.assert_array_equal(env.simulation.qpos[0], frozen)


def test_lerobot_finds_the_plugin_and_builds_every_task():
    register_third_party_plugins()
    assert "cronos" in EnvConfig.get_known_choices()
    cfg = make_env_config("cronos", split="held_out", observation_height=64, observation_width=64)
    envs = make_env(cfg, n_envs=2)["independent_held_out"]
    assert sorted(envs) == [0, 1, 2, 3]
    env = envs[2]
    observation, _ = env.reset(seed=[0, 1], options={"lerobot_new_rollout": True})
    assert observation["pixels"]["front"].shape == (2, 64, 64, 3)
    assert env.call("task_description") == ("put the kitchen shovel on the yellow plate",) * 2
    assert env.call("_max_episode_steps") == (80, 80)
    frames = env.call("render")
    assert len(frames) == 2
    assert np.stack(frames[:1]).shape == (1, 480, 640, 3)
    assert env.metadata["render_fps"] == cfg.fps == 5
    for env in envs.values():
        env.close()


def test_policy_features_match_what_the_env_observes():
    cfg = CronosEnvConfig(privileged_state=True)
    features = env_to_policy_features(cfg)
    env = next(iter(cfg.create_envs(1)["independent_train"].values()))
    observation, _ = env.reset(seed=[0])
    assert features["observation.images.front"].shape == (3, 128, 128)
    assert features["observation.state"].shape == observation["agent_pos"].shape[1:]
    assert features["observation.environment_state"].shape == observation["environment_state"].shape[1:]
    env.close()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("suite", "chains"),
        ("split", "test"),
        ("scene", "x"),
        ("task", "tidy up"),
        ("fps", 30),
        ("num_threads", -3),
        ("observation_height", -1),
        ("camera_name", "sideways"),
        ("render_size", (0, 640)),
        ("render_size", (480, -640)),
        ("render_size", (480,)),
        ("render_size", (480, 640, 3)),
    ],
)
def test_config_errors_name_the_bad_value(field, value, caplog):
    with pytest.raises(ValueError, match=re.escape(str(value))):
        CronosEnvConfig(**{field: value})
    # draccus hides the exception's text from command lines, so it is logged as well.
    assert str(value) in caplog.text


@pytest.mark.parametrize("configurations", [[], [64], [-1], [1.7], [True, False], 3])
def test_configurations_that_are_none_are_named(configurations):
    """A mask would be taken for indices 1 and 0."""
    with pytest.raises(ValueError, match=re.escape(f"one or more of 0..63, got {configurations!r}")):
        IndependentVectorEnv(1, task=TASK, obs_type=STATE, configurations=configurations)


@pytest.mark.parametrize("obs_type", ["pixels_agent_pos", STATE])
def test_every_camera_is_looked_up_when_the_config_is_made(obs_type):
    """Videos are drawn from the first one, whatever the policy sees."""
    CronosEnvConfig(camera_name="bridge, front", obs_type=obs_type)
    with pytest.raises(ValueError, match=r"unknown env.camera_name 'side'; valid values: \['front', 'bridge'\]"):
        CronosEnvConfig(camera_name="front,side", obs_type=obs_type)


@pytest.mark.parametrize("chained", [{"advance": "on_success"}, {"end_effector_reset": True}])
def test_a_warning_says_that_single_tasks_follow_no_flags_of_chains(chained, caplog):
    CronosEnvConfig(suite="sequential", **chained).create_envs(1)
    CronosEnvConfig().create_envs(1)
    assert not caplog.records
    CronosEnvConfig(**chained).create_envs(1)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "are of chains, --env.suite=sequential: --env.suite=independent does not" in caplog.text


def test_a_diverged_step_is_no_success_whatever_it_shows(monkeypatch):
    env = IndependentVectorEnv(2, task=TASK, obs_type=STATE)
    env.reset(seed=0)

    def break_the_first(actions, ids):
        env.is_success[:] = True
        return np.zeros(2), np.array([True, False])

    monkeypatch.setattr(env, "step_streams", break_the_first)
    _, _, terminated, truncated, info = env.step(np.zeros((2, 7)))
    assert terminated.tolist() == info["is_success"].tolist() == [False, True]
    assert truncated.tolist() == [True, False]
    env.close()
