"""What PPO minimises (Schulman et al., 2017), the policy that it holds on to, and what it measures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import huber_loss

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.ranks import Ranks

LOG_RATIO_LIMIT = 20.0
"""Largest |log r|: e^20 times any advantage is finite in float32, and any early stop stops long before."""


def by_factor(log_prob: Tensor, ratio: str) -> Tensor:
    """Log-probabilities (B,) or (B, L) as those whose ratios are clipped, (B, 1) or (B, L) [nats].

    Args:
        log_prob: of decisions, or of their L factors.
        ratio: `decision` clips one ratio for each decision, the product of its factors'; `factor` clips each.
    """
    log_prob = log_prob.reshape(len(log_prob), -1)
    return log_prob if ratio == "factor" else log_prob.sum(1, keepdim=True)


def bounded_log_ratio(new_log_prob: Tensor, old_log_prob: Tensor) -> Tensor:
    """log r of the probability ratio r = new / old, (B,), within LOG_RATIO_LIMIT: no gradient beyond it [nats]."""
    return (new_log_prob - old_log_prob).clamp(-LOG_RATIO_LIMIT, LOG_RATIO_LIMIT)


def clipped_objective(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """min(r A, clip(r, 1 - eps, 1 + eps) A), (B,), to be maximised; r = exp(log_ratio)."""
    ratio = log_ratio.exp()
    return torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)


def factor_weights(log_ratio: Tensor, discount: float) -> Tensor:
    """How much each of L factors (B, L) counts, (L,): the last one 1, each before it `discount` of the next."""
    before_last = torch.arange(log_ratio.shape[1] - 1, -1, -1, device=log_ratio.device)
    return discount**before_last


def approximate_kl(log_ratio: Tensor) -> Tensor:
    """KL(old || new) from samples of old, (B,): (r - 1) - log r, unbiased and never negative [nats]."""
    return log_ratio.exp() - 1 - log_ratio


def kl_to_base(new_log_prob: Tensor, old_log_prob: Tensor, base_log_prob: Tensor) -> Tensor:
    """KL(new || base) from samples of old, (B,), never negative [nats]; of log-probabilities (B,).

    With r = new / old and s = base / new it is r ((s - 1) - log s): its mean over samples of old is the
    divergence, and the mean of its gradient r (log new - log base) grad log new is the divergence's gradient.
    """
    ratio = bounded_log_ratio(new_log_prob, old_log_prob).exp()
    return ratio * approximate_kl(bounded_log_ratio(base_log_prob, new_log_prob))


def value_error(value: Tensor, old_value: Tensor, return_: Tensor, config: PPOConfig) -> Tensor:
    """Loss of each value, (B,): Huber or half squared error, the worse of clipped and unclipped if clipping."""

    def loss(prediction: Tensor) -> Tensor:
        if config.value_loss == "huber":
            return huber_loss(prediction, return_, reduction="none", delta=config.huber_delta)
        return 0.5 * (prediction - return_).square()

    if config.value_clip is None:
        return loss(value)
    clipped = old_value + (value - old_value).clamp(-config.value_clip, config.value_clip)
    return torch.maximum(loss(value), loss(clipped))


def explained_variance(values: np.ndarray, returns: np.ndarray) -> float:
    """Return 1 - Var[R - V] / Var[R]: 1 is a perfect critic, 0 one that knows the mean only."""
    variance = float(np.var(returns))
    return float("nan") if variance == 0 else 1 - float(np.var(returns - values)) / variance


class UpdateMetrics:
    """Means, weighted by the minibatches' sizes, and maxima."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._weights: dict[str, float] = {}
        self._maxima: dict[str, float] = {}

    def add_means(self, values: dict[str, float], weight: float = 1.0) -> None:
        """Let `values` count `weight` times."""
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value * weight
            self._weights[name] = self._weights.get(name, 0.0) + weight

    def add_maxima(self, values: dict[str, float]) -> None:
        """Keep the largest of each of `values`."""
        for name, value in values.items():
            self._maxima[name] = max(value, self._maxima.get(name, value))

    def result(self, ranks: Ranks) -> dict[str, float]:
        """Return the mean over the processes of their means, and the maxima of all."""
        together = UpdateMetrics()
        for means, maxima in ranks.gather((self._means(), self._maxima)):
            together.add_means(means)
            together.add_maxima(maxima)
        return together._means() | together._maxima

    def _means(self) -> dict[str, float]:
        return {name: total / self._weights[name] for name, total in self._sums.items()}


class BasePolicy:
    """The policy that a run began with; it shares all buffers and what is not trained with what it is now.

    Args:
        policy: a TrainablePolicy.
        params: those of its parameters that will be trained and that the actions depend on; copied.

    Attributes:
        parameters: the copies by the policy's names of them; a checkpoint holds them.
    """

    def __init__(self, policy: nn.Module, params: Sequence[Tensor]) -> None:
        wanted = {id(param) for param in params}
        own = {name: param for name, param in policy.named_parameters() if id(param) in wanted}
        self.parameters = {name: param.detach().clone() for name, param in own.items()}
        names = {id(param): name for name, param in own.items()}
        self._evaluate = _Evaluate(policy)
        # Each attribute of each module once, whatever names it has: a policy may stand twice within its adapters,
        # and swapping it twice would put the copies back in the end.
        self._attributes = {
            f"{module_name}.{name}": names[id(param)]
            for module_name, module in self._evaluate.named_modules()
            for name, param in module.named_parameters(recurse=False, remove_duplicate=False)
            if id(param) in wanted
        }

    @torch.no_grad()
    def log_prob(self, batch: Any, trace: Tensor, temperature: float) -> Tensor:
        """Log-probability of decisions, (B,) or (B, L) [nats]."""
        parameters = {attribute: self.parameters[name] for attribute, name in self._attributes.items()}
        arguments = (batch, trace, temperature)
        return functional_call(self._evaluate, parameters, arguments, tie_weights=False)

    def load(self, parameters: dict[str, Tensor]) -> None:
        """Go on with the parameters of a checkpoint."""
        for name, param in self.parameters.items():
            param.copy_(parameters[name])


class _Evaluate(nn.Module):
    """`functional_call` calls `forward`."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy: Any = policy

    def forward(self, batch: Any, trace: Tensor, temperature: float) -> Tensor:
        return self.policy.evaluate_actions(batch, trace, temperature=temperature)["log_prob"]
