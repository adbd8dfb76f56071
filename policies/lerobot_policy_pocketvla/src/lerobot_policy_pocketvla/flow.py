"""The flow head: the velocity that carries noise to a chunk of actions (flow matching, Lipman et al., 2023)."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

TIME_WIDTH = 32
TIME_PERIODS = (0.1, 4.0)
"""Shortest and longest period of the time's sines and cosines; times lie in [0, 1]."""


def time_embedding(time: Tensor) -> Tensor:
    """Sines and cosines of times (B,) with periods between TIME_PERIODS, (B, TIME_WIDTH)."""
    shortest, longest = (math.log(period) for period in TIME_PERIODS)
    periods = torch.linspace(shortest, longest, TIME_WIDTH // 2, device=time.device, dtype=time.dtype).exp()
    angles = 2 * math.pi * time[:, None] / periods
    return torch.cat((angles.sin(), angles.cos()), dim=-1)


class ModulatedBlock(nn.Module):
    """A residual block of two layers, its hidden one scaled and shifted by the condition (Perez et al., 2018)."""

    def __init__(self, width: int) -> None:
        """Build the layers."""
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.enter = nn.Linear(width, width)
        self.modulate = nn.Linear(width, 2 * width)
        self.leave = nn.Linear(width, width)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Map x (B, width) under the condition (B, width) to (B, width)."""
        scale, shift = self.modulate(condition).chunk(2, dim=-1)
        hidden = F.silu(self.enter(self.norm(x)) * (1.0 + scale) + shift)
        return x + self.leave(hidden)


class FlowHead(nn.Module):
    """Velocity of a chunk at a time, given the features of an observation; 0 at the start.

    Args:
        features: width of the observation's features.
        shape: (H, D) of the chunk.
        width: of the layers.
        depth: number of residual blocks.
    """

    def __init__(self, features: int, shape: tuple[int, int], width: int, depth: int) -> None:
        """Build the layers."""
        super().__init__()
        self.shape = shape
        numbers = shape[0] * shape[1]
        self.from_features = nn.Linear(features, width)
        self.from_time = nn.Linear(TIME_WIDTH, width)
        self.from_chunk = nn.Linear(numbers, width)
        self.blocks = nn.ModuleList(ModulatedBlock(width) for _ in range(depth))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, numbers)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Features (B, F), chunks (B, H, D) and times (B,), 1 noise to 0 actions, to velocities (B, H, D)."""
        condition = F.silu(self.from_features(features) + self.from_time(time_embedding(time)))
        hidden = self.from_chunk(x.flatten(1)) + condition
        for block in self.blocks:
            hidden = block(hidden, condition)
        return self.out(self.norm(hidden)).unflatten(-1, self.shape)
