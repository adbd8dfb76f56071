"""The flow head under PPO, with values that are the policy's own."""

import math

import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from pocketvla_samples import make_batch, make_policy, take
from test_pocketvla_flow import make_flow, make_noise

from cronos_lerobot.agents.adapters.pocketvla import PocketVLAFlowAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions, make_steerable, make_trainable
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.processing import make_processors

OBSERVED = {
    "state": {},
    "joints": {"joints": [0, 1, 2, 3, 4, 5, -1]},
    "pixels": {"image": True, "freeze_encoder": False},
    "privileged": {"image": True, "critic_observation": "environment_state"},
    "frozen": {"image": True},
}


def make_adapter(level=0.5, repeat=False, **options):
    noise = AdapterOptions(noise_level=level, noise_std=0.3, noise_repeat=repeat)
    return make_trainable(make_flow(dtype="float32", **options), noise)


def generator(seed):
    return torch.Generator().manual_seed(seed)


def test_tokens_need_no_adapter():
    tokens = make_policy(image=False)
    assert make_trainable(tokens, AdapterOptions()) is tokens
    assert isinstance(make_adapter(), PocketVLAFlowAdapter)
    assert isinstance(make_steerable(make_flow()), PocketVLAFlowAdapter)
    with pytest.raises(ValueError, match=r"--policy\.head=gaussian makes no actions of noise"):
        make_steerable(tokens)


@torch.no_grad()
@pytest.mark.parametrize("options", [{"temperature": 0.0}, {"level": 0.0}])
@pytest.mark.parametrize("observed", ["state", "joints", "pixels"])
def test_without_noise_it_acts_as_select_action_does(observed, options):
    adapter, batch, noise = (
        make_adapter(options.get("level", 0.5), **OBSERVED[observed]),
        make_batch(3),
        make_noise(3),
    )
    sample = adapter.sample_actions(batch, temperature=options.get("temperature", 1.0), noise=noise)
    assert adapter.decision_steps == 2
    played = torch.stack([adapter.policy.select_action(batch, noise=noise) for _ in range(2)], 1)
    assert torch.equal(sample["actions"], played)
    context, _ = adapter.observe(batch)
    assert torch.equal(adapter.denoise(context, noise), played)


@pytest.mark.parametrize("temperature", [0.6, 1.0])
@pytest.mark.parametrize("options", OBSERVED.values(), ids=OBSERVED)
def test_the_ratio_is_one_before_the_first_step(options, temperature):
    adapter, batch = make_adapter(**options), make_batch(12)
    if adapter.encode_observation is not None:
        batch = adapter.encode_observation(batch)
        assert not [key for key in batch if "images" in key]
    with torch.inference_mode():
        sample = adapter.sample_actions(batch, temperature=temperature, generator=generator(2))
        again = adapter.sample_actions(batch, temperature=temperature, generator=generator(2))
    assert torch.equal(sample["trace"], again["trace"])
    assert sample["trace"].shape == (12, 5, 4, 7)
    assert sample["log_prob"].shape == (12, 4)
    # Minibatches are other mixtures of the samples than the rollout's batches were.
    rows = [5, 0, 11, 7]
    got = adapter.evaluate_actions(take(batch, rows), sample["trace"][rows], temperature=temperature)
    log_ratio = got["log_prob"] - sample["log_prob"][rows]
    torch.testing.assert_close(log_ratio, torch.zeros_like(log_ratio), atol=1e-4, rtol=0)
    torch.testing.assert_close(got["value"], sample["value"][rows], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(adapter.predict_values(batch), sample["value"], rtol=1e-4, atol=1e-5)
    assert sample["value"].std() > 0


def test_repeated_noise_moves_the_whole_chunk_and_is_judged_by_its_mean():
    adapter, batch, noise = make_adapter(repeat=True), make_batch(5), make_noise(5)
    context, _ = adapter.observe(batch)
    own = adapter.denoise(context, noise)
    sample = adapter.sample_actions(batch, temperature=0.5, noise=noise, generator=generator(4))
    shift = sample["actions"] - own
    assert shift.abs().max() > 0.1
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift))
    # Seven independent normal numbers of deviation 0.5 * 0.3, around the mean of the two actions that are played.
    expected = -0.5 * (shift[:, 0] / 0.15).square() - math.log(0.15 * math.sqrt(2 * math.pi))
    assert sample["log_prob"].shape == (5, 1)
    torch.testing.assert_close(sample["log_prob"][:, 0], expected.sum(-1), atol=1e-3, rtol=1e-4)
    got = adapter.evaluate_actions(batch, sample["trace"], temperature=0.5)["log_prob"]
    torch.testing.assert_close(got, sample["log_prob"], atol=1e-3, rtol=1e-4)
    # Of another policy the same mean is as likely as it is near that policy's.
    with torch.no_grad():
        adapter.policy.head.out.bias += 0.1
    moved = adapter.denoise(context, noise).mean(1)
    expected = -0.5 * ((sample["actions"].mean(1) - moved) / 0.15).square() - math.log(
        0.15 * math.sqrt(2 * math.pi)
    )
    got = adapter.evaluate_actions(batch, sample["trace"], temperature=0.5)["log_prob"]
    torch.testing.assert_close(got[:, 0], expected.sum(-1), atol=1e-3, rtol=1e-4)
    calm = adapter.sample_actions(batch, temperature=0.0, noise=noise)
    assert torch.equal(calm["actions"], adapter.denoise(context, noise))
    assert (calm["log_prob"] == 0).all()


@pytest.mark.parametrize("repeat", [False, True])
@pytest.mark.parametrize("options", OBSERVED.values(), ids=OBSERVED)
def test_each_loss_trains_its_own(options, repeat):
    adapter, batch = make_adapter(repeat=repeat, **options), make_batch(4)
    PPO(
        adapter,
        make_processors(adapter.policy, *make_pre_post_processors(adapter.config)),
        PPOConfig(),
        np.random.default_rng(0),
    )
    trace = adapter.sample_actions(batch, generator=generator(3))["trace"]
    groups = {group["name"]: {id(p) for p in group["params"]} for group in adapter.rl_parameter_groups()}
    assert not groups["policy"] & groups["value"]
    frozen = {id(p) for name, p in adapter.policy.named_parameters() if name.startswith("encoder")}
    everything = {id(p) for p in adapter.parameters()}
    assert groups["policy"] | groups["value"] == everything - (
        frozen if options.get("freeze_encoder", True) else set()
    )
    for name, loss in (("log_prob", "policy"), ("value", "value")):
        adapter.zero_grad()
        adapter.evaluate_actions(batch, trace)[name].sum().backward()
        moved = {id(p) for p in adapter.parameters() if p.grad is not None and p.grad.abs().sum() > 0}
        assert moved
        assert moved <= groups[loss]
