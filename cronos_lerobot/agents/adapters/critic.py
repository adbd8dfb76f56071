"""The critic of adapters."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Critic(nn.Module):
    """Features (B, F) to values (B,), 0 at the start.

    Args:
        features: F.
        width: of the two hidden layers.
    """

    def __init__(self, features: int, width: int = 256) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(features), nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, 1),
        )  # fmt: skip
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, features: Tensor) -> Tensor:
        """See above."""
        return self.layers(features.to(torch.float32)).squeeze(-1)
