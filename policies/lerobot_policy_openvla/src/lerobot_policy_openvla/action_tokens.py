"""The last tokens of the vocabulary as actions, and the distribution over them in sampling and in learning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


class ActionTokenizer:
    """The k-th bin of [-1, 1] is the k-th token from the end of the vocabulary, k = 1 .. bins.

    The bins lie between `bins` equally spaced points from -1 to 1, so there is one bin less than there are
    tokens: only an action of exactly 1 has k = bins, and it reads back as the last bin.

    Args:
        vocabulary_size: tokens of the real vocabulary (32000).
        bins: action tokens (256).
    """

    def __init__(self, vocabulary_size: int, bins: int) -> None:
        self.vocabulary_size, self.bins = vocabulary_size, bins
        edges = np.linspace(-1.0, 1.0, bins)
        self._edges = torch.from_numpy(edges)
        self._centres = torch.from_numpy((edges[:-1] + edges[1:]) / 2).float()

    @property
    def token_range(self) -> slice:
        """The action tokens, as a slice of the vocabulary."""
        return slice(self.vocabulary_size - self.bins, self.vocabulary_size)

    def encode(self, actions: Tensor) -> Tensor:
        """Return the tokens (...) int64 of normalised actions (...); beyond [-1, 1] it is the edge's."""
        clipped = actions.double().clamp(-1.0, 1.0)
        k = torch.bucketize(clipped, self._edges.to(actions.device), right=True)
        return self.vocabulary_size - k

    def decode(self, tokens: Tensor) -> Tensor:
        """Return the normalised actions (...) float32 at the centres of the tokens' bins."""
        bins = (self.vocabulary_size - tokens - 1).clamp(0, self.bins - 2)
        return self._centres.to(tokens.device)[bins]


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
        """Log-probability of every action token, (..., bins) [nats], at a temperature above 0."""
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
