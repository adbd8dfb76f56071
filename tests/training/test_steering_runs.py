"""Whole runs of the steering agent, on the dummies."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicyConfig
from forked_processes import together
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.default import PeftConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from runs import (
    STEPS_PER_UPDATE,
    MortalEnv,
    assert_same_run,
    config,
    metrics,
    plain,
    resumed,
    train_share,
    weights,
)
from safetensors.torch import load_file

from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.agents.steering.steered import STEERING, SteeredPolicy, with_steering


@PreTrainedConfig.register_subclass("dummy_noise")
@dataclass
class NoiseConfig(DummyPolicyConfig):
    """Plays two of three actions."""

    n_action_steps: int = 2

    def __post_init__(self):
        super().__post_init__()
        self.input_features = {"observation.state": PolicyFeature(FeatureType.STATE, (13,))}


class NoisePolicy(PreTrainedPolicy):
    """Its actions are the noise, times its weight: it goes nowhere in particular."""

    config_class, name = NoiseConfig, "dummy_noise"
    decision_steps, shape = 2, (3, 7)

    def __init__(self, config=None, seed=0, **kwargs):
        super().__init__(config or NoiseConfig())
        self.weight = torch.nn.Parameter(torch.tensor(1.0 + seed))

    def observe(self, batch):
        return None, batch["observation.state"]

    def denoise(self, context, noise):
        return (self.weight * noise[:, :2]).clamp(-1, 1)

    def predict_action_chunk(self, batch, **kwargs):
        return self.denoise(None, torch.randn(len(batch["observation.state"]), 3, 7))

    def select_action(self, batch, **kwargs):
        return self.predict_action_chunk(batch)[:, 0]

    def reset(self):
        pass

    forward = get_optim_params = None


def settings(folder, resumes=False, **options):
    own = {
        "hidden_width": 32,
        "batch_size": 32,
        "warmup_decisions": 30,
        "observation": "state",
        "lr": 3e-3,
        "utd": 1,
    }
    algorithm = SteeringConfig(**own | options.pop("algorithm", {}))
    defaults = {"policy": NoiseConfig(), "algorithm": algorithm, "steps": 6 * STEPS_PER_UPDATE, "eval_freq": 0}
    return (resumed if resumes else config)(folder, **defaults | options)


def train(cfg, *options):
    return train_share(cfg, NoisePolicy(seed=8 if cfg.checkpoint_path else 0), *options)


def assert_same_actor(a, b):
    """The one that lies beside the policy."""
    file = f"checkpoints/last/pretrained_model/{STEERING}"
    assert plain(load_file(a / file)) == plain(load_file(b / file))


@pytest.mark.parametrize("memory_size", [1000, 40])
def test_a_resumed_run_equals_the_unbroken_one(tmp_path, memory_size):
    """Also where the memory has begun to forget before the kill: two updates are 32 decisions."""
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    options = {"algorithm": {"memory_size": memory_size}}
    trainer = train(settings(unbroken, **options))
    updates = [line["agent"] for line in metrics(unbroken, "update")]
    # Four streams decide four times in eight steps; the first 16 decisions are too few to learn from.
    assert [line["decisions"] for line in updates] == [min(memory_size, 16.0 * (i + 1)) for i in range(6)]
    assert [line["optimizer_steps"] for line in updates] == [0.0, *[16.0] * 5]
    assert trainer.run.agent.num_steps == 80
    assert train(settings(broken, **options), MortalEnv) is None
    torch.manual_seed(999)
    train(settings(broken, resumes=True, **options))
    assert_same_run(unbroken, broken)
    assert_same_actor(unbroken, broken)
    # Frozen.
    assert weights(unbroken)["weight"].item() == 1.0


def in_processes(ranks, cfg, env_class=DummyEnv):
    trainer = train(cfg, env_class, ranks)
    if trainer is None:
        return None
    return [param.sum().item() for param in trainer.run.agent.sac.parameters()], len(trainer.run.agent.memory)


def test_two_processes_learn_together_and_resume(tmp_path):
    first, second = together(in_processes, settings(tmp_path / "unbroken"))
    assert first == second
    assert first[1] == 6 * 16 / 2
    last = metrics(tmp_path / "unbroken", "update")[-1]["agent"]
    assert (last["decisions"], last["optimizer_steps"]) == (96.0, 16.0)
    assert together(in_processes, settings(tmp_path / "broken"), MortalEnv) == [None, None]
    assert together(in_processes, settings(tmp_path / "broken", resumes=True)) == [first, second]
    assert_same_run(tmp_path / "unbroken", tmp_path / "broken")


def test_adapters_that_it_would_not_train_are_refused(tmp_path):
    with pytest.raises(ValueError, match="--peft"):
        train(settings(tmp_path, peft=PeftConfig()))


def test_what_is_evaluated_and_saved_is_steered_once_it_has_learned(tmp_path, monkeypatch, caplog):
    asked, sample = [], SteeredPolicy.sample_actions
    monkeypatch.setattr(
        SteeredPolicy, "sample_actions", lambda *args, **kw: asked.append(1) or sample(*args, **kw)
    )
    cfg = settings(tmp_path / "run", steps=3 * STEPS_PER_UPDATE, eval_freq=STEPS_PER_UPDATE, keep_checkpoints=None)
    trainer = train(cfg)
    evaluations = metrics(tmp_path / "run", "evaluation")
    assert len(evaluations) == 4
    # Those at the start and after the first update, which was too early to learn, ask the policy alone: twelve
    # episodes of 80 steps, five at a time. The others ask for two steps at a time.
    assert len(asked) >= 2 * 40
    frozen, early, *late = ({k: line[k] for k in ("success", "steps")} for line in evaluations)
    assert frozen == early
    assert frozen not in late
    folders = sorted((tmp_path / "run/checkpoints").glob("0*/pretrained_model"))
    # After the first update there is nothing to steer with.
    assert [folder.name for folder in folders if not (folder / STEERING).is_file()] == ["pretrained_model"]
    assert (
        with_steering(trainer.run.agent.policy, None)
        is with_steering(trainer.run.agent.policy, folders[0])
        is trainer.run.agent.policy
    )
    with caplog.at_level(logging.INFO):
        loaded = with_steering(NoisePolicy.from_pretrained(folders[-1]), folders[-1])
    assert "steering.safetensors chooses the policy's noise" in caplog.text
    assert isinstance(loaded, SteeredPolicy)
    batch = {"observation.state": torch.from_numpy(np.float32(np.random.default_rng(0).normal(size=(5, 13))))}
    batch["task"] = ["go to 1.0"] * 5
    for temperature in (0.0, 0.6):
        samples = [
            policy.sample_actions(batch, temperature=temperature, generator=torch.Generator().manual_seed(1))
            for policy in (loaded, trainer.run.agent.acting)
        ]
        assert torch.equal(*(sample["actions"] for sample in samples))
    (folders[-1] / STEERING).write_bytes(b"short")
    with pytest.raises(ValueError, match=r"steering\.safetensors is damaged"):
        with_steering(trainer.run.agent.policy, folders[-1])
