"""PocketVLA with a flow head: a chunk of actions, integrated from noise (flow matching, Lipman et al., 2023)."""

import math
from collections import deque
from typing import Any, Literal

import torch
from lerobot.policies.common.flow_matching import euler_integrate, sample_noise, sample_time_beta
from lerobot.utils.constants import ACTION
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from lerobot_policy_pocketvla.action_bounds import JOINTS
from lerobot_policy_pocketvla.modeling_pocketvla import Batch, PocketVLAPolicy

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


CHUNK_BATCHES = 100
"""Batches of cloning that say how chunks are spread."""
MIN_DEVIATION = 1e-3
"""Of a number of a chunk, in normalised units: what hardly moved is not blown up."""


class RelativeChunks(nn.Module):
    """Chunks relative to where the joints are, each number with mean 0 and deviation 1 in the demonstrations.

    Noise of one size for the whole chunk then moves its first target, which is near the joints, by little, and the
    later ones by more.

    Args:
        shape: (H, D) of the chunk.
    """

    mean: Tensor
    square: Tensor
    batches: Tensor

    def __init__(self, shape: tuple[int, int]) -> None:
        """Begin with mean 0 and deviation 1."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("square", torch.ones(shape))
        self.register_buffer("batches", torch.zeros((), dtype=torch.long))

    def count_in(self, actions: Tensor, joints: Tensor, valid: Tensor) -> None:
        """Let mean and deviation be those of the first batches: actions (B, H, D), joints (B, D), valid (B, H)."""
        if self.batches < CHUNK_BATCHES:
            weights = (valid / valid.sum(0).clamp(min=1.0))[..., None]
            relative = actions - joints[:, None]
            self.batches += 1
            self.mean += ((weights * relative).sum(0) - self.mean) / self.batches
            self.square += ((weights * relative.square()).sum(0) - self.square) / self.batches

    def from_actions(self, actions: Tensor, joints: Tensor) -> Tensor:
        """Normalised actions (B, H, D) at joints (B, D) to relative chunks (B, H, D)."""
        return (actions - joints[:, None] - self.mean) / self._deviation()

    def to_actions(self, chunks: Tensor, joints: Tensor) -> Tensor:
        """The inverse of `from_actions`."""
        return chunks * self._deviation() + self.mean + joints[:, None]

    def _deviation(self) -> Tensor:
        return (self.square - self.mean.square()).clamp(min=MIN_DEVIATION**2).sqrt()


class PocketVLAFlowPolicy(PocketVLAPolicy, heads=("flow",)):
    """Predicts a velocity v = noise - actions on the way x = t noise + (1 - t) actions, as LeRobot's SmolVLA does.

    A chunk of H actions is decided on at once, and n of them are played. It says of no chunk how likely it was;
    a trainer that makes a stochastic chain of the integration finds what it needs in `flow_context`,
    `flow_velocity` and `flow_actions`.
    """

    head: FlowHead

    def __init__(self, config: Any, **kwargs: Any) -> None:
        """Build the networks."""
        super().__init__(config, **kwargs)
        self.chunks = RelativeChunks(config.chunk_shape).to(config.device) if config.joints else None
        self.reset()

    def _build_head(self) -> FlowHead:
        config = self.config
        return FlowHead(config.hidden_width, config.chunk_shape, config.flow_width, config.flow_depth)

    def forward(
        self,
        batch: Batch,
        reduction: Literal["mean", "none"] = "mean",
        noise: Tensor | None = None,
        time: Tensor | None = None,
    ) -> tuple[Tensor, dict[str, float]]:
        """Behaviour cloning: squared error of the velocity at a random time, mean over the chunk's numbers.

        Args:
            batch: with `action` (B, H, D), normalised, and `action_is_pad` (B, H) if some actions are padding.
            reduction: `mean` over the actions that are not padding, or `none`.
            noise: (B, H, D) with a `time` (B,); None draws `flow_draws` for each sample, noisy times more often
                (LeRobot's beta distribution).
            time: see there.

        Returns:
            The loss, a scalar or (B,), the mean of each sample's actions that are not padding, and numbers for the
            log.
        """
        actions = batch[ACTION].float().clamp(-1.0, 1.0)
        valid = torch.ones_like(actions[..., 0])
        if "action_is_pad" in batch:
            valid = 1.0 - batch["action_is_pad"].to(actions.dtype)
        if self.chunks:
            if self.training:
                self.chunks.count_in(actions, batch[JOINTS], valid)
            actions = self.chunks.from_actions(actions, batch[JOINTS])
        draws = self.config.flow_draws if noise is None else 1
        repeated = actions.repeat(draws, 1, 1)
        if noise is None or time is None:
            noise = sample_noise(repeated.shape, actions.device)
            time = sample_time_beta(len(repeated), actions.device, alpha=1.5, beta=1.0, scale=0.999, offset=0.001)
        t = time[:, None, None]
        with self._full_precision():
            features, taught, metrics = self._cloning_features(batch)
            velocity = self.head(features.repeat(draws, 1), t * noise + (1 - t) * repeated, time)
        errors = (velocity - (noise - repeated)).square().mean(-1).unflatten(0, (draws, -1)).mean(0)
        errors = errors * valid
        if reduction == "none":
            return errors.sum(1) / valid.sum(1).clamp(min=1.0) + taught, metrics
        return errors.sum() / valid.sum().clamp(min=1.0) + taught.mean(), metrics

    @torch.no_grad()
    def predict_action_chunk(self, batch: Batch, noise: Tensor | None = None, **_: Any) -> Tensor:
        """Integrate chunks (B, H, D), normalised, not clipped; the critic's inputs are not needed.

        Args:
            batch: observations and `task`.
            noise: to begin with, (B, H, D); None draws it from torch's global generator.
        """
        context = self.flow_context(batch)
        if noise is None:
            noise = sample_noise((len(context), *self.head.shape), context.device)
        chunks = euler_integrate(
            lambda x, time: self.flow_velocity(context, x, time), noise, self.config.num_inference_steps
        )
        return self.flow_actions(context, chunks)

    @torch.no_grad()
    def select_action(self, batch: Batch, noise: Tensor | None = None, **_: Any) -> Tensor:
        """Return the next action of the chunk (B, D), normalised; a new chunk where none is left.

        The queue is of the whole batch: `reset` clears it.
        """
        if not self._queue:
            chunk = self.predict_action_chunk(batch, noise)[:, : self.config.n_action_steps]
            self._queue.extend(chunk.transpose(0, 1))
        return self._queue.popleft()

    def reset(self) -> None:
        """Forget what is left of the chunk."""
        self._queue: deque[Tensor] = deque()

    # What a trainer that makes a stochastic chain of the integration needs.

    def flow_context(self, batch: Batch) -> Tensor:
        """What velocity and actions need of observations, differentiable.

        (B, hidden_width), and where the joints are, (B, D), if chunks are relative to them.
        """
        with self._full_precision():
            features = self._features(batch)
        return torch.cat((features, batch[JOINTS]), dim=-1) if self.chunks else features

    def flow_velocity(self, context: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """Velocities (B, H, D) of chunks x (B, H, D) at times (B,), 1 noise to 0 actions, differentiable."""
        with self._full_precision():
            return self.head(context[:, : self.config.hidden_width], x, time)

    def flow_actions(self, context: Tensor, x: Tensor) -> Tensor:
        """Normalised actions (B, H, D) that a chunk x (B, H, D) at time 0 stands for."""
        return self.chunks.to_actions(x, context[:, self.config.hidden_width :]) if self.chunks else x
