"""Action heads: features to a categorical distribution over bins, one per action dimension."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lerobot_policy_pocketvla.discretised_normal import IMPOSSIBLE, discretised_normal, two_points


def bin_centres(num_bins: int) -> Tensor:
    """Centres of `num_bins` equal bins over [-1, 1], shape (num_bins,)."""
    width = 2.0 / num_bins
    return -1.0 + width * (torch.arange(num_bins, dtype=torch.float32) + 0.5)


def tokens_to_actions(tokens: Tensor, num_bins: int) -> Tensor:
    """Bin indices to the normalised actions at the bins' centres, any shape."""
    return -1.0 + (2.0 * tokens.to(torch.float32) + 1.0) / num_bins


def actions_to_tokens(actions: Tensor, num_bins: int) -> Tensor:
    """Normalised actions to the bins they fall in, any shape; outside [-1, 1] it is the edge bin."""
    return ((actions.float() + 1.0) * (0.5 * num_bins)).floor().long().clamp(0, num_bins - 1)


@dataclass(frozen=True)
class BinDistribution:
    """Independent categorical distributions over the bins of each action dimension."""

    logits: Tensor
    """Unnormalised log-probabilities at temperature 1, shape (B, action dimensions, bins), float32."""

    def log_probs(self, temperature: float = 1.0) -> Tensor:
        """Log-probability of every bin, softmax(logits / temperature), shape (B, D, bins)."""
        return torch.log_softmax(self.logits / temperature, dim=-1)

    def mode(self) -> Tensor:
        """The likeliest bin of each dimension, shape (B, D)."""
        return self.logits.argmax(dim=-1)

    def sample(
        self,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        uniform: Tensor | None = None,
    ) -> Tensor:
        """Draw one bin per dimension, shape (B, D); temperature 0 is the mode.

        Args:
            temperature: divides the logits.
            generator: source of the randomness.
            uniform: the randomness itself, numbers (B, D) in [0, 1), in place of a generator: the quantiles of the
                distributions at which the bins are drawn.
        """
        if temperature == 0:
            return self.mode()
        probs = self.log_probs(temperature).exp()
        batch, dims, bins = probs.shape
        if uniform is None:
            # Six times as fast as torch.multinomial, which draws a number for every bin.
            uniform = torch.rand(batch, dims, generator=generator, device=probs.device)
        cumulative = probs.cumsum(dim=-1)
        # The sum differs from 1 by rounding; without this, a number close to 1 would fall beyond the last bin.
        threshold = uniform.to(cumulative.dtype) * cumulative[..., -1]
        return torch.searchsorted(cumulative, threshold.unsqueeze(-1), right=True).squeeze(-1).clamp(max=bins - 1)

    def log_prob(self, tokens: Tensor, temperature: float = 1.0) -> Tensor:
        """Log-probability of bins (B, D), summed over the dimensions, shape (B,).

        At temperature 0 the distribution is a point: 0 for the mode, minus infinity for the rest.
        """
        if temperature == 0:
            hit = (tokens == self.mode()).all(dim=-1)
            return torch.where(hit, 0.0, -math.inf)
        return self.log_probs(temperature).gather(-1, tokens.unsqueeze(-1)).squeeze(-1).sum(-1)

    def entropy(self, temperature: float = 1.0) -> Tensor:
        """Entropy in nats, mean over the dimensions, shape (B,)."""
        if temperature == 0:
            return self.logits.new_zeros(self.logits.shape[0])
        log_probs = self.log_probs(temperature)
        return -(log_probs.exp() * log_probs).sum(-1).mean(-1)


def two_point_logits(sign_logit: Tensor, num_bins: int) -> Tensor:
    """Logits (B, bins) with P(last bin) = sigmoid(sign_logit), the rest on the first; sign_logit is (B,)."""
    half = 0.5 * sign_logit[:, None]
    between = torch.full((len(half), num_bins - 2), IMPOSSIBLE, device=half.device)
    return torch.cat((-half, between, half), dim=-1)


class CategoricalHead(nn.Module):
    """A free logit for every bin of every dimension."""

    def __init__(self, features: int, action_dim: int, num_bins: int) -> None:
        """Build the layers."""
        super().__init__()
        self.shape = (action_dim, num_bins)
        self.project = nn.Linear(features, action_dim * num_bins)
        nn.init.orthogonal_(self.project.weight, gain=0.1)
        nn.init.zeros_(self.project.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, F) to logits (B, D, bins)."""
        return self.project(features).unflatten(-1, self.shape)

    def evaluate(self, features: Tensor, tokens: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
        """`BinDistribution.log_prob` of bins (B, D) and `entropy`, each (B,)."""
        distribution = BinDistribution(self(features))
        return distribution.log_prob(tokens, temperature), distribution.entropy(temperature)


class GaussianHead(nn.Module):
    """A predicted mean and one learned sigma per dimension generate the logits of the bins.

    The logit of the bin with centre c is log N(c; mean, sigma) up to a constant, so dividing the logits by
    a temperature is the same as multiplying sigma by its square root. The gripper, if there is one, takes
    only its two outermost bins, chosen by a single logit.

    Args:
        features: width of the input.
        action_dim: number of action dimensions D.
        num_bins: bins over [-1, 1].
        gripper_dim: index of the gripper dimension, None for none.
        sigma_init, sigma_min, sigma_max: start and range of sigma, in normalised action units.
        gripper_logit_limit: the gripper's logit stays inside (-limit, limit).
        mean_limit: the mean stays inside (-mean_limit, mean_limit); above 1 so that edge bins are reachable.
    """

    centres: Tensor

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
        self.register_buffer("centres", bin_centres(num_bins), persistent=False)

    def sigma(self) -> Tensor:
        """Standard deviation of each dimension in normalised units, shape (D,)."""
        low, high = self.log_sigma_range
        return (low + (high - low) * torch.sigmoid(self.raw_sigma)).exp()

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, F) to logits (B, D, bins)."""
        mean, gripper_logit = self._mean_and_gripper_logit(features)
        distance = (self.centres - mean.unsqueeze(-1)) / self.sigma().unsqueeze(-1)
        logits = -0.5 * distance.square()
        if self.gripper_dim is None:
            return logits
        gripper = two_point_logits(gripper_logit, logits.shape[-1])
        dim = self.gripper_dim
        return torch.cat((logits[:, :dim], gripper[:, None], logits[:, dim + 1 :]), dim=1)

    def evaluate(self, features: Tensor, tokens: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
        """`BinDistribution.log_prob` of bins (B, D) and `entropy`, each (B,), at a fraction of the memory."""
        if temperature == 0:
            distribution = BinDistribution(self(features))
            return distribution.log_prob(tokens, temperature), distribution.entropy(temperature)
        mean, gripper_logit = self._mean_and_gripper_logit(features)
        log_probs, entropies = discretised_normal(mean, self.sigma(), tokens, self.centres, temperature)
        if self.gripper_dim is not None:
            dim = self.gripper_dim
            gripper = two_points(gripper_logit, tokens[:, dim], len(self.centres), temperature)
            log_probs, entropies = (
                torch.cat((normal[:, :dim], point[:, None], normal[:, dim + 1 :]), dim=1)
                for normal, point in zip((log_probs, entropies), gripper, strict=True)
            )
        return log_probs.sum(-1), entropies.mean(-1)

    def _mean_and_gripper_logit(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Means (B, D), of which the gripper's is not used, and the gripper's logit (B,): 0 without a gripper."""
        raw = self.project(features)
        mean = self.mean_limit * torch.tanh(raw / self.mean_limit)
        if self.gripper_dim is None:
            return mean, raw.new_zeros(len(raw))
        limit = self.gripper_logit_limit
        return mean, limit * torch.tanh(raw[:, self.gripper_dim] / limit)
