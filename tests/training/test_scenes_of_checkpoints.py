"""What was learned or demonstrated in another scene is told from the run's: its sizes may be the same."""

import logging
from types import SimpleNamespace

import pytest
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import OBS_STATE
from lerobot_env_cronos import CronosEnvConfig
from lerobot_policy_pocketvla import PocketVLAConfig
from tiny_checkpoints import STATE, record_one, save_policy, write_train_config

from cronos_lerobot.agents.imitation.config import DemosConfig, ImitationConfig
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.evaluation.policy_env import trained_scene
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import (
    check_demonstrations,
    check_features,
    make_policy_and_processors,
    warn_of_other_scene,
)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Demonstrations in the playroom."""
    return record_one(tmp_path_factory.mktemp("demos") / "playroom", scene="playroom_2x2")


def test_the_scene_is_the_runs_or_that_of_the_cloned_demonstrations(demos, tmp_path):
    dataset = {"repo_id": "me/demos", "root": str(demos)}
    assert trained_scene(write_train_config(tmp_path, env=None, dataset=dataset)) == {"scene": "playroom_2x2"}
    env = {"type": "cronos", "scene": "kitchen_3x3"}
    assert trained_scene(write_train_config(tmp_path, env=env, dataset=dataset)) == {"scene": "kitchen_3x3"}
    assert trained_scene(write_train_config(tmp_path, env=None, dataset=dataset | {"root": str(tmp_path)})) == {}
    assert trained_scene(write_train_config(tmp_path, env=None, dataset=None)) == {}
    assert trained_scene(tmp_path / "none") == {}
    # In the default scene the policy would be another task's; what is not of this package is not its business.
    with pytest.raises(ValueError, match=r"was trained in .* scene 'study'.* --env\.discover_packages_path="):
        trained_scene(write_train_config(tmp_path, env={"type": "cronos", "scene": "study"}, dataset=None))
    assert (
        trained_scene(write_train_config(tmp_path, env={"type": "libero", "scene": "study"}, dataset=None)) == {}
    )


def test_a_policy_of_another_scene_is_told(tmp_path, caplog):
    folder = write_train_config(tmp_path, env={"scene": "playroom_2x2"})
    with caplog.at_level(logging.WARNING):
        warn_of_other_scene(SimpleNamespace(pretrained_path=folder), "playroom_2x2")
        # No name of a repository, so that nothing is looked for.
        warn_of_other_scene(SimpleNamespace(pretrained_path=tmp_path / "none"), "kitchen_2x2")
        assert not caplog.records
        warn_of_other_scene(SimpleNamespace(pretrained_path=folder), "kitchen_2x2")
    (record,) = caplog.records
    assert "was trained in --env.scene=playroom_2x2, this run is in --env.scene=kitchen_2x2" in record.message


def test_demonstrations_of_another_scene_are_refused(demos, tmp_path):
    config = ImitationConfig(demos=DemosConfig("me/demos", demos), demos_share=0.5)
    with pytest.raises(ValueError, match=r"me/demos is of --env\.scene=playroom_2x2, .* --env\.scene=kitchen_2x2"):
        check_demonstrations(config, "kitchen_2x2")
    check_demonstrations(config, "playroom_2x2")
    check_demonstrations(PPOConfig(), "kitchen_2x2")
    # One that is not here yet comes from the Hub.
    config = ImitationConfig(demos=DemosConfig("me/demos", tmp_path / "none"), demos_share=0.5)
    check_demonstrations(config, "kitchen_2x2")


def test_a_run_looks_at_both(demos, tmp_path, caplog):
    policy_config = PreTrainedConfig.from_pretrained(
        save_policy(tmp_path, "pocketvla", STATE, hidden_width=16, hidden_depth=1)
    )
    policy_config.pretrained_path = write_train_config(tmp_path, env={"scene": "playroom_2x2"})
    config = CronosTrainConfig(CronosEnvConfig(**STATE), policy_config)
    make_policy_and_processors(config)
    assert "was trained in --env.scene=playroom_2x2" in caplog.text
    config.algorithm = ImitationConfig(demos=DemosConfig("me/demos", demos), demos_share=0.5)
    with pytest.raises(ValueError, match="record demonstrations there"):
        make_policy_and_processors(config)


def pictured(name, size):
    """A policy that takes the robot's state and one picture."""
    features = {OBS_STATE: PolicyFeature(FeatureType.STATE, (13,)), name: PolicyFeature(FeatureType.VISUAL, size)}
    return SimpleNamespace(input_features=features, output_features={})


def test_pictures_of_another_size_are_told_and_empty_cameras_are_not_asked_for(caplog):
    env = CronosEnvConfig()
    check_features(pictured("observation.images.empty_camera_0", (3, 64, 64)), env)
    check_features(pictured("observation.images.front", (3, 128, 128)), env)
    assert not caplog.records
    check_features(pictured("observation.images.front", (3, 64, 48)), env)
    (record,) = caplog.records
    assert "of 64 x 48 pixels and learns here from 128 x 128" in record.message
    assert "--env.observation_height=64 --env.observation_width=48" in record.message
    # PocketVLA scales none; one that reads the state may have been cloned from data with pictures.
    features = pictured("observation.images.front", (3, 64, 48)).input_features
    policy = PocketVLAConfig(device="cpu", input_features=features, observation="image")
    with pytest.raises(ValueError, match=r"64 x 48 pixels, and scales none: give --env\.observation_height=64"):
        check_features(policy, env)
    policy.observation = "environment_state"
    check_features(policy, env)


def test_a_precision_that_training_would_ignore_is_refused():
    policy = PocketVLAConfig(device="cpu", use_amp=True)
    with pytest.raises(ValueError, match=r"--policy.use_amp=true is followed by evaluations alone"):
        make_policy_and_processors(CronosTrainConfig(policy=policy, env=CronosEnvConfig()))
