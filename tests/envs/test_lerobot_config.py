"""LeRobot's plugin interface: configs, features, environments by suite and split."""

import numpy as np
import pytest
from env_rollouts import STATE
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils import import_utils
from lerobot_env_cronos import CronosEnvConfig, IndependentVectorEnv, get_scene
from lerobot_env_cronos.benchmark.configurations import load_configurations

TASK = get_scene("kitchen_2x2").tasks[0]


def test_lerobot_finds_the_plugin_and_builds_every_task():
    import_utils.register_third_party_plugins()
    # The package was imported before LeRobot, by conftest.py; processes for commands import LeRobot first.
    assert {"cronos", "cronos_hub"} <= EnvConfig.get_known_choices().keys()
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
    env.close()


def test_policy_features_match_what_the_env_observes():
    cfg = CronosEnvConfig(privileged_state=True, camera_name="front, bridge")
    features = env_to_policy_features(cfg)
    env = next(iter(cfg.create_envs(1)["independent_train"].values()))
    observation, _ = env.reset(seed=[0])
    for camera in ("front", "bridge"):
        assert features[f"observation.images.{camera}"].shape == (3, 64, 64)
        assert observation["pixels"][camera].shape == (1, 64, 64, 3)
    assert features["observation.state"].shape == observation["agent_pos"].shape[1:]
    assert features["observation.environment_state"].shape == observation["environment_state"].shape[1:]
    env.close()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("suite", "chains"), ("split", "test"), ("scene", "x"), ("task", "tidy up"), ("fps", 30),
        ("camera_name", "front,sideways"), ("renderer", "ray"), ("advance", "never"), ("max_parallel_tasks", 2),
        ("obs_type", "pixels"), ("task_observation", "words"),
    ],
)  # fmt: skip
def test_config_errors_name_the_field_and_its_value(field, value):
    with pytest.raises(ValueError, match=rf"{field}.*{value}"):
        CronosEnvConfig(**{field: value})


# Independent episodes ------------------------------------------------------------------------------------


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
        assert not (terminated | info["is_success"]).any()
        assert truncated.tolist() == [False, step == 80]
    np.testing.assert_array_equal(env.simulation.qpos[0], frozen)


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
