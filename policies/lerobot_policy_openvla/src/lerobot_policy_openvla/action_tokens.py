"""Between normalised actions and the last tokens of the vocabulary."""

from __future__ import annotations

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
        if not 1 < bins < vocabulary_size:
            raise ValueError(f"bins must be 2 to {vocabulary_size - 1}, got {bins}.")
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
