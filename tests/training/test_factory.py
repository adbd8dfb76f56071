"""What a policy reads and the environment shows, what is told of both, processors of strangers, decisions."""

import json
import logging
from types import SimpleNamespace

import pytest
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.utils.constants import OBS_STATE
from lerobot_env_cronos import CronosEnvConfig
from lerobot_policy_pocketvla import PocketVLAConfig
from test_cronos_train import SMALL, cronos_train
from tiny_checkpoints import STATE, record_one, save_policy, write_train_config

from cronos_lerobot.agents.imitation.config import DemosConfig, ImitationConfig
from cronos_lerobot.evaluation.policy_env import check_observations
from cronos_lerobot.evaluation.policy_loading import check_processor_classes
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import (
    check_demonstrations,
    check_pictures,
    make_parts,
    make_policy_and_processors,
)


@pytest.fixture
def pocketvla(tmp_path):
    """A small one that was trained in the playroom."""
    folder = save_policy(tmp_path, "pocketvla", STATE, hidden_width=16, hidden_depth=1)
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = write_train_config(tmp_path, env={"scene": "playroom_2x2"})
    return config


def test_a_policy_and_demonstrations_of_another_scene_are_told(pocketvla, tmp_path, caplog):
    """Their sizes may be the same."""
    config = CronosTrainConfig(CronosEnvConfig(**STATE), pocketvla)
    with caplog.at_level(logging.WARNING):
        make_policy_and_processors(config)
    assert "--env.scene=playroom_2x2" in caplog.text
    demos = record_one(tmp_path / "demos", scene="playroom_2x2")
    config.algorithm = ImitationConfig(demos=DemosConfig("me/demos", demos), demos_share=0.5)
    config.num_envs = 1
    with pytest.raises(ValueError, match="playroom_2x2"):
        make_parts(config, Ranks())
    # A robot's scene is that of its simulation.
    check_demonstrations(config.algorithm, "cronos_robot/playroom_2x2-v1")


@pytest.mark.parametrize(("told", "is_warned"), [("none", True), ("one_hot", False)])
def test_a_policy_without_language_that_is_not_told_its_task_is_named(told, is_warned, caplog):
    env = CronosEnvConfig(**STATE, task_observation=told)
    make_policy_and_processors(CronosTrainConfig(env, ACTConfig(device="cpu", chunk_size=8, n_action_steps=8)))
    warned = [record for record in caplog.records if "--env.task_observation=one_hot" in record.message]
    assert len(warned) == is_warned


def pictured(name, size):
    """A policy that takes the robot's state and one picture."""
    features = {OBS_STATE: PolicyFeature(FeatureType.STATE, (13,)), name: PolicyFeature(FeatureType.VISUAL, size)}
    return PocketVLAConfig(device="cpu", input_features=features, observation="image")


def test_pictures_of_another_size_are_told_and_empty_cameras_are_not_asked_for(caplog):
    env = CronosEnvConfig()
    empty = pictured("observation.images.empty_camera_0", (3, 32, 32))
    for check in (check_observations, check_pictures):
        check(empty, env)
        check(pictured("observation.images.front", (3, 64, 64)), env)
    assert not caplog.records
    # PocketVLA scales none.
    other = pictured("observation.images.front", (3, 64, 48))
    with pytest.raises(ValueError, match=r"--env\.observation_height=64 --env\.observation_width=48"):
        check_pictures(other, env)
    check_pictures(SimpleNamespace(input_features=other.input_features), env)
    (record,) = caplog.records
    assert "--env.observation_height=64 --env.observation_width=48" in record.message


RENAMED = {"observation.images.front": "observation.images.camera1"}


def test_observations_may_have_another_name(tmp_path, monkeypatch):
    """A policy of somebody's camera1 learns from the scene's front camera, and its checkpoints know."""
    policy = pictured("observation.images.camera1", (3, 64, 64))
    with pytest.raises(ValueError, match="--rename_map"):
        check_observations(policy, CronosEnvConfig())
    check_observations(policy, CronosEnvConfig(), RENAMED)
    base = save_policy(tmp_path / "base", "pocketvla", {}, hidden_width=16, hidden_depth=1)
    content = json.loads((base / "config.json").read_text())
    images = content["input_features"].pop("observation.images.front")
    content["input_features"]["observation.images.camera1"] = images
    (base / "config.json").write_text(json.dumps(content))
    flags = [flag for flag in SMALL if not flag.startswith("--policy.")]
    start = (*flags, f"--policy.path={base}", "--policy.device=cpu", f"--output_dir={tmp_path / 'run'}")
    with pytest.raises(SystemExit, match="--rename_map"):
        cronos_train(monkeypatch, *start)
    cronos_train(monkeypatch, *start, f"--rename_map={json.dumps(RENAMED)}", "--steps=16")
    saved = tmp_path / "run/checkpoints/last/pretrained_model/policy_preprocessor.json"
    assert RENAMED in [step["config"].get("rename_map") for step in json.loads(saved.read_text())["steps"]]


def test_a_strangers_processors_run_nothing_but_processor_steps(pocketvla, tmp_path):
    """LeRobot imports and calls whatever class they name."""
    file = pocketvla.pretrained_path / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    harm = {"class": "subprocess.Popen", "config": {"args": ["touch", str(tmp_path / "harm")]}}
    file.write_text(json.dumps(content | {"steps": [harm, *content["steps"]]}))
    with pytest.raises(ValueError, match=r"subprocess\.Popen"):
        make_policy_and_processors(CronosTrainConfig(CronosEnvConfig(**STATE), pocketvla))
    assert not (tmp_path / "harm").exists()
    known = {"class": "lerobot.processor.rename_processor.RenameObservationsProcessorStep", "config": {}}
    file.write_text(json.dumps(content | {"steps": [known]}))
    check_processor_classes(file.parent)
    # It would load an encoder from anywhere, with its code.
    reward = {"registry_name": "reward_classifier_processor", "config": {"pretrained_path": "stranger/model"}}
    file.write_text(json.dumps(content | {"steps": [reward]}))
    with pytest.raises(ValueError, match="reward_classifier_processor"):
        check_processor_classes(file.parent)


def act_config():
    policy = ACTConfig(device="cpu", chunk_size=4, n_action_steps=4, dim_model=32, n_heads=2, dim_feedforward=32)
    env = CronosEnvConfig(**STATE, task_observation="one_hot")
    return CronosTrainConfig(env, policy, num_envs=2, algorithm=ImitationConfig())


def test_a_policy_that_cannot_act_is_refused_in_a_sentence(monkeypatch):
    """A plugin may train with lerobot-train and have no select_action that works."""

    def select_action(self, batch, **options):
        raise NotImplementedError("later")

    monkeypatch.setattr("lerobot.policies.act.modeling_act.ACTPolicy.select_action", select_action)
    with pytest.raises(ValueError, match=r"--policy\.type=act"):
        make_parts(act_config(), Ranks())
