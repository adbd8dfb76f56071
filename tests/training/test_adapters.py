"""LeRobot's own policies trained by PPO on the real scene."""

import pytest
import torch
from test_cronos_train import cronos_train
from test_imitation import ACT
from test_trainer import assert_same_run, metrics, weights

FLAGS = (
    *(flag for flag in ACT if not flag.startswith(("--algorithm.", "--policy.n_action_steps"))),
    "--policy.n_action_steps=5", "--algorithm.type=ppo", "--algorithm.value_warmup_updates=0",
    "--algorithm.ratio=factor", "--algorithm.minibatch_size=8",
)  # fmt: skip


def test_act_learns_in_chunks_saves_resumes_and_is_a_lerobot_policy(tmp_path, monkeypatch):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    cronos_train(monkeypatch, *FLAGS, "--steps=160", f"--output_dir={whole}")
    cronos_train(monkeypatch, *FLAGS, "--steps=80", f"--output_dir={broken}")
    before = weights(broken)
    last = broken / "checkpoints/last/pretrained_model"
    cronos_train(monkeypatch, "--resume=true", f"--config_path={last}/train_config.json", "--steps=160")
    assert_same_run(whole, broken)
    assert any(not torch.equal(tensor, before[name]) for name, tensor in weights(whole).items())
    updates = [line["agent"] for line in metrics(whole) if line["kind"] == "update"]
    assert len(updates) == 2
    assert all(update["policy_grad_norm"] > 0 for update in updates)

    from lerobot.policies.act.modeling_act import ACTPolicy

    policy = ACTPolicy.from_pretrained(whole / "checkpoints/last/pretrained_model")
    assert not [name for name in policy.state_dict() if "critic" in name or "log_std" in name]
    shapes = {name: feature.shape for name, feature in policy.config.input_features.items()}
    assert policy.select_action({name: torch.zeros(2, *shape) for name, shape in shapes.items()}).shape == (2, 7)


def test_chunks_that_reach_beyond_a_switch_are_refused(tmp_path, monkeypatch):
    flags = [flag.replace("n_action_steps=5", "n_action_steps=3") for flag in FLAGS]
    with pytest.raises(SystemExit, match=r"3 actions at once.*Choose --policy\.n_action_steps from \[1, 2, 5\]"):
        cronos_train(monkeypatch, *flags, "--steps=80", f"--output_dir={tmp_path / 'run'}")
