"""ACT as a policy that PPO can train, against LeRobot's own ACT."""

import math

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

from cronos_lerobot.agents.adapters.act import ACTAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions, make_trainable

STEPS, DIMS = 4, 3


def make_act(**options):
    torch.manual_seed(0)
    features = {"observation.state": (5,), "observation.environment_state": (6,)}
    config = ACTConfig(
        input_features={
            name: PolicyFeature(FeatureType.ENV if "env" in name else FeatureType.STATE, shape)
            for name, shape in features.items()
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (DIMS,))},
        chunk_size=6, n_action_steps=STEPS, dim_model=16, n_heads=2, dim_feedforward=16, n_encoder_layers=1,
        n_vae_encoder_layers=1, device="cpu", push_to_hub=False, **options,
    )  # fmt: skip
    return ACTPolicy(config).eval()


def make_batch(n=3):
    generator = torch.Generator().manual_seed(1)
    shapes = {"observation.state": (n, 5), "observation.environment_state": (n, 6)}
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}


@pytest.fixture
def adapter():
    return make_trainable(make_act(), AdapterOptions(noise_std=0.2))


def test_noise_that_was_driven_beyond_its_range_comes_back(adapter):
    with torch.no_grad():
        adapter.log_std.copy_(torch.full_like(adapter.log_std, -7.0))
    trace = adapter.sample_actions(make_batch())["trace"]
    optimizer = torch.optim.SGD([adapter.log_std], lr=1e-3)
    # Far from what the policy would do: the noise should have been larger.
    (-adapter.evaluate_actions(make_batch(), trace + 1)["log_prob"].mean()).backward()
    optimizer.step()
    assert (adapter._std > 1.01 * math.exp(-5)).all()


def test_without_noise_it_acts_as_lerobots_select_action(adapter):
    assert isinstance(adapter, ACTAdapter)
    assert adapter.decision_steps == STEPS
    batch = make_batch()
    with torch.no_grad():
        actions = adapter.sample_actions(batch, temperature=0)["actions"]
    adapter.policy.reset()
    played = torch.stack([adapter.policy.select_action(dict(batch)) for _ in range(STEPS)], 1)
    assert torch.equal(actions, played)


@pytest.mark.parametrize("temperature", [0.6, 1.0])
def test_likelihoods_are_those_of_the_draw(adapter, temperature):
    batch = make_batch()
    with torch.no_grad():
        own = adapter.sample_actions(batch, temperature=0)["actions"]
        sample = adapter.sample_actions(batch, temperature=temperature, generator=torch.Generator().manual_seed(2))
        again = adapter.evaluate_actions(batch, sample["trace"], temperature=temperature)
    noise = torch.randn(3, STEPS, DIMS, generator=torch.Generator().manual_seed(2))
    std = 0.2 * temperature
    torch.testing.assert_close(sample["actions"], own + std * noise)
    # The density of a normal distribution at z deviations, three dimensions an action.
    expected = (-0.5 * noise**2).sum(-1) - DIMS * math.log(std * math.sqrt(2 * math.pi))
    torch.testing.assert_close(sample["log_prob"], expected, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(again["log_prob"], sample["log_prob"], atol=1e-4, rtol=0)
    torch.testing.assert_close(again["entropy"], torch.full((3,), math.log(std * math.sqrt(2 * math.pi * math.e))))
    torch.testing.assert_close(again["value"], sample["value"])


def test_the_value_does_not_train_act_and_the_latents_encoder_is_left_alone(adapter):
    batch = make_batch()
    torch.nn.init.normal_(adapter.critic.layers[-1].weight)
    adapter.predict_values(batch).sum().backward()
    assert all(p.grad is None for p in adapter.policy.parameters())
    with torch.no_grad():
        torch.testing.assert_close(
            adapter.predict_values(adapter.value_inputs(batch)), adapter.predict_values(batch)
        )
    groups = {group["name"]: {id(p) for p in group["params"]} for group in adapter.rl_parameter_groups()}
    assert not groups["policy"] & groups["value"]
    unused = {id(p) for name, p in adapter.policy.named_parameters() if ".vae_encoder" in name}
    assert unused
    assert not unused & (groups["policy"] | groups["value"])
    everything = {id(p) for p in adapter.parameters()}
    assert groups["policy"] | groups["value"] | unused == everything
