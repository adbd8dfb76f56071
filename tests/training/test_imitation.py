"""Whole runs of the imitation agent: on the dummies, where it succeeds, and with ACT on the real scene."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicy, DummyPolicyConfig
from forked_processes import together
from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, MultiAdamConfig
from lerobot_env_cronos import CronosEnvConfig
from runs import (
    STEPS_PER_UPDATE,
    MortalEnv,
    assert_same_run,
    config,
    make_trainer,
    metrics,
    resumed,
    train_share,
    weights,
)
from test_cronos_train import moved, train_and_resume

from cronos_lerobot.agents.imitation.agent import ImitationAgent, copy_trained
from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos


@PreTrainedConfig.register_subclass("dummy_cloned")
@dataclass
class ClonedConfig(DummyPolicyConfig):
    """Learns from two actions at a time."""

    action_delta_indices = (0, 1)

    def get_optimizer_preset(self):
        return AdamWConfig(lr=1e-2, grad_clip_norm=1.0)


class ClonedPolicy(DummyPolicy):
    """A policy that samples, and can be cloned with dropout: its randomness is PyTorch's own."""

    config_class, name = ClonedConfig, "dummy_cloned"

    def __init__(self, seed=0):
        super().__init__(ClonedConfig(), seed)
        self.register_buffer("running_mean", torch.zeros(3))

    def forward(self, batch):
        assert self.training
        # As batch normalization does, of the process's own batch.
        self.running_mean += 0.1 * (self._inputs(batch).mean(0) - self.running_mean)
        inputs = torch.nn.functional.dropout(self._inputs(batch), 0.2)
        bins = torch.distributions.Categorical(logits=self.actor(inputs).reshape(-1, 7, 3))
        return -bins.log_prob(batch["action"][:, 0] + 1).mean(), {}

    def get_optim_params(self):
        return self.actor.parameters()


def settings(folder, resumes=False, **options):
    algorithm = ImitationConfig(steps_per_update=5, batch_size=8, warmup_segments=3, tail_steps=1)
    defaults = {"policy": ClonedConfig(), "algorithm": algorithm, "steps": 6 * STEPS_PER_UPDATE, "eval_freq": 0}
    return (resumed if resumes else config)(folder, **defaults | options)


def train(cfg, *options):
    return train_share(cfg, ClonedPolicy(8 if cfg.checkpoint_path else 0), *options)


def train_and_resume_dummies(folder, **options):
    """A run that is killed and resumed is the unbroken one, which is returned."""
    unbroken, broken = folder / "unbroken", folder / "broken"
    trainer = train(settings(unbroken, **options))
    assert train(settings(broken, **options), MortalEnv) is None
    torch.manual_seed(999)
    train(settings(broken, resumes=True, **options))
    assert_same_run(unbroken, broken)
    return trainer


def test_a_resumed_run_equals_the_unbroken_one_and_learns(tmp_path):
    trainer = train_and_resume_dummies(tmp_path)
    unbroken = tmp_path / "unbroken"
    updates = metrics(unbroken, "update")
    kept = [line["agent"]["segments"] for line in updates]
    assert kept == sorted(kept)
    assert kept[-1] >= 3
    # As many as succeeded without being found complete; an update does not see its own last segments yet.
    rollouts = [line["rollout"] for line in updates]
    won = np.cumsum([r["success"] * r["segments"] - r["found_complete"][0] for r in rollouts])
    assert len(trainer.run.agent.memory) == won[-1]
    assert all(low <= k <= high for low, k, high in zip([0, *won], kept, won, strict=False))
    assert won[1] >= 1  # in the memory of the checkpoint that the killed run goes on from
    # Below three segments there is no step, from there on five for each update.
    steps = [line["agent"]["optimizer_steps"] for line in updates]
    assert steps == [5.0 * (segments >= 3) for segments in kept]
    assert steps[0] == 0
    assert {len(segment) for segment in trainer.run.agent.memory.segments} <= {2, 3, 4}
    assert not torch.equal(weights(unbroken)["actor.weight"], ClonedPolicy().actor.weight)
    assert torch.equal(weights(unbroken)["critic.weight"], ClonedPolicy().critic.weight)


@pytest.mark.parametrize("weighting", ["return", "advantage"])
def test_a_weighted_run_keeps_what_failed_and_resumes(tmp_path, weighting):
    algorithm = ImitationConfig(
        steps_per_update=2, batch_size=8, warmup_segments=1, tail_steps=1, weighting=weighting
    )
    trainer = train_and_resume_dummies(tmp_path, algorithm=algorithm)
    updates = metrics(tmp_path / "unbroken", "update")
    rollouts = [line["rollout"] for line in updates]
    memory = trainer.run.agent.memory
    won = sum(segment.success for segment in memory.segments)
    assert won == sum(r["success"] * r["segments"] - r["found_complete"][0] for r in rollouts)
    failed = sum(r["segments"] - r["success"] * r["segments"] for r in rollouts)
    assert len(memory) - won == failed >= 1
    last = updates[-1]["agent"]
    assert 1 <= last["failed_segments"] <= failed
    assert 0 < last["effective_share"] < 1
    assert last["optimizer_steps"] == 2


def test_the_policy_may_be_an_average_of_what_is_trained_and_resumes(tmp_path, monkeypatch):
    trained, average = [], ImitationAgent._move_average

    def spy(agent):
        trained.append(agent._learner.actor.weight.detach().clone())
        average(agent)

    monkeypatch.setattr(ImitationAgent, "_move_average", spy)
    algorithm = ImitationConfig(steps_per_update=2, batch_size=8, warmup_segments=3, ema_decay=0.75)
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    train(settings(unbroken, algorithm=algorithm))
    expected = ClonedPolicy().actor.weight.detach()
    for weight in trained:
        expected = 0.75 * expected + 0.25 * weight
    assert len(trained) >= 4
    torch.testing.assert_close(weights(unbroken)["actor.weight"], expected)
    assert train(settings(broken, algorithm=algorithm), MortalEnv) is None
    torch.manual_seed(999)
    train(settings(broken, resumes=True, algorithm=algorithm))
    assert_same_run(unbroken, broken)


def test_an_average_costs_only_what_is_trained(tmp_path):
    """Of a large policy with a small adapter, that is little in memory and in the checkpoint."""
    policy = ClonedPolicy()
    policy.critic.requires_grad_(False)
    copied = copy_trained(policy)
    assert copied.critic.weight is policy.critic.weight
    assert copied.actor.weight is not policy.actor.weight
    algorithm = ImitationConfig(steps_per_update=2, batch_size=8, warmup_segments=3)
    trainer = make_trainer(settings(tmp_path, algorithm=algorithm), policy=policy)
    assert set(trainer.run.agent.state_dict()["learner"]) == {"actor.weight", "actor.bias", "running_mean"}


def in_processes(ranks, cfg, env_class=DummyEnv):
    trainer = train(cfg, env_class, ranks)
    if trainer is None:
        return None
    weights = [
        tensor.tolist()
        for tensor in (trainer.run.agent.policy.actor.weight, trainer.run.agent.policy.running_mean)
    ]
    return weights, len(trainer.run.agent.memory)


def test_two_processes_learn_together_and_resume(tmp_path):
    """Each from its own streams' successes, with the mean of their gradients."""
    first, second = together(in_processes, settings(tmp_path / "unbroken"))
    assert first[0] == second[0]
    assert np.any(first[0][1])
    last = metrics(tmp_path / "unbroken", "update")[-1]
    assert last["agent"]["optimizer_steps"] == 5
    assert last["agent"]["segments"] <= first[1] + second[1]
    assert together(in_processes, settings(tmp_path / "broken"), MortalEnv) == [None, None]
    assert together(in_processes, settings(tmp_path / "broken", resumes=True)) == [first, second]
    assert_same_run(tmp_path / "unbroken", tmp_path / "broken")


def update_once(ranks, cfg, segments, rank=0):
    """An update of which one process has all that is remembered."""
    mine = ranks.share_of(cfg.num_envs)
    agent = make_trainer(cfg, DummyEnv(mine.stop - mine.start), ClonedPolicy(), ranks).run.agent
    if ranks.rank == rank:
        agent.memory.load_state_dict(segments)
    torch.manual_seed(0)
    return agent.update(), agent.policy.actor.weight.tolist(), agent.policy.running_mean.tolist()


def test_a_process_without_a_success_takes_the_steps_of_the_others(tmp_path):
    cfg = settings(tmp_path / "run")
    segments = train(cfg).run.agent.memory.state_dict()
    cfg.output_dir = tmp_path / "other"
    alone, first = update_once(Ranks(), cfg, segments), together(update_once, cfg, segments)
    assert alone[0]["optimizer_steps"] == 5
    for update, *learned in first:
        # The loss and the gradient are of the one that has a batch, and not half of it.
        assert update == pytest.approx(alone[0], rel=1e-5)
        for found, expected in zip(learned, alone[1:], strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
    # The first process has none: what it has not seen is not what the others learned by.
    (update, *learned), other = together(update_once, cfg, segments, 1)
    assert update["optimizer_steps"] == 5
    assert learned == list(other[1:])
    assert np.abs(learned[1]).max() > 0


def weighted(folder, weighting, beta):
    algorithm = ImitationConfig(
        steps_per_update=5, batch_size=8, warmup_segments=3, tail_steps=1, weighting=weighting, weighting_beta=beta
    )
    return settings(folder, algorithm=algorithm)


def update_own(ranks, cfg, memories):
    return update_once(ranks, cfg, memories[ranks.rank], ranks.rank)


def remembered(folder):
    """Of a run, what succeeded and what failed."""
    segments = train(weighted(folder, "return", 0.2)).run.agent.memory.state_dict()
    parts = [[segment for segment in segments if segment["success"] is one] for one in (True, False)]
    assert min(map(len, parts)) >= 3
    return parts


def test_a_process_that_has_only_failed_clones_next_to_nothing_of_it(tmp_path):
    """Its largest return is not the largest: exp(-0.3 / 0.01) and less of a success's weight is its own."""
    won, lost = remembered(tmp_path / "run")
    for segment in won:
        segment["columns"]["next.reward"][-1] = 1
    for segment in lost:
        segment["columns"]["next.reward"][:] = 0
    cfg = replace(weighted(tmp_path / "run", "return", 0.01), output_dir=tmp_path / "other")
    alone = update_once(Ranks(), cfg, won)
    assert alone[0]["optimizer_steps"] == 5
    first, second = together(update_own, cfg, [won, lost])
    assert first[1:] == second[1:]
    assert first[0] == second[0]
    assert first[0]["failed_segments"] == len(lost)
    # The loss that is logged is the one that is learned from.
    assert first[0]["loss"] == pytest.approx(alone[0]["loss"], rel=1e-4)
    for found, expected in zip(first[1:], alone[1:], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("weighting", ["return", "advantage"])
def test_the_effective_share_is_that_of_one_process_with_all_of_it(tmp_path, weighting):
    won, lost = remembered(tmp_path / "run")
    cfg = replace(weighted(tmp_path / "run", weighting, 0.2), output_dir=tmp_path / "other")
    alone = update_once(Ranks(), cfg, [*won, *lost])[0]
    first, second = together(update_own, cfg, [won, lost])
    assert 0 < alone["effective_share"] < 1
    for found in (first[0], second[0]):
        assert found["effective_share"] == pytest.approx(alone["effective_share"])


OBSERVATIONS = {"obs_type": "environment_state_agent_pos", "task_observation": "one_hot"}
ACT = (
    "--policy.type=act", "--policy.device=cpu", "--policy.chunk_size=6", "--policy.n_action_steps=3",
    "--policy.dim_model=16", "--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.n_encoder_layers=1",
    "--policy.n_decoder_layers=1", "--policy.latent_dim=4", "--policy.n_vae_encoder_layers=1",
    "--env.type=cronos", *(f"--env.{name}={value}" for name, value in OBSERVATIONS.items()), "--num_envs=4",
    "--protocol.task_switch_interval=10", "--protocol.update_interval=20", "--protocol.scene_reset_interval=20",
    "--save_freq=80", "--eval_freq=0", "--tensorboard=false", "--algorithm.type=imitation",
    "--algorithm.demos_share=0.5", "--algorithm.demos.repo_id=me/demos",
    "--algorithm.steps_per_update=4", "--algorithm.batch_size=8",
)  # fmt: skip


def test_act_trains_saves_resumes_and_is_a_lerobot_policy(tmp_path, monkeypatch):
    """With demonstrations: a policy from scratch has no success in 160 steps."""
    env = CronosEnvConfig(**OBSERVATIONS)
    record_demos(
        RecordDemosConfig(env=env, dataset=DemoDatasetConfig("me/demos", tmp_path / "demos", 2), num_envs=2)
    )
    flags = (*ACT, f"--algorithm.demos.root={tmp_path / 'demos'}")
    first, folder = train_and_resume(monkeypatch, tmp_path / "run", *flags, "--steps=160")
    assert moved(first, folder)
    (agent,) = {json.dumps(sorted(line["agent"])) for line in metrics(tmp_path / "run")}
    assert json.loads(agent) == ["frames", "grad_norm", "loss", "optimizer_steps", "segments"]

    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    policy = ACTPolicy.from_pretrained(folder)
    preprocessor, postprocessor = make_pre_post_processors(policy.config, str(folder))
    shapes = {name: feature.shape for name, feature in policy.config.input_features.items()}
    batch = {name: torch.zeros(2, *shape) for name, shape in shapes.items()}
    assert postprocessor(policy.select_action(preprocessor(batch))).shape == (2, 7)


class TwoOptimizersConfig(ClonedConfig):
    """As LeRobot's gaussian_actor: an optimizer for each part."""

    def get_optimizer_preset(self):
        return MultiAdamConfig(lr=1e-2, optimizer_groups={"bias": {"lr": 1e-3}})


class TwoOptimizersPolicy(ClonedPolicy):
    config_class = TwoOptimizersConfig

    def get_optim_params(self):
        named = dict(self.actor.named_parameters())
        return {part: [p for name, p in named.items() if part in name] for part in ("weight", "bias")}


def test_every_optimizer_of_a_policy_learns_at_its_own_share_of_the_rate(tmp_path):
    policy = TwoOptimizersPolicy()
    policy.config = TwoOptimizersConfig()
    trainer = make_trainer(settings(tmp_path), policy=policy)
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in trainer.run.agent.optimizer.items()}
    assert rates == pytest.approx({"weight": 1e-3, "bias": 1e-4})
