"""A denoising as a chain of Gaussian steps, whose likelihood is known (DPPO, Ren et al., 2024)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Normal

Step = Callable[[Any, Tensor], tuple[Tensor, Tensor]]
"""k in 0 .. S-1 and x_k (B, H, D) -> mean (B, H, D) and standard deviation, that shape or one that broadcasts to
it, of x_{k+1}. A deviation of 0 is a step without noise. A flow's takes also (B,) of k, a number for each row."""


@dataclass(frozen=True)
class Scored:
    """Which part of every x_k counts in the likelihood: that which is played.

    The rest of the chunk and padded dimensions are drawn, too, but not judged, as in pi_RL (Chen et al., 2025):
    they reach the played part only through later steps, and their many terms would drown its ratio in noise.
    """

    steps: slice
    """Of the H steps of the chunk."""
    dims: int
    """The first ones of the D dimensions."""

    def __call__(self, x: Tensor) -> Tensor:
        """(B, H, D) to (B, n, A)."""
        return x[:, self.steps, : self.dims]


def sample_chain(
    step: Step, start: Tensor, num_steps: int, scored: Scored, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Draw a chain.

    Args:
        step: the distribution of the next x.
        start: x_0 (B, H, D), pure noise.
        num_steps: S.
        scored: what the likelihood is of.
        generator: random source; None is torch's global one.

    Returns:
        The chain (B, S + 1, H, D), whose last x holds the actions, and `log_prob` (B, S) of its steps [nats]; 0 of
        those without noise.
    """
    chain, log_probs = [start], []
    for k in range(num_steps):
        mean, std = step(k, chain[-1])
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        # Not mean + 0 * noise where there is none: exactly what the policy itself would do.
        x = torch.where(std > 0, mean + std * noise, mean)
        log_probs.append(step_log_prob(mean, std, x, scored))
        chain.append(x)
    return torch.stack(chain, 1), torch.stack(log_probs, 1)


def chain_log_prob(step: Step, chain: Tensor, scored: Scored) -> Tensor:
    """Return, differentiably, the log-likelihood (B, S) [nats] of a chain (B, S + 1, H, D)."""
    log_probs = []
    for k in range(chain.shape[1] - 1):
        mean, std = step(k, chain[:, k])
        log_probs.append(step_log_prob(mean, std, chain[:, k + 1], scored))
    return torch.stack(log_probs, 1)


def step_log_prob(mean: Tensor, std: Tensor, x: Tensor, scored: Scored) -> Tensor:
    """Return the log-likelihood (B,) [nats] of x (B, H, D) after a step; 0 where it has no noise."""
    mean, x, std = scored(mean), scored(x), scored(std.expand_as(mean))
    noisy = std > 0
    # Without its checks, each of which would wait for a GPU.
    log_prob = Normal(mean, torch.where(noisy, std, 1.0), validate_args=False).log_prob(x)
    return torch.where(noisy, log_prob, 0.0).sum((1, 2))
