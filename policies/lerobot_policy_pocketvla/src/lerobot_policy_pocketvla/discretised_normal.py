"""Log-probability and entropy of a normal distribution on bins, without keeping a number for every bin.

PPO asks for both thousands of times, for (B, D, 256) bins that fit no cache; their gradients need four moments.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

IMPOSSIBLE = -1e4
"""Logit of a bin that the gripper never takes: finite, so that 0 * log(0) is 0 and not NaN."""
CHUNK_NUMBERS = 64 * 1024
"""Bins that are worked on at a time, so that they stay in a core's cache."""


class _DiscretisedNormal(torch.autograd.Function):
    """With d_k = (c_k - mean) / sigma of the bins' centres c_k, the probabilities are p = softmax(-d^2 / 2 T).

    Their moments m_j = E_p[d^j] give the gradients: of log p_t it is (d_t - m_1) / sigma T by the mean and
    (d_t^2 - m_2) / sigma T by sigma; of the entropy (m_3 - m_1 m_2) / 2 sigma T^2 and (m_4 - m_2^2) / 2 sigma T^2.
    """

    @staticmethod
    def forward(
        ctx: Any, mean: Tensor, sigma: Tensor, tokens: Tensor, centres: Tensor, temperature: float
    ) -> tuple[Tensor, Tensor]:
        """See `discretised_normal`."""
        sigma = sigma.expand_as(mean)
        rows = (mean.reshape(-1, 1), sigma.reshape(-1, 1), tokens.reshape(-1, 1))
        size = max(1, CHUNK_NUMBERS // len(centres))
        chunks = [
            _log_prob_and_moments(m, s, t, centres, temperature)
            for m, s, t in zip(*(row.split(size) for row in rows), strict=True)
        ]
        log_prob, log_sum, *saved = (torch.cat(parts).view_as(mean) for parts in zip(*chunks, strict=True))
        ctx.save_for_backward(sigma, *saved)
        ctx.temperature = temperature
        second_moment = saved[2]
        return log_prob, log_sum + 0.5 * second_moment / temperature

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_log_prob: Tensor, grad_entropy: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients by `mean` and `sigma`."""
        sigma, d, m1, m2, m3, m4 = ctx.saved_tensors
        temperature = ctx.temperature
        per_log_prob, per_entropy = grad_log_prob / (sigma * temperature), grad_entropy / (sigma * temperature**2)
        by_mean = per_log_prob * (d - m1) + 0.5 * per_entropy * (m3 - m1 * m2)
        by_sigma = per_log_prob * (d.square() - m2) + 0.5 * per_entropy * (m4 - m2.square())
        return by_mean, by_sigma.sum_to_size(sigma.shape[-1:]), None, None, None


def _log_prob_and_moments(
    mean: Tensor, sigma: Tensor, token: Tensor, centres: Tensor, temperature: float
) -> tuple[Tensor, ...]:
    """Of (n, 1) distributions, each (n,): log p of the token, log of the sum, d of the token, four moments."""
    d = (centres - mean) / sigma
    logits = d.square().mul_(-0.5 / temperature)
    highest = logits.amax(-1, keepdim=True)
    p = logits.sub(highest).exp_()
    total = p.sum(-1, keepdim=True)
    log_sum = total.log() + highest
    p.div_(total)
    moments = [p.mul_(d).sum(-1) for _ in range(4)]
    log_prob = logits.gather(-1, token) - log_sum
    return log_prob.squeeze(-1), log_sum.squeeze(-1), d.gather(-1, token).squeeze(-1), *moments


def discretised_normal(
    mean: Tensor, sigma: Tensor, tokens: Tensor, centres: Tensor, temperature: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Log-probability of bins and entropy of their distribution [nats], each (B, D), differentiable once.

    The probability of a bin is proportional to N(its centre; mean, sigma) to the power of 1 / temperature.

    Args:
        mean: (B, D).
        sigma: (D,), above 0.
        tokens: (B, D) int64, the bins.
        centres: (K,), of the bins.
        temperature: above 0.
    """
    return _DiscretisedNormal.apply(mean, sigma, tokens, centres, temperature)


def two_points(
    sign_logit: Tensor, tokens: Tensor, num_bins: int, temperature: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Log-probability of bins and entropy [nats], each (B,), where only the first and the last are possible.

    Args:
        sign_logit: (B,), the log-odds of the last bin at temperature 1.
        tokens: (B,) int64; another bin than these two has a logit of -1e4.
        num_bins: how many bins there are.
        temperature: above 0.
    """
    logits = torch.stack((-0.5 * sign_logit, 0.5 * sign_logit, torch.full_like(sign_logit, IMPOSSIBLE)), dim=-1)
    log_probs = torch.log_softmax(logits / temperature, dim=-1)
    which = 2 - 2 * (tokens == 0).long() - (tokens == num_bins - 1).long()
    log_prob = log_probs.gather(-1, which[:, None]).squeeze(-1)
    return log_prob, -(log_probs.exp() * log_probs).sum(-1)
