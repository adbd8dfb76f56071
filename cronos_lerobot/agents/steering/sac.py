"""Soft actor-critic (Haarnoja et al., 2018) over decisions, with an ensemble of critics as in REDQ (2021)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import deepcopy

import numpy as np
import torch
from lerobot.policies.gaussian_actor.modeling_gaussian_actor import MLP
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.ranks import Ranks

Metrics = dict[str, float]
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


class SAC(nn.Module):
    """Learns which choices are worth most.

    Args:
        config: the settings.
        actor: chooses.
        whitening: of what actor and critics read.
        features: F, how many numbers those are.
        dims: d, how many numbers are chosen.
        device: where it learns.
        generator: draws the choices that are learned from, and the critics that count; on that device.
        ranks: whose gradients are averaged.
    """

    def __init__(
        self,
        config: SteeringConfig,
        actor: NoiseActor,
        whitening: Whitening,
        features: int,
        dims: int,
        device: torch.device | str = "cpu",
        generator: torch.Generator | None = None,
        ranks: Ranks | None = None,
    ) -> None:
        super().__init__()
        self.config, self.generator, self.ranks = config, generator, ranks or Ranks()
        self.actor, self.whitening = actor, whitening
        self.critics = Critics(features, dims, config.hidden_width, config.num_critics)
        self.log_alpha = nn.Parameter(torch.tensor(math.log(config.initial_alpha)))
        self.target_critics = deepcopy(self.critics).requires_grad_(False)
        self.target_entropy = config.target_entropy * dims
        self.to(device)
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "actor": torch.optim.Adam(actor.parameters(), lr=config.lr),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=config.lr),
            "alpha": torch.optim.Adam([self.log_alpha], lr=config.lr),
        }

    def step(self, batch: dict[str, np.ndarray]) -> Metrics:
        """One optimizer step of critics, actor and alpha on decisions that `ReplayMemory.draw` drew."""
        device = self.log_alpha.device
        drawn = {name: torch.from_numpy(column).to(device) for name, column in batch.items()}
        features = self.whitening(drawn["features"])
        values = self.critics(features, drawn["choice"])
        target = self.targets(drawn["reward"], drawn["discount"], drawn["next_features"])
        critic_loss = ((values - target) ** 2).mean(1).sum()
        critic_norm = self._descend("critics", critic_loss, self.critics)

        choice, log_prob = self.actor(features, generator=self.generator)
        alpha = self.log_alpha.exp()
        self.critics.requires_grad_(False)
        actor_loss = (alpha.detach() * log_prob - self._judge(features, choice)).mean()
        actor_norm = self._descend("actor", actor_loss, self.actor)
        self.critics.requires_grad_(True)

        entropy = -log_prob.detach().mean()
        self._descend("alpha", alpha * (entropy - self.target_entropy))
        with torch.no_grad():
            for goal, param in zip(self.target_critics.parameters(), self.critics.parameters(), strict=True):
                goal.lerp_(param, self.config.target_update)
        return {
            "critic_loss": critic_loss.item(),
            "critic_grad_norm": critic_norm,
            "actor_loss": actor_loss.item(),
            "actor_grad_norm": actor_norm,
            "value": values.detach().mean().item(),
            "entropy": entropy.item() / choice.shape[1],
            "choice_abs": choice.detach().abs().mean().item(),
        }

    @torch.no_grad()
    def targets(self, reward: Tensor, discount: Tensor, next_features: Tensor) -> Tensor:
        """What the critics are to say of decisions (B,): the rewards and what follows, discounted."""
        features = self.whitening(next_features)
        choice, log_prob = self.actor(features, generator=self.generator)
        following = self.target_critics(features, choice)
        if self.config.num_target_critics < self.config.num_critics:
            order = torch.randperm(len(following), generator=self.generator, device=following.device)
            following = following[order[: self.config.num_target_critics]]
        following = following.min(0).values
        if self.config.backup_entropy:
            following = following - self.log_alpha.exp() * log_prob
        return reward + discount * following

    @torch.no_grad()
    def value(self, features: Tensor, choice: Tensor) -> Tensor:
        """What choices (B, d) are worth, (B,)."""
        return self._judge(self.whitening(features), choice)

    def trained(self) -> Iterator[Tensor]:
        """All that learning changes."""
        yield from self.parameters()
        yield from self.buffers()

    def _judge(self, features: Tensor, choice: Tensor) -> Tensor:
        """The least of two critics, as in SAC; the mean of more, as in REDQ."""
        values = self.critics(features, choice)
        few = self.config.num_target_critics == self.config.num_critics
        return values.min(0).values if few else values.mean(0)

    def _descend(self, name: str, loss: Tensor, network: nn.Module | None = None) -> float:
        """An optimizer step; returns the gradient's norm."""
        if not torch.isfinite(loss):
            raise FloatingPointError(f"The loss of {name} is {loss.item()}.")
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        params = [self.log_alpha] if network is None else list(network.parameters())
        self.ranks.average_gradients(params)
        limit = math.inf if network is None else self.config.max_grad_norm
        norm = nn.utils.clip_grad_norm_(params, limit)
        optimizer.step()
        return float(norm)
