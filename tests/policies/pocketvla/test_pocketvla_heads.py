"""The distributions over bins against independent numpy computations."""

import math

import numpy as np
import pytest
import torch
from lerobot_policy_pocketvla import discretised_normal as discretised_normal_module
from lerobot_policy_pocketvla.discretised_normal import discretised_normal
from lerobot_policy_pocketvla.heads import (
    BinDistribution,
    GaussianHead,
    actions_to_tokens,
    bin_centres,
    tokens_to_actions,
)


def gaussian_head(gripper_dim: int | None = None, sigma: float = 0.2, dims: int = 3) -> GaussianHead:
    """A head whose mean is exactly its input's (limited) value: the projection is the identity."""
    head = GaussianHead(
        dims, dims, 256, gripper_dim, sigma_init=sigma, sigma_min=0.01, sigma_max=0.9, gripper_logit_limit=5.0
    )
    with torch.no_grad():
        head.project.weight.copy_(torch.eye(dims))
    return head


def test_bin_centres_by_hand():
    torch.testing.assert_close(bin_centres(4), torch.tensor([-0.75, -0.25, 0.25, 0.75]))
    assert bin_centres(256)[0].item() == pytest.approx(-255 / 256)
    assert bin_centres(256)[255].item() == pytest.approx(255 / 256)


def test_actions_and_tokens_round_trip_to_half_a_bin():
    actions = torch.linspace(-1, 1, 5001)
    error = (tokens_to_actions(actions_to_tokens(actions, 256), 256) - actions).abs()
    assert error.max() <= 1 / 256 + 1e-6
    tokens = torch.arange(256)
    assert torch.equal(actions_to_tokens(tokens_to_actions(tokens, 256), 256), tokens)


@pytest.mark.parametrize("temperature", [1.0, 0.6])
@pytest.mark.parametrize("sigma", [0.05, 0.4])
def test_discretised_gaussian_is_the_normal_density_at_the_bin_centres(sigma, temperature):
    inputs = np.array([-1.1, 0.1, 0.9])
    logits = gaussian_head(sigma=sigma)(torch.from_numpy(inputs).float()[None])
    got = BinDistribution(logits).log_probs(temperature).exp()[0].detach().numpy()
    centres = np.linspace(-255 / 256, 255 / 256, 256)
    means = 1.25 * np.tanh(inputs / 1.25)
    # A power 1 / T of a normal density is a normal density with the variance multiplied by T.
    variance = sigma**2 * temperature
    density = np.exp(-((centres[None] - means[:, None]) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    np.testing.assert_allclose(got, density / density.sum(-1, keepdims=True), atol=2e-6)


def test_the_gripper_takes_only_its_outermost_bins_with_the_sigmoid_of_one_limited_logit():
    logits = gaussian_head(gripper_dim=-1)(torch.tensor([[0.0, 0.0, 1.5]]))
    probs = BinDistribution(logits).log_probs()[0, 2].exp()
    logit = 5 * math.tanh(1.5 / 5)
    assert probs[255].item() == pytest.approx(1 / (1 + math.exp(-logit)), abs=1e-6)
    assert probs[0].item() == pytest.approx(1 / (1 + math.exp(logit)), abs=1e-6)
    assert probs[1:255].sum().item() == 0.0
    # Halving the temperature doubles the logit.
    cold = BinDistribution(logits).log_probs(0.5)[0, 2, 255].exp().item()
    assert cold == pytest.approx(1 / (1 + math.exp(-2 * logit)), abs=1e-6)


def test_the_less_likely_gripper_command_stays_possible():
    """However sure the network is, the other command keeps the probability sigmoid(-5) = 0.67 %."""
    logits = gaussian_head(gripper_dim=-1)(torch.tensor([[0.0, 0.0, 1e4]]))
    assert BinDistribution(logits).log_probs()[0, 2, 0].exp().item() == pytest.approx(0.0066929, abs=1e-6)


def test_entropy_by_hand():
    uniform = BinDistribution(torch.zeros(2, 7, 256))
    torch.testing.assert_close(uniform.entropy(), torch.full((2,), math.log(256)))
    # One dimension uniform over 4 bins, one certain: the mean of log 4 and 0.
    logits = torch.zeros(1, 2, 4)
    logits[0, 1, 2] = 1000.0
    assert BinDistribution(logits).entropy().item() == pytest.approx(math.log(4) / 2)
    fair_gripper = gaussian_head(gripper_dim=0, dims=1)(torch.zeros(1, 1))
    assert BinDistribution(fair_gripper).entropy().item() == pytest.approx(math.log(2))


def test_log_prob_sums_over_the_dimensions():
    distribution = BinDistribution(torch.tensor([[[0.0, math.log(3.0)], [math.log(4.0), 0.0]]]))
    got = distribution.log_prob(torch.tensor([[1, 1]])).item()
    assert got == pytest.approx(math.log(3 / 4) + math.log(1 / 5), abs=1e-6)


def test_uniform_numbers_are_quantiles_of_the_distribution():
    # Bins of probability 1/8, 0, 2/8, 5/8, 0: those of probability 0 are never drawn.
    probabilities = torch.tensor([1 / 8, 0.0, 2 / 8, 5 / 8, 0.0])
    uniform = torch.tensor([[0.0], [0.124], [0.126], [0.374], [0.376], [1 - 2**-24]])
    distribution = BinDistribution(probabilities.log().clamp(min=-1e4).expand(6, 1, 5))
    assert distribution.sample(uniform=uniform).flatten().tolist() == [0, 0, 2, 2, 3, 3]
    # At temperature 1/2 the probabilities are squared: 1/30, 0, 4/30, 25/30, 0.
    assert distribution.sample(0.5, uniform=uniform).flatten().tolist() == [0, 2, 2, 3, 3, 3]
    assert distribution.sample(0.0, uniform=uniform).flatten().tolist() == [3] * 6


def test_sigma_starts_where_asked_and_stays_in_its_range():
    head = gaussian_head(sigma=0.2)
    torch.testing.assert_close(head.sigma(), torch.full((3,), 0.2))
    with torch.no_grad():
        head.raw_sigma.copy_(torch.tensor([-100.0, 0.0, 100.0]))
    low, middle, high = head.sigma().tolist()
    assert (low, high) == (pytest.approx(0.01), pytest.approx(0.9))
    assert middle == pytest.approx(math.sqrt(0.01 * 0.9))


@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_gradients_of_the_discretised_normal_are_those_of_finite_differences(temperature):
    torch.manual_seed(0)
    mean = torch.tensor([[-1.1, 0.1, 0.0], [0.9, -0.3, 1.2]], dtype=torch.float64, requires_grad=True)
    sigma = torch.tensor([0.05, 0.2, 0.7], dtype=torch.float64, requires_grad=True)
    tokens = torch.tensor([[0, 140, 3], [250, 99, 255]])
    centres = bin_centres(256).double()

    def function(mean, sigma):
        return discretised_normal(mean, sigma, tokens, centres, temperature)

    assert torch.autograd.gradcheck(function, (mean, sigma))


@pytest.mark.parametrize("temperature", [1.0, 0.6, 0.0])
@pytest.mark.parametrize("gripper_dim", [None, 1])
def test_evaluating_bins_is_the_distribution_over_all_bins(gripper_dim, temperature, monkeypatch):
    """Also where the rows do not fit into one chunk, and for a bin that the gripper never takes."""
    monkeypatch.setattr(discretised_normal_module, "CHUNK_NUMBERS", 5 * 256)
    torch.manual_seed(0)
    head = gaussian_head(gripper_dim)
    features = torch.randn(4, 3)
    tokens = torch.tensor([[10, 0, 128], [255, 255, 0], [90, 255, 200], [127, 7, 255]])
    if temperature == 0:
        tokens[0] = head(features).argmax(-1)[0]
    results = []
    for evaluate in (
        lambda: head.evaluate(features, tokens, temperature),
        lambda: (BinDistribution(head(features)).log_prob(tokens, temperature),
                 BinDistribution(head(features)).entropy(temperature)),
    ):  # fmt: skip
        head.zero_grad(set_to_none=True)
        log_prob, entropy = evaluate()
        if temperature:
            (log_prob.mul(torch.arange(1.0, 5.0)).sum() + 10 * entropy.square().sum()).backward()
        results.append((log_prob, entropy, *(p.grad for p in head.parameters())))
    for fast, plain in zip(*results, strict=True):
        torch.testing.assert_close(fast, plain, rtol=2e-5, atol=2e-5)
