"""Whole runs of PPO that keep their successes: resumed, on two processes, and on the real scene."""

from unittest.mock import patch

import pytest
import torch
from dummies import DummyEnv
from forked_processes import together
from lerobot_env_cronos import CronosEnvConfig
from test_adapters import paid_for_moving  # noqa: F401
from test_cronos_train import OBSERVATIONS, cronos_train
from test_flow_head import TINY, TRAIN
from test_imitation import ClonedConfig, ClonedPolicy
from test_imitation import train as train_imitation
from test_trainer import STEPS_PER_UPDATE, MortalEnv, assert_same_run, config, metrics, weights
from tiny_checkpoints import STATE

from cronos_lerobot.agents.ppo.config import PPOConfig, SelfImitationConfig
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos


class EvenPolicy(ClonedPolicy):
    """Cloned as it acts, in `eval()` mode."""

    def forward(self, batch):
        assert not self.training
        bins = torch.distributions.Categorical(logits=self.actor(self._inputs(batch)).reshape(-1, 7, 3))
        return -bins.log_prob(batch["action"][:, 0] + 1).mean(), {}


def settings(folder, coef=0.5, **options):
    algorithm = PPOConfig(
        minibatch_size=16, policy_lr=1e-2, policy_lr_max=1.0, value_warmup_updates=1,
        self_imitation=SelfImitationConfig(coef=coef, batch_size=8, max_age=2, tail_steps=1),
    )  # fmt: skip
    defaults = {"policy": ClonedConfig(), "algorithm": algorithm, "steps": 6 * STEPS_PER_UPDATE, "eval_freq": 0}
    return config(folder, **defaults | options)


def updates(folder):
    return [line for line in metrics(folder) if line["kind"] == "update"]


def test_a_resumed_run_equals_the_unbroken_one(tmp_path, monkeypatch):
    monkeypatch.setattr("test_imitation.ClonedPolicy", EvenPolicy)
    unbroken, broken, without = tmp_path / "unbroken", tmp_path / "broken", tmp_path / "without"
    train_imitation(settings(unbroken))
    told = [line["agent"] for line in updates(unbroken)]
    kept = [agent["memory_segments"] for agent in told]
    # As many as succeeded without being found complete. An update does not see its own last segments yet, and
    # sees a segment for the last time two updates after the one that followed it.
    rollouts = [line["rollout"] for line in updates(unbroken)]
    won = [r["success"] * r["segments"] - r["found_complete"][0] for r in rollouts]
    for i, count in enumerate(kept):
        assert sum(won[max(0, i - 2) : i]) <= count <= sum(won[max(0, i - 3) : i + 1])
    assert won[1] >= 1  # in the memory of the checkpoint that the killed run goes on from
    assert min(kept[-3:]) < max(kept)  # some have gone
    assert all(0 <= agent["memory_age"] <= 2 for agent in told if agent["memory_segments"])
    # The value warms up in the first update.
    assert [("clone_loss" in agent) for agent in told] == [i > 0 and n > 0 for i, n in enumerate(kept)]
    assert train_imitation(settings(broken), MortalEnv) is None
    resumed = settings(broken)
    resumed.checkpoint_path = (broken / "checkpoints/last").resolve()
    torch.manual_seed(999)
    train_imitation(resumed, policy_seed=8)
    assert_same_run(unbroken, broken)
    train_imitation(settings(without, coef=0.0))
    assert not torch.equal(weights(without)["actor.weight"], weights(unbroken)["actor.weight"])


@patch("test_imitation.ClonedPolicy", EvenPolicy)
def in_processes(processes, cfg, env_class=DummyEnv):
    trainer = train_imitation(cfg, env_class, processes)
    if trainer is None:
        return None
    return trainer.policy.actor.weight.tolist(), len(trainer.agent.ppo.self_imitation.memory)


def test_two_processes_clone_their_own_and_resume(tmp_path):
    first, second = together(in_processes, settings(tmp_path / "unbroken"))
    assert first[0] == second[0]
    assert first[1] + second[1] >= 3
    assert together(in_processes, settings(tmp_path / "broken"), MortalEnv) == [None, None]
    resumed = settings(tmp_path / "broken")
    resumed.checkpoint_path = (tmp_path / "broken/checkpoints/last").resolve()
    assert together(in_processes, resumed) == [first, second]
    assert_same_run(tmp_path / "unbroken", tmp_path / "broken")


@pytest.mark.usefixtures("paid_for_moving")
def test_demonstrations_are_cloned_by_the_command(tmp_path, monkeypatch):
    """The flow head from scratch has no success in 20 steps: all that is cloned are demonstrations."""
    demos = DemoDatasetConfig("me/demos", tmp_path / "demos", 2)
    record_demos(RecordDemosConfig(env=CronosEnvConfig(**STATE), dataset=demos, num_envs=2))
    flags = (
        "--policy.type=pocketvla", "--policy.head=flow", *TINY, *OBSERVATIONS["state"],
        "--algorithm.self_imitation.coef=0.1", "--algorithm.self_imitation.batch_size=6",
        "--algorithm.demos_share=0.5", "--algorithm.demos.repo_id=me/demos",
        f"--algorithm.demos.root={tmp_path / 'demos'}",
    )  # fmt: skip
    cronos_train(monkeypatch, *flags, *TRAIN, "--steps=20", f"--output_dir={tmp_path / 'run'}")
    (told,) = [line["agent"] for line in updates(tmp_path / "run")]
    assert told["clone_grad_norm"] > 0
    assert told["memory_segments"] == 0
