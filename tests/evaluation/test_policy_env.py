"""A policy is evaluated in the environment that it expects: what it observes, and where it was trained."""

import sys

import pytest
import yaml
from lerobot.configs import PreTrainedConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot_env_cronos import CronosEnvConfig
from lerobot_policy_pocketvla import PocketVLAConfig
from tiny_checkpoints import STATE, TINY_ACT, TOLD, record_one, save_policy, write_train_config

from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.policy_env import reads_privileged_state, trained_observations
from cronos_lerobot.scripts.eval import read_command_line

FILAMENT = {"renderer": "filament"}


def config_of(folder):
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return config


def test_the_renderer_is_the_runs_or_that_of_the_cloned_demonstrations(tmp_path):
    def renderer(**config):
        trained = write_train_config(tmp_path, **config)
        return trained_observations(policy_of().input_features, trained).get("renderer")

    # Demonstrations that say that Filament was asked for; without pictures it is not needed here.
    dataset = {"repo_id": "me/demos", "root": str(record_one(tmp_path / "demos", **FILAMENT))}
    assert renderer(env={"type": "cronos"} | FILAMENT) == "filament"
    assert renderer(env=None, dataset=dataset) == "filament"
    # What lerobot-train evaluates in is not what it learned from.
    assert renderer(env={"type": "cronos", "renderer": "classic"}, dataset=dataset) == "filament"
    assert renderer(env=None, dataset=dataset | {"root": str(tmp_path)}) is None
    assert renderer(env={"type": "libero"} | FILAMENT) is None


def policy_of(make=ACTConfig, **shown):
    """A policy of all that is shown."""
    features = env_to_policy_features(CronosEnvConfig(**shown))
    return make(device="cpu", input_features={key: f for key, f in features.items() if key != "action"})


def test_the_cameras_of_either_arm_are_those_that_a_policy_takes():
    for cameras, scene in (("front,bridge", "kitchen_2x2"), ("front,wrist", "so101_desk_2x2")):
        features = policy_of(scene=scene, camera_name=cameras).input_features
        assert trained_observations(features, None)["camera_name"] == cameras


def test_a_policy_of_another_arm_is_evaluated_at_its_rate(tmp_path, monkeypatch):
    shown = {"scene": "so101_desk_2x2", "obs_type": "environment_state_agent_pos"}
    folder = save_policy(tmp_path, "act", shown, **TINY_ACT)
    write_train_config(folder, env={"type": "cronos", "scene": "so101_desk_2x2", "fps": 30})
    monkeypatch.setattr(sys, "argv", ["cronos-eval", f"--policy.path={folder}"])
    env = read_command_line().env
    assert (env.scene, env.fps, env.obs_type) == ("so101_desk_2x2", 30, shown["obs_type"])


@pytest.mark.parametrize(
    ("make", "shown", "reads"),
    [
        (ACTConfig, {"privileged_state": True}, True),
        (ACTConfig, {}, False),
        # From the state it is no secret.
        (ACTConfig, STATE, False),
        # For its critic.
        (PocketVLAConfig, {"privileged_state": True}, False),
    ],
)
def test_whether_a_policy_reads_the_poses_beside_pictures(make, shown, reads):
    """LeRobot makes an input of all that a dataset has."""
    assert reads_privileged_state(policy_of(make, **shown)) is reads


@pytest.fixture(scope="module")
def of_playroom(tmp_path_factory):
    """A policy that takes pictures of 96 x 48, trained in the playroom."""
    size = {"scene": "playroom_2x2", "observation_height": 48, "observation_width": 96}
    folder = save_policy(tmp_path_factory.mktemp("policy"), "pocketvla", size, hidden_width=16, hidden_depth=1)
    return write_train_config(folder, env={"type": "cronos", "scene": "playroom_2x2"} | FILAMENT)


@pytest.mark.parametrize(
    ("env", "flag", "scene", "height", "renderer"),
    [
        (None, None, "playroom_2x2", 48, "filament"),
        ({"type": "cronos", "renderer": "classic"}, None, "playroom_2x2", 48, "classic"),
        (None, "--env.renderer=classic", "playroom_2x2", 48, "classic"),
        (
            {"type": "cronos", "scene": "kitchen_2x2", "observation_height": 128},
            None,
            "kitchen_2x2",
            128,
            "filament",
        ),
    ],
)
def test_what_flags_and_file_leave_open_follows_from_the_policy(
    env, flag, scene, height, renderer, of_playroom, tmp_path, monkeypatch
):
    """A default that is given counts as given."""
    file = tmp_path / "eval.yaml"
    file.write_text(yaml.safe_dump({"seed": 3} | ({} if env is None else {"env": env})))
    given = [flag, "--env.type=cronos"] if flag else [f"--config_path={file}"]
    monkeypatch.setattr(sys, "argv", ["cronos-eval", f"--policy.path={of_playroom}", *given])
    config = read_command_line()
    assert (config.env.scene, config.env.observation_height) == (scene, height)
    assert (config.env.observation_width, config.env.renderer) == (96, renderer)
    assert config.seed == (1000 if flag else 3)


def test_a_policy_that_was_told_its_task_is_told_it_again(tmp_path, monkeypatch):
    folder = save_policy(tmp_path, "act", TOLD, **TINY_ACT)
    monkeypatch.setattr(sys, "argv", ["cronos-eval", f"--policy.path={folder}"])
    assert read_command_line().env.task_observation == "one_hot"
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--env.type=cronos", "--env.task_observation=none"])
    with pytest.raises(ValueError, match=r"--env\.task_observation=one_hot"):
        read_command_line()


def test_an_environment_given_in_python_is_kept_and_flags_of_another_program_are_not_read(
    of_playroom, monkeypatch
):
    monkeypatch.setattr(sys, "argv", ["script.py", "--env.scene=kitchen_2x2"])
    env = CronosEnvConfig(scene="kitchen_3x3", observation_height=32)
    config = CronosEvalConfig(env=env, policy=config_of(of_playroom))
    # Looking again changes nothing.
    for _ in range(2):
        config.resolve()
        assert (config.env.scene, config.env.observation_height) == ("kitchen_3x3", 32)
        assert (config.env.observation_width, config.env.renderer) == (96, "filament")
