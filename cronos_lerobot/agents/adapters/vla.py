"""Vision-language-action policies with a flow head: what SmolVLA, pi0 and pi0.5 have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from cronos_lerobot.agents.adapters.flow import FlowAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions
from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.weights import unwrapped


@dataclass(frozen=True)
class Prefix:
    """Images and instruction as the vision-language model reads them, once for an observation."""

    hidden: Tensor
    """(B, L, D), its last hidden states."""
    mask: Tensor
    """(B, L) bool, which of the L tokens are no padding."""
    cache: Any
    """Keys and values of its layers."""
    given: dict[str, Tensor] = field(default_factory=dict)
    """What else LeRobot's `denoise_step` takes."""


class VLAAdapter(FlowAdapter):
    """A decision is the chain of a chunk; a critic on the vision-language model's output and the robot's state.

    The critic reads the mean of the last hidden states, as in pi_RL (Chen et al., 2025) that of pi0.5; that of
    pi0 there reads the action expert instead, because the prefix does not have the state, which it gets here
    beside it: a value then costs no denoising. What LeRobot's config or PEFT freezes stays frozen; the prefix has
    a gradient only if one of its parameters has.

    Args:
        policy: the LeRobot policy on its device, PEFT's wrapper around it perhaps.
        options: of the noise.
        num_steps: of the denoising.
        width: D, of the vision-language model.
    """

    def __init__(self, policy: Any, options: AdapterOptions, *, num_steps: int, width: int) -> None:
        config = policy.config
        state = config.input_features[OBS_STATE].shape[0]
        shape = (config.chunk_size, config.max_action_dim)
        super().__init__(policy, options, shape=shape, num_steps=num_steps, feature_width=width + state)

    @abstractmethod
    def read(self, batch: Batch) -> Prefix:
        """Return what the vision-language model makes of an observation."""

    @abstractmethod
    def prefix_parameters(self) -> Iterable[nn.Parameter]:
        """What `read` depends on."""

    @property
    def lerobot_policy(self) -> Any:
        """The LeRobot policy, without PEFT's wrapper."""
        return unwrapped(self.policy)

    def observe(self, batch: Batch) -> tuple[Prefix, Tensor]:
        """See `FlowAdapter`."""
        trained = any(param.requires_grad for param in self.prefix_parameters())
        with torch.set_grad_enabled(trained and torch.is_grad_enabled()):
            prefix = self.read(batch)
        mask = prefix.mask[..., None]
        mean = (prefix.hidden.detach().float() * mask).sum(1) / mask.sum(1)
        return prefix, torch.cat([mean, batch[OBS_STATE]], dim=1)

    def velocity(self, context: Prefix, x: Tensor, time: Tensor) -> Tensor:
        """See `FlowAdapter`."""
        return self.lerobot_policy.model.denoise_step(
            prefix_pad_masks=context.mask, past_key_values=context.cache, x_t=x, timestep=time, **context.given
        )

    @torch.no_grad()
    def features(self, batch: Batch) -> Tensor:
        """See `FlowAdapter`."""
        return self.observe(batch)[1]
