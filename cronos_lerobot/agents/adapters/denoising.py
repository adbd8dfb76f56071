"""Policies that denoise a chunk of actions, as a chain of Gaussian steps whose likelihood is known.

That is DPPO (Ren et al., 2024), whatever the equation of a step.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Normal

from cronos_lerobot.agents.adapters.registry import CriticAdapter
from cronos_lerobot.agents.base import Batch

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


class DenoisingAdapter(CriticAdapter):
    """A decision is the chain of a chunk, its trace (B, S + 1, H, D); a factor is one step of the chain.

    A subclass says what its policy makes of an observation (`observe`), what a step of its denoising is (`step`),
    and which parameters are trained (`policy_parameters`).

    Args:
        policy: the LeRobot policy, on its device.
        shape: (H, D) of the chunk as the network sees it, with padded dimensions.
        num_steps: S, as the policy's own denoising has.
        first: step of the chunk that is played first; n_action_steps are.
        feature_width: F, of what the critic reads; None if the subclass has values of its own.
    """

    def __init__(
        self, policy: Any, *, shape: tuple[int, int], num_steps: int, feature_width: int | None, first: int = 0
    ) -> None:
        super().__init__(policy, feature_width)
        self.decision_steps = policy.config.n_action_steps
        self.num_steps, self.shape = num_steps, shape
        played = slice(first, first + self.decision_steps)
        self.scored = Scored(played, policy.config.action_feature.shape[0])

    @abstractmethod
    def observe(self, batch: Batch) -> tuple[Any, Tensor]:
        """Return what `step` needs of an observation, any type, and the critic's features (B, F), detached."""

    @abstractmethod
    def step(self, context: Any, temperature: float) -> Step:
        """Return the steps of the denoising; temperature 0 is the policy's own, without noise."""

    def actions(self, context: Any, x: Tensor) -> Tensor:
        """Return the normalised actions (B, H, D) that the end of a chain (B, H, D) stands for."""
        return x

    def values(self, batch: Batch, context: Any, features: Tensor) -> Tensor:
        """Return the values (B,) of a batch, of which `observe` returned `context` and `features`."""
        return self.critic(features)

    def features(self, batch: Batch) -> Tensor:
        """See `CriticAdapter`."""
        return self.observe(batch)[1]

    def sample_actions(
        self,
        batch: Batch,
        *,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        noise: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """See `TrainablePolicy`; the temperature is a factor of the noise, 0 is the policy's own denoising.

        Args:
            batch: see `TrainablePolicy`.
            temperature: see above.
            generator: draws the chain.
            noise: x_0 (B, H, D) to begin with; None draws it.
        """
        context, features = self.observe(batch)
        if noise is None:
            noise = torch.randn(
                (len(features), *self.shape), generator=generator, device=features.device, dtype=torch.float32
            )
        end, trace, log_prob = self.draw(context, noise, temperature, generator)
        value = self.values(batch, context, features)
        actions = self.scored(self.actions(context, end))
        return {"actions": actions, "trace": trace, "log_prob": log_prob, "value": value}

    def draw(
        self, context: Any, noise: Tensor, temperature: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return x_S (B, H, D), the trace and `log_prob` (B, L) of a denoising that begins with `noise`."""
        step = self.step(context, temperature)
        chain, log_prob = sample_chain(step, noise, self.num_steps, self.scored, generator)
        return chain[:, -1], chain, log_prob

    def judge(self, context: Any, trace: Tensor, temperature: float) -> Tensor:
        """Return, differentiably, `log_prob` (B, L) of a trace."""
        return chain_log_prob(self.step(context, temperature), trace, self.scored)

    def denoise(self, context: Any, noise: Tensor) -> Tensor:
        """See `Steerable`."""
        return self.scored(self.actions(context, self.integrate(context, noise)))

    def integrate(self, context: Any, noise: Tensor) -> Tensor:
        """Return, differentiably, x_S (B, H, D) of the policy's own denoising, which adds no noise."""
        step, x = self.step(context, 0.0), noise
        for k in range(self.num_steps):
            x = step(k, x)[0]
        return x

    def evaluate_actions(
        self, batch: Batch, trace: Tensor, *, temperature: float = 1.0
    ) -> dict[str, Tensor | None]:
        """See `TrainablePolicy`; the chain's entropy does not depend on the policy."""
        context, features = self.observe(batch)
        log_prob = self.judge(context, trace, temperature)
        return {"log_prob": log_prob, "entropy": None, "value": self.values(batch, context, features)}
