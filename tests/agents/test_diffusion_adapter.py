"""LeRobot's Diffusion as a policy that PPO can train, against LeRobot's own and diffusers' scheduler."""

import math

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

from cronos_lerobot.agents.adapters.diffusion import DiffusionAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions, Steerable, make_trainable

STEPS, DIMS, HORIZON, CHAIN = 2, 3, 4, 5
TIMES = (80, 60, 40, 20, 0)
"""Of five steps of a hundred."""


def make_diffusion(n_obs_steps=1, images=False, **options):
    torch.manual_seed(0)
    features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (6,)),
    }
    if images:
        features["observation.images.front"] = PolicyFeature(FeatureType.VISUAL, (3, 32, 32))
    options = {"noise_scheduler_type": "DDIM", "num_inference_steps": CHAIN} | options
    config = DiffusionConfig(
        input_features=features, output_features={"action": PolicyFeature(FeatureType.ACTION, (DIMS,))},
        n_obs_steps=n_obs_steps, horizon=HORIZON, n_action_steps=STEPS, drop_n_last_frames=1, down_dims=(8, 16),
        n_groups=4, diffusion_step_embed_dim=8, pretrained_backbone_weights=None, use_group_norm=True,
        spatial_softmax_num_keypoints=4, device="cpu", push_to_hub=False, **options,
    )  # fmt: skip
    return DiffusionPolicy(config).eval()


def make_batch(policy, n=3, history=()):
    """As the agent has it: (n, ...), with a history (n, n_obs_steps, ...)."""
    generator = torch.Generator().manual_seed(1)
    shapes = {name: feature.shape for name, feature in policy.config.input_features.items()}
    return {name: torch.rand(n, *history, *shape, generator=generator) for name, shape in shapes.items()}


@pytest.fixture
def adapter():
    return make_trainable(make_diffusion(), AdapterOptions(noise_std=0.2, noise_level=1.0))


@torch.no_grad()
@pytest.mark.parametrize(("n_obs_steps", "images"), [(1, False), (1, True), (2, False), (2, True)])
def test_without_noise_it_acts_as_lerobots_select_action(n_obs_steps, images):
    adapter = make_trainable(make_diffusion(n_obs_steps, images), AdapterOptions())
    assert isinstance(adapter, DiffusionAdapter)
    assert isinstance(adapter, Steerable)
    assert adapter.decision_steps == STEPS
    policy = adapter.policy
    seen = make_batch(policy, history=(n_obs_steps,))
    noise = torch.randn(3, HORIZON, DIMS, generator=torch.Generator().manual_seed(2))
    batch = seen if n_obs_steps > 1 else {name: value[:, 0] for name, value in seen.items()}
    sample = adapter.sample_actions(batch, temperature=0, noise=noise)
    policy.reset()
    for t in range(n_obs_steps):
        policy._queues["action"].clear()
        first = policy.select_action({name: value[:, t] for name, value in seen.items()}, noise=noise)
    assert torch.equal(sample["actions"], torch.stack([first, policy.select_action(batch)], 1))
    assert torch.equal(sample["log_prob"], torch.zeros(3, CHAIN))
    assert torch.equal(adapter.denoise(adapter.observe(batch)[0], noise), sample["actions"])


def alpha(t):
    """The part of the signal's variance that is left after t + 1 steps of noise (Nichol and Dhariwal, 2021)."""
    return (
        math.cos((t / 100 + 0.01 + 0.008) / 1.008 * math.pi / 2) ** 2 / math.cos(0.008 / 1.008 * math.pi / 2) ** 2
    )


def deviations(eta, floor):
    """Equation 16 of DDIM (Song et al., 2020), and DPPO's floor."""
    before = [*(alpha(t) for t in TIMES[1:]), 1.0]
    steps = [(alpha(t), following) for t, following in zip(TIMES, before, strict=True)]
    return [max(eta * math.sqrt((1 - b) / (1 - a) * (1 - a / b)), floor) for a, b in steps]


@torch.no_grad()
@pytest.mark.parametrize("prediction", ["epsilon", "sample"])
@pytest.mark.parametrize("eta", [0.5, 1.0])
def test_a_step_is_that_of_the_scheduler(prediction, eta):
    adapter = make_trainable(
        make_diffusion(prediction_type=prediction), AdapterOptions(noise_std=1e-9, noise_level=eta)
    )
    model = adapter.policy.diffusion
    given = adapter.observe(make_batch(adapter.policy))[0]
    step = adapter.step(given, 1.0)
    assert model.noise_scheduler.timesteps.tolist() == list(TIMES)
    assert [float(step(k, torch.zeros(3, HORIZON, DIMS))[1]) for k in range(CHAIN)] == pytest.approx(
        deviations(eta, 1e-9), rel=1e-4
    )
    for k, t in enumerate(TIMES):
        x, z = torch.randn(2, 3, HORIZON, DIMS, generator=torch.Generator().manual_seed(k)).unbind()
        mean, std = step(k, x)
        output = model.unet(x, torch.full((3,), t), global_cond=given)
        own = model.noise_scheduler.step(output, t, x, eta=eta, variance_noise=z).prev_sample
        torch.testing.assert_close(mean + std * z, own, atol=1e-6, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("temperature", [0.6, 1.0])
def test_likelihoods_are_those_of_the_draw(adapter, temperature):
    batch = make_batch(adapter.policy)
    sample = adapter.sample_actions(batch, temperature=temperature, generator=torch.Generator().manual_seed(2))
    again = adapter.evaluate_actions(batch, sample["trace"], temperature=temperature)
    assert sample["trace"].shape == (3, CHAIN + 1, HORIZON, DIMS)
    assert torch.equal(sample["actions"], sample["trace"][:, -1, :STEPS])
    generator = torch.Generator().manual_seed(2)
    _, *noise = (torch.randn(3, HORIZON, DIMS, generator=generator) for _ in range(CHAIN + 1))
    stds = deviations(temperature, temperature * 0.2)
    assert stds[0] > 0.4 * temperature
    assert stds[-1] == 0.2 * temperature
    # The density of a normal distribution at z deviations, of the dimensions that are played.
    expected = [
        (-0.5 * z[:, :STEPS] ** 2).sum((1, 2)) - STEPS * DIMS * math.log(std * math.sqrt(2 * math.pi))
        for z, std in zip(noise, stds, strict=True)
    ]
    torch.testing.assert_close(sample["log_prob"], torch.stack(expected, 1), atol=1e-3, rtol=0)
    torch.testing.assert_close(again["log_prob"], sample["log_prob"], atol=1e-4, rtol=0)
    torch.testing.assert_close(again["value"], sample["value"])
    assert again["entropy"] is None


def test_the_value_does_not_train_the_policy(adapter):
    batch = make_batch(adapter.policy)
    torch.nn.init.normal_(adapter.critic.layers[-1].weight)
    adapter.evaluate_actions(batch, torch.zeros(3, CHAIN + 1, HORIZON, DIMS))["value"].sum().backward()
    assert all(p.grad is None for p in adapter.policy.parameters())
    with torch.no_grad():
        values = adapter.predict_values(batch)
        torch.testing.assert_close(adapter.predict_values(adapter.value_inputs(batch)), values)
    assert values.unique().numel() == 3
    policy, value = (group["params"] for group in adapter.rl_parameter_groups())
    assert {id(p) for p in policy} == {id(p) for p in adapter.policy.parameters()}
    assert {id(p) for p in value} == {id(p) for p in adapter.critic.parameters()}
    assert set(adapter.own_parameters()) == {f"critic.{name}" for name, _ in adapter.critic.named_parameters()}


def test_what_cannot_be_trained_is_told_what_can():
    with pytest.raises(ValueError, match=r"=DDPM denoises in 100 steps: .*--policy\.noise_scheduler_type=DDIM"):
        make_trainable(make_diffusion(noise_scheduler_type="DDPM", num_inference_steps=None), AdapterOptions())
