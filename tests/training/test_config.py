"""The config of a run: what is filled in, what is refused, flags and files that it is read from."""

import json

import pytest
from draccus.utils import ParsingError
from dummies import DummyEnv, DummyPolicyConfig
from lerobot.policies import make_policy
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot_env_cronos import CronosEnvConfig
from test_cronos_train import OBSERVATIONS, SMALL

from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.training.config import (
    CronosTrainConfig,
    PeriodicEvaluationConfig,
    RecordConfig,
    check,
    check_world,
    complete,
)
from cronos_lerobot.training.reading import load, read_config


def test_flags_of_the_protocol_and_the_algorithm():
    cfg = read_config(
        [
            "--env.type=cronos", "--protocol.scene_reset_interval=null", "--protocol.curriculum=[[650000,320]]",
            "--algorithm.type=ppo_paper", "--algorithm.policy_lr=0.5", "--record.streams=all",
        ]
    )  # fmt: skip
    assert cfg.protocol.scene_reset_interval is None
    assert cfg.protocol.scene_reset_interval_at(650_000) == 320
    assert cfg.protocol.scene_reset_interval_at(650_001) is None
    assert isinstance(cfg.algorithm, PaperPPOConfig)
    assert (cfg.algorithm.policy_lr, cfg.algorithm.minibatch_size) == (0.5, 8)
    assert cfg.record.count(7) == 7
    # Without its type, a setting is of the default's.
    assert read_config(["--algorithm.clip=0.3"]).algorithm == PPOConfig(clip=0.3)


@pytest.mark.parametrize("name", ["train_config.json", ""])
def test_a_saved_config_reads_back_and_takes_flags(name, tmp_path):
    cfg = CronosTrainConfig(
        env=CronosEnvConfig(),
        policy=DummyPolicyConfig(),
        output_dir=tmp_path / "run",
        algorithm=PPOConfig(epochs=7, policy_lr_min=1e-7),
        resume="auto",
    )
    cfg.save_pretrained(tmp_path)
    copy = load(tmp_path / name, ["--steps=77"])
    assert copy.to_dict() == cfg.to_dict() | {"steps": 77}
    # How a run was started is no part of it.
    assert copy.resume is False


def test_steps_are_rounded_up_to_whole_updates():
    assert CronosTrainConfig(steps=1, protocol=ProtocolConfig(80)).total_steps == 64 * 160
    assert CronosTrainConfig(steps=1_300_000, protocol=ProtocolConfig(80)).total_steps == 127 * 64 * 160


WRONG = {
    "--steps": {"steps": 0},
    "--torch_threads": {"torch_threads": 0},
    "--eval.split": {"eval": PeriodicEvaluationConfig(split="test")},
    "--eval.repetitions": {"eval": PeriodicEvaluationConfig(repetitions=2, temperature=0)},
    "--resume": {"resume": "maybe"},
    "--env.split": {"env": CronosEnvConfig(split="held_out")},
    "--save_checkpoint": {
        "policy": DummyPolicyConfig(push_to_hub=True, repo_id="me/rl"),
        "save_checkpoint": False,
    },
    "--policy.use_amp": {"policy": DummyPolicyConfig(use_amp=True)},
    "--protocol.reward=level": {
        "algorithm": ImitationConfig(weighting="return"),
        "protocol": ProtocolConfig(reward="level"),
    },
    "--record.streams": {"record": RecordConfig("me/stream", streams="65")},
    "--record.flush_interval_s": {"record": RecordConfig(flush_interval_s=0)},
    "observation.images.front": {
        "record": RecordConfig("me/stream"),
        "env": CronosEnvConfig(observation_height=127),
    },
    "--protocol.task_switch_interval": {
        "record": RecordConfig("me/stream"),
        "protocol": ProtocolConfig(10**5, 10**5, None),
    },
}


def test_what_would_train_something_else_than_it_says_is_named():
    right = {"env": CronosEnvConfig(), "policy": DummyPolicyConfig()}
    for flag, options in WRONG.items():
        cfg = CronosTrainConfig(**(right | options))
        complete(cfg)
        with pytest.raises(ValueError, match=flag):
            check(cfg)


class Bare(DummyEnv):
    """A world without anything that is optional."""

    end_effector_reset = put_back = None


LACKING = {
    "--eval.n_episodes must be <= 64": (DummyEnv, {"eval": PeriodicEvaluationConfig(n_episodes=65)}),
    "--protocol.num_configurations": (DummyEnv, {"protocol": ProtocolConfig(num_configurations=65)}),
    "--protocol.end_effector_reset": (Bare, {}),
    "--protocol.heuristic_reset": (
        Bare,
        {"protocol": ProtocolConfig(end_effector_reset=False, heuristic_reset=True)},
    ),
}


def test_what_a_world_lacks_is_named_with_the_flag_that_needs_it():
    for flag, (world, options) in LACKING.items():
        with pytest.raises(ValueError, match=flag):
            check_world(CronosTrainConfig(**options), world(1))
    check_world(CronosTrainConfig(), DummyEnv(1))


def test_intervals_that_are_not_given_are_those_of_the_worlds_tasks():
    cfg = CronosTrainConfig(env=CronosEnvConfig(), policy=DummyPolicyConfig())
    complete(cfg)
    found = cfg.protocol
    assert (found.task_switch_interval, found.update_interval, found.scene_reset_interval) == (80, 160, 1280)
    given = ProtocolConfig(scene_reset_interval=None).resolve(480)
    assert (given.task_switch_interval, given.update_interval, given.scene_reset_interval) == (480, 960, None)
    with pytest.raises(ValueError, match="scene_reset_interval"):
        ProtocolConfig(scene_reset_interval=1280).resolve(480)


def test_what_is_missing_is_asked_for():
    for flag, cfg in (
        ("--env.type", CronosTrainConfig()),
        ("--policy", CronosTrainConfig(env=CronosEnvConfig())),
    ):
        with pytest.raises(ValueError, match=flag):
            complete(cfg)


def test_the_privileged_state_is_the_critics_alone_beside_a_policy_from_scratch():
    """LeRobot lets a policy without features of its own read all that the environment shows."""

    def completed(**env):
        policy = ACTConfig(device="cpu", pretrained_backbone_weights=None)
        algorithm = PPOConfig(critic_observation="environment_state")
        cfg = CronosTrainConfig(CronosEnvConfig(**env), policy, algorithm=algorithm)
        complete(cfg)
        return cfg

    cfg = completed()
    assert cfg.env.privileged_state
    assert set(cfg.policy.input_features) == {"observation.state", "observation.images.front"}
    assert make_policy(cfg.policy, env_cfg=cfg.env).config.env_state_feature is None
    # What is trained from the state reads it.
    cfg = completed(obs_type="environment_state_agent_pos")
    assert make_policy(cfg.policy, env_cfg=cfg.env).config.env_state_feature is not None


@pytest.fixture
def base(tmp_path):
    """A policy with the repository that it was pushed to in its config."""
    policy = ACTConfig(chunk_size=8, n_action_steps=2, device="cpu", repo_id="me/clone", push_to_hub=False)
    policy.save_pretrained(tmp_path / "base")
    return tmp_path / "base"


@pytest.mark.parametrize(
    ("flags", "repository", "is_pushed"),
    [
        ([], None, False),
        (["--policy.repo_id=me/rl"], "me/rl", True),
        (["--policy.repo_id", "me/rl"], "me/rl", True),
        (["--policy.repo_id=me/rl", "--policy.push_to_hub=false"], "me/rl", False),
    ],
)
def test_a_run_is_pushed_to_its_own_repository_alone(flags, repository, is_pushed, base):
    policy = read_config([f"--policy.path={base}", *flags]).policy
    assert (policy.repo_id, policy.push_to_hub, policy.pretrained_path) == (repository, is_pushed, base)


def saved(run, **changes):
    """A folder of a run with a checkpoint that has only its config."""
    folder = run / "checkpoints/000016/pretrained_model"
    folder.mkdir(parents=True)
    (run / "checkpoints/last").symlink_to("000016")
    cfg = read_config([*SMALL, *OBSERVATIONS["state"], "--record.repo_id=me/stream"])
    content = cfg.to_dict()
    content["wandb"]["run_id"] = "abc"
    for group, values in changes.items():
        content[group] |= values
    (folder / "train_config.json").write_text(json.dumps(content))
    return folder / "train_config.json"


def test_resuming_takes_the_runs_config_and_the_flags(tmp_path):
    run = tmp_path / "run"
    file = saved(run)
    in_place = (["--resume=auto", f"--output_dir={run}"], ["--resume=true", f"--output_dir={run}"])
    for flags in (*in_place, ["--resume=true", f"--config_path={file}"]):
        cfg = read_config([*flags, "--steps=64"])
        assert (cfg.steps, cfg.num_envs, cfg.algorithm.minibatch_size) == (64, 2, 8)
        assert (cfg.output_dir, cfg.checkpoint_path) == (run, run / "checkpoints/000016")
        assert cfg.wandb.run_id == "abc"
    # A new run with the same settings is logged as one of its own.
    assert read_config([f"--config_path={file}"]).wandb.run_id is None
    # Without a checkpoint `auto` begins.
    assert read_config(["--resume=auto", f"--output_dir={tmp_path / 'new'}"]).checkpoint_path is None


def test_resuming_something_else_is_refused(tmp_path, base):
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    file = saved(run, record={"root": str(elsewhere)}, policy={"pretrained_path": str(base)})
    resume = ["--resume=true", f"--config_path={file}", f"--record.root={elsewhere}"]
    auto = ["--resume=auto", f"--output_dir={run}", f"--record.root={elsewhere}"]
    with pytest.raises(ParsingError, match="policy"):
        read_config([*resume, "--policy.type=act"])
    with pytest.raises(ValueError, match="--output_dir"):
        read_config([*resume, f"--output_dir={elsewhere}"])
    # The same command begins a run and resumes it.
    assert read_config([*auto, f"--policy.path={base}"]).policy.type == "pocketvla"
    with pytest.raises(ValueError, match=r"--policy\.path=/other"):
        read_config([*auto, "--policy.path=/other"])
    for flags in (["--resume=true"], ["--resume=auto"]):
        with pytest.raises(ValueError, match="--output_dir"):
            read_config(flags)


def test_a_strangers_run_writes_nowhere_but_in_its_folder(tmp_path):
    mine, theirs = tmp_path / "mine", tmp_path / "theirs"
    file = saved(mine, record={"root": "/home/me/data"})
    with pytest.raises(ValueError, match=r"--record\.root=/home/me/data"):
        read_config(["--resume=true", f"--config_path={file}"])
    (theirs / "checkpoints").mkdir(parents=True)
    (theirs / "checkpoints/last").symlink_to(mine / "checkpoints/000016")
    with pytest.raises(ValueError, match="leads out"):
        read_config(["--resume=true", f"--config_path={theirs}/checkpoints/last/pretrained_model"])


def test_resuming_imports_only_what_the_command_names(tmp_path, monkeypatch):
    """A stranger's manifest may name any module."""
    run = tmp_path / "run"
    file = saved(run)
    command = ["cronos-train", "--discover_packages_path=theirs"]
    (run / "manifest.json").write_text(json.dumps({"starts": [{"command": command}]}))
    (tmp_path / "theirs.py").write_text("raise SystemExit('executed')")
    (tmp_path / "named.py").write_text("imported = True")
    monkeypatch.syspath_prepend(tmp_path)
    read_config(["--resume=true", f"--config_path={file}", "--discover_packages_path=named"])
