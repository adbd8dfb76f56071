"""Action heads: features to a distribution over bins for each action dimension."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def tokens_to_actions(tokens: Tensor, num_bins: int) -> Tensor:
    """Bin indices to the normalised actions at the bins' centres, any shape."""
    return -1.0 + (2.0 * tokens.to(torch.float32) + 1.0) / num_bins


def actions_to_tokens(actions: Tensor, num_bins: int) -> Tensor:
    """Normalised actions to the bins they fall in, any shape; outside [-1, 1] it is the edge bin."""
    return ((actions + 1.0) * (0.5 * num_bins)).floor().long().clamp(0, num_bins - 1)


@dataclass(frozen=True)
class CategoricalBins:
    """Independent categorical distributions over the bins of each action dimension."""

    logits: Tensor
    """Unnormalised log-probabilities at temperature 1, shape (B, action dimensions, bins), float32."""

    def mode(self) -> Tensor:
        """The likeliest bin of each dimension, shape (B, D)."""
        return self.logits.argmax(dim=-1)

    def sample(self, temperature: float, uniform: Tensor) -> Tensor:
        """Draw one bin per dimension, shape (B, D), at the quantiles `uniform` (B, D) in [0, 1)."""
        cumulative = self._log_probs(temperature).exp().cumsum(dim=-1)
        # The sum differs from 1 by rounding; without this, a number close to 1 would fall beyond the last bin.
        threshold = uniform.to(cumulative.dtype) * cumulative[..., -1]
        tokens = torch.searchsorted(cumulative, threshold.unsqueeze(-1), right=True).squeeze(-1)
        return tokens.clamp(max=self.logits.shape[-1] - 1)

    def log_prob(self, tokens: Tensor, temperature: float) -> Tensor:
        """Log-probability of bins (B, D), summed over the dimensions, shape (B,)."""
        return self._log_probs(temperature).gather(-1, tokens.unsqueeze(-1)).squeeze(-1).sum(-1)

    def entropy(self, temperature: float) -> Tensor:
        """Entropy in nats, mean over the dimensions, shape (B,)."""
        log_probs = self._log_probs(temperature)
        return -(log_probs.exp() * log_probs).sum(-1).mean(-1)

    def _log_probs(self, temperature: float) -> Tensor:
        return torch.log_softmax(self.logits / temperature, dim=-1)


@dataclass(frozen=True)
class NormalBins:
    """Independent normal distributions, cut off at -1 and 1, whose samples fall into bins.

    A bin's probability is the density at its centre times its width, so that no number is needed for every bin.
    Bins are narrower than sigma, so this is right to a few hundredths even where the mean lies beyond them. The
    gripper takes the first or the last bin.
    """

    mean: Tensor
    """(B, D), of the normal distributions before they are cut off."""
    sigma: Tensor
    """(D,), their standard deviations at temperature 1."""
    is_gripper: Tensor
    """(D,) bool."""
    gripper_logit: Tensor
    """(B, 1), log-odds of the last bin at temperature 1."""
    num_bins: int

    def mode(self) -> Tensor:
        """See `CategoricalBins`."""
        gripper = (self.gripper_logit > 0) * (self.num_bins - 1)
        return torch.where(self.is_gripper, gripper, actions_to_tokens(self.mean, self.num_bins))

    def sample(self, temperature: float, uniform: Tensor) -> Tensor:
        """See `CategoricalBins`."""
        scale = self._scale(temperature)
        below_low, below_high = (_below(end.double()) for end in self._ends(scale))
        side = torch.where(self.mean < 0, -1.0, 1.0)
        quantile = torch.where(self.mean < 0, 1 - uniform.double(), uniform.double())
        # Where only a tail is left, float64 tells one quantile from another.
        distance = torch.special.ndtri(below_low + quantile * (below_high - below_low))
        actions = side * (self.mean.abs() + scale * distance)
        opens = uniform >= torch.sigmoid(-self.gripper_logit / temperature)
        gripper = opens * (self.num_bins - 1)
        return torch.where(self.is_gripper, gripper, actions_to_tokens(actions, self.num_bins))

    def log_prob(self, tokens: Tensor, temperature: float) -> Tensor:
        """See `CategoricalBins`."""
        scale = self._scale(temperature)
        distance = (tokens_to_actions(tokens, self.num_bins) - self.mean) / scale
        density = -0.5 * distance.square() - LOG_SQRT_2PI - scale.log() - self._inside(scale).log()
        sign = torch.where(tokens > 0, 1.0, -1.0)
        gripper = F.logsigmoid(sign * self.gripper_logit / temperature)
        return torch.where(self.is_gripper, gripper, density + math.log(2 / self.num_bins)).sum(-1)

    def entropy(self, temperature: float) -> Tensor:
        """See `CategoricalBins`."""
        scale = self._scale(temperature)
        inside, (low, high) = self._inside(scale), self._ends(scale)
        cut = (low * _density(low) - high * _density(high)) / (2 * inside)
        normal = 0.5 + LOG_SQRT_2PI + scale.log() + inside.log() + cut - math.log(2 / self.num_bins)
        logit = self.gripper_logit / temperature
        gripper = F.softplus(-logit) + logit * torch.sigmoid(-logit)
        return torch.where(self.is_gripper, gripper, normal).mean(-1)

    def _scale(self, temperature: float) -> Tensor:
        """(D,). A power 1 / T of a normal density is one of the variance times T."""
        return self.sigma * math.sqrt(temperature)

    def _ends(self, scale: Tensor) -> tuple[Tensor, Tensor]:
        """-1 and 1 in deviations from the mean, mirrored so that small probabilities are on the left: (B, D)."""
        return (-1 - self.mean.abs()) / scale, (1 - self.mean.abs()) / scale

    def _inside(self, scale: Tensor) -> Tensor:
        """Probability (B, D) of what is not cut off."""
        low, high = self._ends(scale)
        return _below(high) - _below(low)


Bins = CategoricalBins | NormalBins


def _below(x: Tensor) -> Tensor:
    """Probability that a standard normal number is below `x`; unlike PyTorch's `ndtr` precise in the left tail."""
    return 0.5 * torch.erfc(-x * math.sqrt(0.5))


def _density(x: Tensor) -> Tensor:
    return torch.exp(-0.5 * x.square() - LOG_SQRT_2PI)


class CategoricalHead(nn.Module):
    """A free logit for every bin of every dimension."""

    def __init__(self, features: int, action_dim: int, num_bins: int) -> None:
        """Build the layers."""
        super().__init__()
        self.shape = (action_dim, num_bins)
        self.project = nn.Linear(features, action_dim * num_bins)
        nn.init.orthogonal_(self.project.weight, gain=0.1)
        nn.init.zeros_(self.project.bias)

    def forward(self, features: Tensor) -> CategoricalBins:
        """The distribution of features (B, F)."""
        return CategoricalBins(self.project(features).unflatten(-1, self.shape))


class GaussianHead(nn.Module):
    """A predicted mean and one learned sigma per dimension; the gripper, if there is one, has a single logit.

    Args:
        features: width of the input.
        action_dim: number of action dimensions D.
        num_bins: bins over [-1, 1].
        gripper_dim: index of the gripper dimension, None for none.
        sigma_init, sigma_min, sigma_max: start and range of sigma, in normalised action units.
        gripper_logit_limit: the gripper's logit stays inside (-limit, limit).
        mean_limit: the mean stays inside (-mean_limit, mean_limit); above 1 so that edge bins are reachable.
    """

    is_gripper: Tensor

    def __init__(
        self,
        features: int,
        action_dim: int,
        num_bins: int,
        gripper_dim: int | None,
        sigma_init: float,
        sigma_min: float,
        sigma_max: float,
        gripper_logit_limit: float,
        mean_limit: float = 1.25,
    ) -> None:
        """Build the layers."""
        super().__init__()
        self.num_bins = num_bins
        self.gripper_dim = None if gripper_dim is None else gripper_dim % action_dim
        self.mean_limit, self.gripper_logit_limit = mean_limit, gripper_logit_limit
        self.log_sigma_range = (math.log(sigma_min), math.log(sigma_max))
        self.project = nn.Linear(features, action_dim)
        nn.init.orthogonal_(self.project.weight, gain=0.1)
        nn.init.zeros_(self.project.bias)
        low, high = self.log_sigma_range
        fraction = (math.log(sigma_init) - low) / (high - low)
        # A sigmoid onto the range, not a clamp: a clamped sigma has no gradient to come back with.
        self.raw_sigma = nn.Parameter(torch.full((action_dim,), math.log(fraction / (1.0 - fraction))))
        is_gripper = torch.arange(action_dim) == (-1 if self.gripper_dim is None else self.gripper_dim)
        self.register_buffer("is_gripper", is_gripper, persistent=False)

    def sigma(self) -> Tensor:
        """Standard deviation of each dimension in normalised units, shape (D,)."""
        low, high = self.log_sigma_range
        return (low + (high - low) * torch.sigmoid(self.raw_sigma)).exp()

    def forward(self, features: Tensor) -> NormalBins:
        """The distribution of features (B, F)."""
        raw = self.project(features)
        mean = self.mean_limit * torch.tanh(raw / self.mean_limit)
        limit = self.gripper_logit_limit
        logit = limit * torch.tanh(raw[:, self.gripper_dim or 0, None] / limit)
        return NormalBins(mean, self.sigma(), self.is_gripper, logit, self.num_bins)
