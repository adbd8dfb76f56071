"""Actor and critics of steering."""

from __future__ import annotations

import math

import torch
from lerobot.policies.gaussian_actor.modeling_gaussian_actor import MLP
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

LOG_STD_RANGE = (-5.0, 2.0)
FEATURE_LIMIT = 5.0
"""Whitened features are clipped to this: one that hardly moved before must not drown all others when it does."""
LEAST_STD = 1e-2


class Whitening(nn.Module):
    """Features (B, F) to mean 0 and standard deviation 1, as they were when it was fitted.

    Args:
        features: F.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))

    def fit(self, mean: Tensor, square: Tensor) -> None:
        """Take the means (F,) of the features and of their squares."""
        self.mean.copy_(mean)
        self.std.copy_((square - mean**2).clamp(min=0).sqrt().clamp(min=LEAST_STD))

    def forward(self, features: Tensor) -> Tensor:
        """See above."""
        return ((features - self.mean) / self.std).clamp(-FEATURE_LIMIT, FEATURE_LIMIT)


class NoiseActor(nn.Module):
    """Whitened features (B, F) to a Gaussian squashed by tanh, at the start about N(0, 0.6) in every dimension.

    Args:
        features: F.
        dims: d, numbers that it chooses.
        width: of the two hidden layers.
    """

    def __init__(self, features: int, dims: int, width: int) -> None:
        super().__init__()
        self.body = MLP(features, [width, width], activate_final=True)
        self.head = nn.Linear(width, 2 * dims)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self, features: Tensor, temperature: float = 1.0, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return, differentiably, draws (B, d) in (-1, 1) and their log-density (B,) [nats] at temperature 1.

        Args:
            features: whitened.
            temperature: factor of the Gaussian's deviation, 0 takes its mean.
            generator: random source; None is torch's global one.
        """
        mean, log_std = self.head(self.body(features)).chunk(2, -1)
        log_std = log_std.clamp(*LOG_STD_RANGE)
        z = torch.randn(mean.shape, generator=generator, device=mean.device) * temperature
        u = mean + log_std.exp() * z
        # log(1 - tanh(u)^2), without its rounding at the ends.
        log_slope = 2.0 * (math.log(2.0) - u - F.softplus(-2.0 * u))
        log_prob = (-0.5 * z**2 - 0.5 * math.log(2.0 * math.pi) - log_std - log_slope).sum(-1)
        return torch.tanh(u), log_prob


class Critics(nn.Module):
    """An ensemble of E networks in one: whitened features (B, F) and choices (B, d) to values (E, B).

    Args:
        features: F.
        dims: d.
        width: of the two hidden layers.
        count: E.
    """

    def __init__(self, features: int, dims: int, width: int, count: int) -> None:
        super().__init__()
        sizes = [(features + dims, width), (width, width), (width, 1)]
        bounds = [size**-0.5 for size, _ in sizes]
        self.weights = nn.ParameterList(
            torch.empty(count, *size).uniform_(-bound, bound) for size, bound in zip(sizes, bounds, strict=True)
        )
        self.biases = nn.ParameterList(torch.zeros(count, 1, size) for _, size in sizes)

    def forward(self, features: Tensor, choices: Tensor) -> Tensor:
        """See above."""
        x = torch.cat([features, choices], -1).expand(len(self.biases[0]), -1, -1)
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = torch.baddbmm(bias, x, weight)
            x = F.silu(F.layer_norm(x, x.shape[-1:]))
        return torch.baddbmm(last[1], x, last[0]).squeeze(-1)
