import dataclasses
import json
import sys
from pathlib import Path

import pytest
import yaml
from draccus.utils import DecodingError
from dummies import DummyPolicyConfig
from flags import parse_flags
from lerobot.policies import make_policy
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig
from cronos_lerobot.evaluation.policy_source import load_policy_config
from cronos_lerobot.scripts import train as script
from cronos_lerobot.training import config
from cronos_lerobot.training.config import CronosTrainConfig, PeriodicEvaluationConfig


def parse(*arguments):
    return parse_flags(CronosTrainConfig, arguments)


def test_flags_of_the_protocol_and_the_algorithm():
    cfg = parse(
        "--env.type=cronos",
        "--protocol.scene_reset_interval=null",
        "--protocol.curriculum=[[650000,320]]",
        "--protocol.reset_budget=2000",
        "--algorithm.type=ppo_paper",
        "--algorithm.policy_lr=0.5",
        "--record.streams=all",
    )
    assert cfg.protocol.scene_reset_interval is None
    assert cfg.protocol.scene_reset_interval_at(650_000) == 320
    assert cfg.protocol.scene_reset_interval_at(650_001) is None
    without_at_first = parse("--protocol.curriculum=[[650000,null]]").protocol
    assert [without_at_first.scene_reset_interval_at(n) for n in (650_000, 650_001)] == [None, 1280]
    assert isinstance(cfg.algorithm, PaperPPOConfig)
    assert (cfg.algorithm.policy_lr, cfg.algorithm.minibatch_size) == (0.5, 8)
    assert cfg.record.num_streams == "all"
    assert isinstance(cfg.env, CronosEnvConfig)


def test_saved_config_reads_back_and_takes_overrides(tmp_path):
    cfg = CronosTrainConfig(
        env=CronosEnvConfig(),
        policy=DummyPolicyConfig(),
        output_dir=tmp_path / "run",
        algorithm=PPOConfig(epochs=7),
    )
    cfg.save_pretrained(tmp_path)
    for path in (tmp_path, tmp_path / "train_config.json"):
        copy = CronosTrainConfig.from_pretrained(path, cli_args=["--steps=77"])
        assert copy.to_dict() == cfg.to_dict() | {"steps": 77}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        CronosTrainConfig.from_pretrained(tmp_path / "nowhere.json")


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_an_agent_of_another_type_has_its_own_settings(suffix, tmp_path):
    file = tmp_path / f"config.{suffix}"
    file.write_text(json.dumps(CronosTrainConfig(algorithm=PPOConfig(epochs=7), steps=9).to_dict()))
    paper = CronosTrainConfig.from_pretrained(
        file, cli_args=["--algorithm.type=ppo_paper", "--algorithm.clip=0.3"]
    )
    assert (paper.algorithm, paper.steps) == (PaperPPOConfig(clip=0.3), 9)
    same = CronosTrainConfig.from_pretrained(file, cli_args=["--algorithm.type=ppo", "--algorithm.clip=0.3"])
    assert same.algorithm == PPOConfig(epochs=7, clip=0.3)


def test_who_resumes_says_so_and_no_file_does(tmp_path, monkeypatch):
    dataclasses.replace(CronosTrainConfig(policy=DummyPolicyConfig()), resume=True).save_pretrained(tmp_path)
    looked_at = []
    monkeypatch.setattr(config, "import_plugins", lambda checkpoint, arguments: looked_at.append(checkpoint))
    monkeypatch.setattr(config, "check_types", lambda checkpoint, arguments: None)
    for flags in ([], ["--steps=5"], ["--resume=false"]):
        assert not CronosTrainConfig.from_pretrained(tmp_path, cli_args=flags).resume
    assert not looked_at
    assert CronosTrainConfig.from_pretrained(tmp_path, cli_args=["--resume=true"]).resume
    assert len(looked_at) == 1


@pytest.mark.parametrize("word", ["True", "yes", "on", "'true'"])
def test_whatever_resumes_is_checked(word, tmp_path, monkeypatch):
    """Of YAML's words for it draccus takes all beside a file of YAML, and none beside one of JSON."""
    CronosTrainConfig(policy=DummyPolicyConfig()).save_pretrained(tmp_path)
    looked_at = []
    monkeypatch.setattr(config, "import_plugins", lambda checkpoint, arguments: looked_at.append("plugins"))
    monkeypatch.setattr(config, "check_types", lambda checkpoint, arguments: looked_at.append("types"))
    with pytest.raises(DecodingError, match="into a bool"):
        CronosTrainConfig.from_pretrained(tmp_path, cli_args=[f"--resume={word}"])
    assert not looked_at
    file = tmp_path / "train_config.yaml"
    file.write_text(yaml.safe_dump(json.loads((tmp_path / "train_config.json").read_text())))
    assert CronosTrainConfig.from_pretrained(file, cli_args=[f"--resume={word}"]).resume
    assert looked_at == ["plugins", "types"]
    assert not CronosTrainConfig.from_pretrained(file, cli_args=["--resume=no"]).resume
    assert looked_at == ["plugins", "types"]


def test_a_config_file_at_the_root_is_of_no_checkpoint(tmp_path, monkeypatch):
    """Such as /tmp/train_config.json: above its folder there is none that could be a run's."""
    cfg = CronosTrainConfig(env=CronosEnvConfig(), policy=DummyPolicyConfig())
    cfg.save_pretrained(tmp_path)
    monkeypatch.setattr(config, "_checkpoint_of", lambda file: Path("/"))
    monkeypatch.setattr(sys, "argv", ["cronos-train", "--resume=true", f"--config_path={tmp_path}"])
    message = r"^/ is no checkpoint of a run: it has no training_state\.$"
    with pytest.raises(NotADirectoryError, match=message):
        CronosTrainConfig.from_pretrained(tmp_path, cli_args=["--resume=true"])
    cfg.resume = True
    with pytest.raises(NotADirectoryError, match=message):
        cfg.validate()


def test_steps_are_rounded_up_to_whole_updates():
    assert CronosTrainConfig(steps=1).total_steps == 64 * 160
    assert CronosTrainConfig(steps=1_300_000).total_steps == 127 * 64 * 160


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps=0"], "steps must be >= 1"),
        (["--eval.n_episodes=0"], "eval.n_episodes must be >= 1, got 0"),
        (["--eval.split=test"], "held_out"),
        (
            [
                "--env.type=cronos",
                "--algorithm.type=imitation",
                "--algorithm.weighting=return",
                "--protocol.reward=level",
            ],
            "weighting=return with --protocol.reward=level would weigh late successes most",
        ),
        (["--protocol.update_interval=100"], "multiple of protocol.task_switch_interval=80"),
        (["--protocol.curriculum=[[null,320]]"], "must have increasing until_steps > 0"),
        (["--protocol.extra_resets=[nobody]"], "registered"),
        (["--protocol.task_order=sorted"], "heuristic"),
        (["--record.streams=some"], "number or 'all'"),
        (["--keep_checkpoints=0"], "keep_checkpoints"),
        (["--seed=-1"], "seed must be >= 0, got -1"),
        (["--torch_threads=-1"], "torch_threads must be >= 1 or null, got -1"),
        (["--save_freq=-1"], "save_freq must be >= 0, got -1"),
        (["--log_freq=-1"], "log_freq must be >= 1, got -1"),
        (["--steps=80"], "Choose an environment"),
        (["--env.type=pusht"], "--env.type must be cronos to train in, got 'pusht'"),
        (["--env.type=cronos", "--env.split=held_out"], "--env.split=held_out is of lerobot-eval: .*--eval.split"),
        (["--env.type=cronos", "--env.suite=sequential"], "--env.suite=sequential is of lerobot-eval"),
        (["--env.type=cronos", "--env.advance=on_success"], "--env.advance=on_success is .*task_switch_interval"),
        (
            ["--env.type=cronos", "--env.end_effector_reset=true"],
            "--env.end_effector_reset=True is .*--protocol.end_effector_reset",
        ),
        (
            ["--env.type=cronos", "--env.task=put the ketchup bottle on the cloth"],
            "--env.task=put the ketchup bottle on the cloth is of lerobot-eval: a run trains every task",
        ),
        (
            ["--env.type=cronos", "--eval_freq=0", "--eval.split=held_out"],
            "--eval.split=held_out is of the periodic evaluation, and there is none with --eval_freq=0: leave",
        ),
        (["--env.type=cronos", "--eval_freq=0", "--eval.seed=3"], "--eval.seed=3 is of the periodic evaluation"),
        (
            ["--env.type=cronos", "--save_checkpoint=false", "--save_freq=1000"],
            "--save_freq=1000 is of checkpoints, and there are none with --save_checkpoint=false: leave it out",
        ),
        (
            ["--env.type=cronos", "--save_checkpoint=false", "--keep_checkpoints=2"],
            "--keep_checkpoints=2 is of checkpoints",
        ),
        (
            [
                "--env.type=cronos",
                "--protocol.takeover_after=2",
                "--protocol.takeover_price=20",
                "--protocol.reset_budget=10",
            ],
            "reset_budget=10 pays for no takeover at protocol.takeover_price=20",
        ),
        (
            ["--env.type=cronos", "--algorithm.max_grad_norm", "null"],
            "null is no value of --algorithm.max_grad_norm",
        ),
        (["--resume=true"], "Resuming needs --config_path="),
        (["--resume=true", "--config_path=/nowhere/train_config.json"], "--config_path=/nowhere/.*: no such file"),
        (["--env.type=cronos", "--policy.path=/nowhere"], "--policy.path=/nowhere: no such folder"),
        (["--policy.path=/nowhere", "--policy.type=act"], "Cannot specify both --policy.path and --policy.type"),
        (
            ["--env.type=cronos", "--algorithm.value_loss=mse", "--algorithm.huber_delta", "3"],
            "--algorithm.huber_delta=3.0 has no effect here: it needs --algorithm.value_loss=huber",
        ),
        (["--env.type=cronos", "--algorithm.type=sac"], r"one of \[.*'ppo', 'ppo_paper'.*\], got 'sac'"),
        (["--env.type=cronos", "--algorithm.type=nobody"], r"one of \[.*'ppo', 'ppo_paper'.*\], got 'nobody'"),
    ],
)
def test_bad_values_are_named_on_the_command_line(arguments, message, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["cronos-train", *arguments])
    with pytest.raises(SystemExit, match=f"^error: .*{message}") as ended:
        script.main()
    assert "\n" not in str(ended.value)
    assert sys.argv == ["cronos-train", *arguments]


def test_what_a_policys_config_says_of_its_values_is_the_line(tmp_path):
    ACTConfig(chunk_size=8, n_action_steps=2, device="cpu").save_pretrained(tmp_path)
    message = r"config\.json is damaged, or --policy\.\* does not fit it: .*16 for `n_action_steps` and 8"
    with pytest.raises(ValueError, match=message):
        load_policy_config(str(tmp_path), ["--n_action_steps=16"])


def test_a_policy_that_cannot_be_read_is_told_by_what_is_wrong_with_it(tmp_path):
    ACTConfig(chunk_size=8, n_action_steps=2, device="cpu").save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=rf"^--policy\.path={tmp_path}: unrecognized arguments: --policy\.foo=1$"):
        load_policy_config(str(tmp_path), ["--foo=1"])
    config = tmp_path / "config.json"
    config.write_text(config.read_text().replace('"type": "act"', '"type": "not_installed"'))
    with pytest.raises(ValueError, match=rf"^--policy\.path={tmp_path}: .*not_installed"):
        load_policy_config(str(tmp_path), [])


def test_what_is_missing_is_asked_for(tmp_path):
    with pytest.raises(ValueError, match="--env"):
        CronosTrainConfig().validate()
    with pytest.raises(ValueError, match="--policy"):
        CronosTrainConfig(env=CronosEnvConfig()).validate()
    with pytest.raises(ValueError, match="--config_path"):
        CronosTrainConfig(env=CronosEnvConfig(), resume=True).validate()
    with pytest.raises(FileExistsError, match="--resume=true"):
        CronosTrainConfig(env=CronosEnvConfig(), policy=DummyPolicyConfig(), output_dir=tmp_path).validate()


@pytest.mark.parametrize(
    "options",
    [
        {"eval_freq": 0, "eval_at_interventions": [1000], "eval": PeriodicEvaluationConfig(split="held_out")},
        {"save_checkpoint": False},
        {"save_checkpoint": False, "save_freq": 51_200, "eval_freq": 51_200},
        {"save_freq": 1000, "keep_checkpoints": 2},
    ],
)
def test_what_has_an_effect_or_is_given_by_every_command_of_a_study_is_taken(options):
    """They end at the policy, which is missing."""
    with pytest.raises(ValueError, match="Choose a policy"):
        CronosTrainConfig(env=CronosEnvConfig(), **options).validate()


def test_the_privileged_state_is_the_critics_alone_beside_a_policy_from_scratch(tmp_path):
    """LeRobot lets a policy without features of its own read all that the environment shows."""
    algorithm = PPOConfig(critic_observation="environment_state")
    run = CronosTrainConfig(
        CronosEnvConfig(),
        ACTConfig(device="cpu", pretrained_backbone_weights=None),
        tmp_path / "run",
        algorithm=algorithm,
    )
    run.validate()
    assert run.env.privileged_state
    assert set(run.policy.input_features) == {"observation.state", "observation.images.front"}
    assert make_policy(run.policy, env_cfg=run.env).config.env_state_feature is None
    # What is trained from the state reads it.
    env = CronosEnvConfig(obs_type="environment_state_agent_pos")
    run = CronosTrainConfig(
        env, ACTConfig(device="cpu", pretrained_backbone_weights=None), tmp_path / "run", algorithm=algorithm
    )
    run.validate()
    assert make_policy(run.policy, env_cfg=run.env).config.env_state_feature is not None


def test_help_teaches(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["cronos-train", "--help"])
    with pytest.raises(SystemExit):
        script.main()
    text = " ".join(capsys.readouterr().out.split())
    for taught in (
        "--protocol.scene_reset_interval [int]",
        "control steps of one stream between two scene resets",
        "--algorithm.policy_lr float",
        "Interaction steps between two evaluations",
    ):
        assert taught in text
