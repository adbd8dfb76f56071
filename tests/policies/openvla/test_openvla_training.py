"""`lerobot-train`, `cronos-train` and `lerobot-eval` with a tiny OpenVLA, as a user would call them."""

import json
import sys
from pathlib import Path

import pytest
import torch
from forked_commands import run_forked
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot_env_cronos import CronosEnvConfig
from lerobot_policy_openvla import OpenVLAPolicy
from openvla_samples import CAMERA, TASKS, make_batch, make_config
from peft import PeftModel
from safetensors.torch import load_file

from cronos_lerobot.scripts import train as cronos_script

SMALL_LOOP = (
    "--env.type=cronos", "--env.observation_height=64", "--env.observation_width=64", "--num_envs=2",
    "--protocol.task_switch_interval=2", "--protocol.update_interval=4", "--protocol.scene_reset_interval=4",
    "--save_freq=8", "--eval_freq=0", "--tensorboard=false", "--policy.push_to_hub=false",
    "--algorithm.minibatch_size=2", "--algorithm.grad_accumulation=2", "--algorithm.entropy_coef=0.1",
)  # fmt: skip
PRESET = Path(__file__).parents[3] / "policies/lerobot_policy_openvla/presets/cronos_paper.yaml"


def cronos_train(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-train", *map(str, arguments)])
    cronos_script.main()


def updates_of(folder: Path) -> list[dict]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["kind"] == "update"]


@pytest.fixture(scope="module")
def cloned(published, demonstrations, tmp_path_factory) -> Path:
    """What `lerobot-train` with LeRobot's PEFT options leaves."""
    output = tmp_path_factory.mktemp("openvla") / "clone"
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_train", "--policy.type=openvla"),
        *(
            f"--policy.checkpoint={published}",
            "--policy.unnorm_key=bridge_orig",
            "--peft.r=4",
            "--peft.method_type=LORA",
            "--policy.device=cpu",
        ),
        *("--dataset.repo_id=local/openvla", f"--dataset.root={demonstrations}", f"--output_dir={output}"),
        *("--policy.push_to_hub=false", "--num_workers=0", "--batch_size=4", "--steps=3", "--log_freq=1"),
        *("--save_checkpoint=true", "--wandb.enable=false", "--env_eval_freq=0"),
    ]
    done = run_forked(command)
    assert done.returncode == 0, done.stderr[-4000:]
    assert "step:3" in done.stderr + done.stdout
    return output / "checkpoints" / "last" / "pretrained_model"


def test_what_lerobot_train_leaves(cloned, published):
    """A PEFT adapter, which LeRobot's own factory and this policy load to the same."""
    assert not (cloned / "model.safetensors").exists()
    config = PreTrainedConfig.from_pretrained(cloned)
    config.pretrained_path = cloned
    assert config.use_peft
    wrapped = make_policy(config, env_cfg=CronosEnvConfig(observation_height=48, observation_width=40))
    assert isinstance(wrapped, PeftModel)
    own = OpenVLAPolicy.from_pretrained(cloned)
    assert isinstance(own, OpenVLAPolicy)
    batch = make_batch(2)
    tokens = own.sample_actions(batch)["trace"]
    with torch.no_grad():
        expected = own.evaluate_actions(batch, tokens)["log_prob"]
        torch.testing.assert_close(wrapped.eval().evaluate_actions(batch, tokens)["log_prob"], expected)
        fresh = OpenVLAPolicy.from_pretrained(published, config=make_config(published))
        assert (fresh.evaluate_actions(batch, tokens)["log_prob"] - expected).abs().max() > 1e-3
    preprocessor, postprocessor = make_pre_post_processors(config, pretrained_path=str(cloned))
    action = postprocessor(
        own.select_action(preprocessor({CAMERA: torch.rand(2, 3, 48, 40), "task": list(TASKS)}))
    )
    assert action.shape == (2, 7)
    assert (action[:, :6].abs() < 0.21).all()


def train_twice(monkeypatch, tmp_path, *start):
    """A run of 16 steps, and one of 8 that is resumed to 16: its folder, and the last policy of the other."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    cronos_train(monkeypatch, *start, "--steps=16", f"--output_dir={whole}")
    cronos_train(monkeypatch, *start, "--steps=8", f"--output_dir={broken}")
    last = broken / "checkpoints/last/pretrained_model"
    cronos_train(monkeypatch, "--resume=true", f"--config_path={last}/train_config.json", "--steps=16")
    return whole, last


def test_clone_then_train_kill_resume(cloned, tmp_path, monkeypatch):
    """PPO goes on with the cloned adapter; a resumed run ends with the same weights to the bit."""
    start = (f"--policy.path={cloned}", "--policy.use_peft=false", "--algorithm.type=ppo_paper", *SMALL_LOOP)
    # Weight decay would move what has no gradient.
    whole, last = train_twice(monkeypatch, tmp_path, *start, "--algorithm.weight_decay=0")
    after = load_file(whole / "checkpoints/last/pretrained_model/model.safetensors")
    assert all(".lora_" in name or name.startswith("value_head.") for name in after)
    for name, tensor in load_file(last / "model.safetensors").items():
        assert torch.equal(tensor, after[name]), name
    before = load_file(tmp_path / "broken/checkpoints/000008/pretrained_model/model.safetensors")
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    # No reward so early: the value head, which says 0, is right.
    assert changed == {"network"}
    policy = OpenVLAPolicy.from_pretrained(whole / "checkpoints/last/pretrained_model")
    assert torch.equal(policy.state_dict()["value_head.layers.4.bias"], after["value_head.layers.4.bias"])


def test_the_papers_preset(published, tmp_path, monkeypatch):
    """The file's flags reach the run; a frozen vision tower's features are kept, and the ratio starts at 1."""
    output = tmp_path / "run"
    small = [flag for flag in SMALL_LOOP if not flag.startswith("--env.type")]
    cronos_train(
        monkeypatch, f"--config_path={PRESET}", f"--policy.checkpoint={published}", "--policy.device=cpu",
        "--policy.lora_rank=4", "--policy.lora_modules=[language]", "--policy.dtype=float32",
        "--algorithm.grad_accumulation=4", "--steps=8", f"--output_dir={output}", "--env.type=cronos",
        "--algorithm.type=ppo_paper", "--policy.type=openvla",
        *[flag for flag in small if "grad_accumulation" not in flag],
    )  # fmt: skip
    (line,) = updates_of(output)
    update = line["agent"]
    # All four minibatches are of the one optimizer step, so the policy is still the one that acted.
    assert update["ratio_max"] == pytest.approx(1.0, abs=1e-4)
    assert update["approx_kl"] < 1e-6
    assert update["clip_fraction"] == 0.0
    config = json.loads((output / "checkpoints/last/pretrained_model/train_config.json").read_text())
    assert config["protocol"]["end_effector_reset"] is True
    assert config["policy"]["unnorm_key"] == "bridge_orig"
