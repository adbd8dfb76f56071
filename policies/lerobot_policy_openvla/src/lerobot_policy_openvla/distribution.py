"""The distribution over the action tokens, the same for sampling and for learning."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class TokenDistribution:
    """Softmax over the action tokens alone, whatever the rest of the vocabulary's logits are."""

    logits: Tensor
    """(..., V) float32, of the whole vocabulary."""
    tokens: slice
    """The action tokens."""
    temperature: float
    """Divides the logits; 0 is a point at the likeliest token."""

    @property
    def _action_logits(self) -> Tensor:
        return self.logits[..., self.tokens]

    def log_probs(self) -> Tensor:
        """Log-probability of every action token, (..., bins) [nats].

        Raises:
            ValueError: the temperature is not above 0.
        """
        if not self.temperature > 0:
            raise ValueError(f"temperature must be above 0 for a log-probability, got {self.temperature}")
        return torch.log_softmax(self._action_logits / self.temperature, dim=-1)

    def quantile(self, uniform: Tensor) -> Tensor:
        """Return the tokens (...) at the quantiles `uniform` (...) in [0, 1): uniform numbers make a sample."""
        if self.temperature == 0:
            return self._action_logits.argmax(dim=-1) + self.tokens.start
        cumulative = self.log_probs().exp().cumsum(dim=-1)
        # The sum differs from 1 by rounding; without this, a number close to 1 would fall beyond the last token.
        threshold = uniform.to(cumulative.dtype) * cumulative[..., -1]
        index = torch.searchsorted(cumulative, threshold.unsqueeze(-1), right=True).squeeze(-1)
        return index.clamp(max=cumulative.shape[-1] - 1) + self.tokens.start

    def log_prob(self, tokens: Tensor) -> Tensor:
        """Log-probability of tokens (..., A), summed over the A of an action, (...); 0 at temperature 0."""
        if self.temperature == 0:
            return torch.zeros(tokens.shape[:-1], device=tokens.device)
        index = tokens - self.tokens.start
        return self.log_probs().gather(-1, index.unsqueeze(-1)).squeeze(-1).sum(dim=-1)

    def entropy(self) -> Tensor:
        """Mean over the A tokens of an action of their entropy, (...) [nats]."""
        log_probs = self.log_probs()
        return -(log_probs.exp() * log_probs).sum(dim=-1).mean(dim=-1)
