"""The renderer of the pictures that a policy learned from is the one that it is evaluated with."""

import sys

import pytest
import yaml
from lerobot.configs import PreTrainedConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot_env_cronos import CronosEnvConfig
from lerobot_policy_pocketvla import PocketVLAConfig
from tiny_checkpoints import STATE, record_one, save_policy, write_train_config

from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.policy_env import (
    reads_privileged_state,
    trained_renderer,
    warn_of_privileged_state,
)
from cronos_lerobot.scripts.errors import parse_command_line

FILAMENT = {"renderer": "filament"}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Demonstrations that say that Filament was asked for; without pictures it is not needed here."""
    return record_one(tmp_path_factory.mktemp("demos") / "demos", **FILAMENT)


def test_the_renderer_is_the_runs_or_that_of_the_cloned_demonstrations(demos, tmp_path):
    dataset = {"repo_id": "me/demos", "root": str(demos)}
    assert trained_renderer(write_train_config(tmp_path, env={"type": "cronos"} | FILAMENT)) == FILAMENT
    assert trained_renderer(write_train_config(tmp_path, env=None, dataset=dataset)) == FILAMENT
    # What lerobot-train evaluates in is not what it learned from.
    classic = {"type": "cronos", "renderer": "classic"}
    assert trained_renderer(write_train_config(tmp_path, env=classic, dataset=dataset)) == FILAMENT
    elsewhere = dataset | {"root": str(tmp_path)}
    assert trained_renderer(write_train_config(tmp_path, env=None, dataset=elsewhere)) == {}
    # Of runs of before there was a choice, of other packages, and of nothing.
    assert trained_renderer(write_train_config(tmp_path, env={"type": "cronos"})) == {}
    assert trained_renderer(write_train_config(tmp_path, env={"type": "libero"} | FILAMENT)) == {}
    assert trained_renderer(tmp_path / "none") == {}


@pytest.mark.parametrize(
    ("make", "shown", "is_told"),
    [
        (ACTConfig, {"privileged_state": True}, True),
        (ACTConfig, {}, False),
        # From the state it is no secret.
        (ACTConfig, STATE, False),
        # For its critic.
        (PocketVLAConfig, {"privileged_state": True}, False),
    ],
)
def test_a_policy_that_reads_the_poses_beside_pictures_is_told_of(make, shown, is_told, caplog):
    """LeRobot makes an input of all that a dataset has."""
    features = env_to_policy_features(CronosEnvConfig(**shown))
    config = make(device="cpu", input_features={key: f for key, f in features.items() if key != "action"})
    assert reads_privileged_state(config) is is_told
    warn_of_privileged_state(config)
    assert ("reads observation.environment_state beside its pictures" in caplog.text) is is_told


@pytest.mark.parametrize(
    ("observation", "flags", "renderer"),
    [
        ({}, [], "filament"),
        ({}, ["--env.renderer=classic"], "classic"),
        # It would draw the videos alone.
        (STATE, [], "classic"),
    ],
)
def test_an_evaluation_draws_as_the_training_did_unless_it_is_told(
    observation, flags, renderer, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "argv", ["cronos-eval", *flags])
    folder = save_policy(tmp_path, "pocketvla", observation, hidden_width=16, hidden_depth=1)
    policy = PreTrainedConfig.from_pretrained(write_train_config(folder, env={"type": "cronos"} | FILAMENT))
    policy.pretrained_path = folder
    config = CronosEvalConfig(policy=policy)
    config.validate()
    assert config.env.renderer == renderer
    assert config.identity().get("renderer", "classic") == renderer


@pytest.fixture(scope="module")
def of_playroom(tmp_path_factory):
    """A policy that takes pictures of 96 x 64, trained in the playroom."""
    size = {"scene": "playroom_2x2", "observation_height": 64, "observation_width": 96}
    folder = save_policy(tmp_path_factory.mktemp("policy"), "pocketvla", size, hidden_width=16, hidden_depth=1)
    return write_train_config(folder, env={"type": "cronos", "scene": "playroom_2x2"} | FILAMENT)


@pytest.mark.parametrize(
    ("env", "scene", "height", "renderer"),
    [
        (None, "playroom_2x2", 64, "filament"),
        ({"type": "cronos", "renderer": "classic"}, "playroom_2x2", 64, "classic"),
        ({"type": "cronos", "scene": "kitchen_2x2", "observation_height": 128}, "kitchen_2x2", 128, "filament"),
    ],
)
def test_what_a_config_file_leaves_open_follows_from_the_policy(
    env, scene, height, renderer, of_playroom, tmp_path, monkeypatch
):
    file = tmp_path / "eval.yaml"
    file.write_text(yaml.safe_dump({"seed": 3} | ({} if env is None else {"env": env})))
    monkeypatch.setattr(sys, "argv", ["cronos-eval", f"--config_path={file}", f"--policy.path={of_playroom}"])
    config = parse_command_line(CronosEvalConfig)
    config.validate()
    assert (config.seed, config.env.scene, config.env.observation_height) == (3, scene, height)
    assert (config.env.observation_width, config.env.renderer) == (96, renderer)


def test_an_environment_given_in_python_is_kept(of_playroom, monkeypatch):
    """As far as it is no default, which says nothing."""
    monkeypatch.setattr(sys, "argv", ["script.py"])
    policy = PreTrainedConfig.from_pretrained(of_playroom)
    policy.pretrained_path = of_playroom
    config = CronosEvalConfig(env=CronosEnvConfig(scene="kitchen_3x3", observation_height=32), policy=policy)
    config.validate()
    assert (config.env.scene, config.env.observation_height) == ("kitchen_3x3", 32)
    assert (config.env.observation_width, config.env.renderer) == (96, "filament")
    # Looking again changes nothing.
    config.validate()
    assert (config.env.scene, config.env.observation_height) == ("kitchen_3x3", 32)
