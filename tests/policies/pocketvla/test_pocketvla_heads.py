"""The distributions over bins against independent computations."""

import math

import numpy as np
import pytest
import torch
from lerobot_policy_pocketvla.heads import (
    CategoricalBins,
    GaussianHead,
    NormalBins,
    actions_to_tokens,
    tokens_to_actions,
)
from scipy.stats import norm, truncnorm

EDGES = np.linspace(-1, 1, 257)


def gaussian_head(gripper_dim: int | None = None, sigma: float = 0.2, dims: int = 3) -> GaussianHead:
    """A head whose mean is exactly its input's (limited) value: the projection is the identity."""
    head = GaussianHead(
        dims, dims, 256, gripper_dim, sigma_init=sigma, sigma_min=0.01, sigma_max=0.9, gripper_logit_limit=5.0
    )
    with torch.no_grad():
        head.project.weight.copy_(torch.eye(dims))
    return head


def normal_bins(means: list[float], sigma: float) -> NormalBins:
    dims = len(means)
    return NormalBins(
        torch.tensor([means]),
        torch.full((dims,), sigma),
        torch.zeros(dims, dtype=torch.bool),
        torch.zeros(1, 1),
        256,
    )


def test_actions_and_tokens_round_trip_to_half_a_bin():
    actions = torch.linspace(-1, 1, 5001)
    error = (tokens_to_actions(actions_to_tokens(actions, 256), 256) - actions).abs()
    assert error.max() <= 1 / 256 + 1e-6
    tokens = torch.arange(256)
    assert torch.equal(actions_to_tokens(tokens_to_actions(tokens, 256), 256), tokens)


@pytest.mark.parametrize("temperature", [1.0, 0.6])
@pytest.mark.parametrize("sigma", [0.05, 0.4])
@pytest.mark.parametrize("mean", [-1.2, 0.1, 0.97])
def test_bins_have_the_probabilities_of_a_normal_distribution_that_is_cut_off(mean, sigma, temperature):
    # A power 1 / T of a normal density is a normal density with the variance multiplied by T.
    scale = sigma * math.sqrt(temperature)
    of_bins = np.diff(norm.cdf(EDGES, mean, scale)) / np.diff(norm.cdf([-1, 1], mean, scale))
    distribution = normal_bins([mean], sigma)
    tokens = torch.arange(256)[:, None]
    got = distribution.log_prob(tokens, temperature).exp().numpy()
    likely = of_bins > 1e-4 * of_bins.max()
    # Of a normal distribution that lies beyond the bins, all but a tail is cut off.
    tolerance = 2e-3 if abs(mean) < 1 else 0.05
    np.testing.assert_allclose(got[likely], of_bins[likely], rtol=0.03 + tolerance)
    assert got.sum() == pytest.approx(1, abs=tolerance)
    entropy = -(of_bins[of_bins > 0] * np.log(of_bins[of_bins > 0])).sum()
    assert distribution.entropy(temperature).item() == pytest.approx(entropy, abs=tolerance)
    assert distribution.mode().item() == of_bins.argmax()


@pytest.mark.parametrize("mean", [-1.25, 0.3, 1.25])
def test_samples_are_the_bins_at_the_quantiles_of_the_cut_off_normal(mean):
    uniform = torch.tensor([[0.0], [1e-4], [0.3], [0.5], [0.9], [1 - 2**-24]])
    scale = 0.05 * math.sqrt(0.6)
    values = truncnorm.ppf(uniform.double().numpy(), (-1 - mean) / scale, (1 - mean) / scale, mean, scale)
    expected = np.clip(np.digitize(values, EDGES) - 1, 0, 255)
    got = normal_bins([mean], 0.05).sample(0.6, uniform)
    np.testing.assert_array_equal(got.numpy(), expected)


@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_gradients_are_those_of_finite_differences(temperature):
    mean = torch.tensor([[-1.1, 0.1, 0.2], [0.9, -0.3, 1.2]], dtype=torch.float64, requires_grad=True)
    sigma = torch.tensor([0.05, 0.2, 0.7], dtype=torch.float64, requires_grad=True)
    logit = torch.tensor([[0.4], [-2.0]], dtype=torch.float64, requires_grad=True)
    tokens = torch.tensor([[0, 140, 0], [250, 99, 255]])

    def function(mean, sigma, logit):
        bins = NormalBins(mean, sigma, torch.tensor([False, False, True]), logit, 256)
        return bins.log_prob(tokens, temperature), bins.entropy(temperature)

    assert torch.autograd.gradcheck(function, (mean, sigma, logit))


def test_far_from_every_bin_numbers_stay_finite():
    distribution = normal_bins([1.25, -1.25], 0.05)
    assert torch.isfinite(distribution.log_prob(torch.tensor([[0, 255]]), 0.6)).all()
    assert torch.isfinite(distribution.entropy(0.6)).all()


def test_the_gripper_takes_only_its_outermost_bins_with_the_sigmoid_of_one_limited_logit():
    bins = gaussian_head(gripper_dim=-1)(torch.tensor([[0.0, 0.0, 1.5]]))
    logit = 5 * math.tanh(1.5 / 5)
    closed = 1 / (1 + math.exp(logit))
    quantiles = torch.tensor([[0.5, 0.5, closed - 0.01], [0.5, 0.5, closed + 0.01]])
    assert bins.sample(1.0, quantiles)[:, 2].tolist() == [0, 255]
    difference = bins.log_prob(torch.tensor([[9, 9, 255], [9, 9, 0]]), 1.0)
    assert (difference[0] - difference[1]).item() == pytest.approx(logit, abs=1e-5)
    # Halving the temperature doubles the logit.
    difference = bins.log_prob(torch.tensor([[9, 9, 255], [9, 9, 0]]), 0.5)
    assert (difference[0] - difference[1]).item() == pytest.approx(2 * logit, abs=1e-5)


def test_the_less_likely_gripper_command_stays_possible():
    """However sure the network is, the other command keeps the probability sigmoid(-5) = 0.67 %."""
    bins = gaussian_head(gripper_dim=0, dims=1)(torch.tensor([[1e4]]))
    assert bins.log_prob(torch.tensor([[0]]), 1.0).exp().item() == pytest.approx(0.0066929, abs=1e-6)


def test_entropy_by_hand():
    uniform = CategoricalBins(torch.zeros(2, 7, 256))
    torch.testing.assert_close(uniform.entropy(1.0), torch.full((2,), math.log(256)))
    # One dimension uniform over 4 bins, one certain: the mean of log 4 and 0.
    logits = torch.zeros(1, 2, 4)
    logits[0, 1, 2] = 1000.0
    assert CategoricalBins(logits).entropy(1.0).item() == pytest.approx(math.log(4) / 2)
    fair_gripper = gaussian_head(gripper_dim=0, dims=1)(torch.zeros(1, 1))
    assert fair_gripper.entropy(1.0).item() == pytest.approx(math.log(2))


def test_log_prob_sums_over_the_dimensions():
    distribution = CategoricalBins(torch.tensor([[[0.0, math.log(3.0)], [math.log(4.0), 0.0]]]))
    got = distribution.log_prob(torch.tensor([[1, 1]]), 1.0).item()
    assert got == pytest.approx(math.log(3 / 4) + math.log(1 / 5), abs=1e-6)


def test_uniform_numbers_are_quantiles_of_the_categorical_distribution():
    # Bins of probability 1/8, 0, 2/8, 5/8, 0: those of probability 0 are never drawn.
    probabilities = torch.tensor([1 / 8, 0.0, 2 / 8, 5 / 8, 0.0])
    uniform = torch.tensor([[0.0], [0.124], [0.126], [0.374], [0.376], [1 - 2**-24]])
    distribution = CategoricalBins(probabilities.log().clamp(min=-1e4).expand(6, 1, 5))
    assert distribution.sample(1.0, uniform).flatten().tolist() == [0, 0, 2, 2, 3, 3]
    # At temperature 1/2 the probabilities are squared: 1/30, 0, 4/30, 25/30, 0.
    assert distribution.sample(0.5, uniform).flatten().tolist() == [0, 2, 2, 3, 3, 3]
    assert distribution.mode().flatten().tolist() == [3] * 6


def test_sigma_starts_where_asked_and_stays_in_its_range():
    head = gaussian_head(sigma=0.2)
    torch.testing.assert_close(head.sigma(), torch.full((3,), 0.2))
    with torch.no_grad():
        head.raw_sigma.copy_(torch.tensor([-100.0, 0.0, 100.0]))
    low, middle, high = head.sigma().tolist()
    assert (low, high) == (pytest.approx(0.01), pytest.approx(0.9))
    assert middle == pytest.approx(math.sqrt(0.01 * 0.9))
