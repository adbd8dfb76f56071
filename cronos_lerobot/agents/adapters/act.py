"""ACT (Zhao et al., 2023) with a learned Gaussian around its chunk."""

from __future__ import annotations

import math
from typing import Any

import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor, nn
from torch.distributions import Normal

from cronos_lerobot.agents.adapters.registry import AdapterOptions, CriticAdapter, register_adapter
from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.weights import unwrapped

LOG_STD_RANGE = (-5.0, 1.0)
"""Of the deviation's logarithm [nats]; where a step of the optimizer leads beyond, it ends there."""


@register_adapter("act")
class ACTAdapter(CriticAdapter):
    """A decision is the first n_action_steps of the chunk, each drawn around ACT's; a factor is one action.

    ACT's latent is 0, as when it acts. The deviation is one number for each action dimension, learned. The critic
    reads the mean of the encoder's tokens and the vectors of the observation; the value loss does not train ACT.

    Args:
        policy: an ACTPolicy on its device, PEFT's wrapper around it perhaps.
        options: of the noise.

    Raises:
        ValueError: the policy ensembles its chunks over time, or the noise is beyond what is learned.
    """

    def __init__(self, policy: Any, options: AdapterOptions) -> None:
        config = policy.config
        if config.temporal_ensemble_coeff is not None:
            raise ValueError(
                f"--policy.temporal_ensemble_coeff={config.temporal_ensemble_coeff} mixes an action from many "
                "chunks, whose likelihood is not known: train with --policy.temporal_ensemble_coeff=null."
            )
        low, high = (round(math.exp(end), 4) for end in LOG_STD_RANGE)
        if not low <= options.noise_std <= high:
            raise ValueError(
                f"--algorithm.noise_std must be {low} to {high} for --policy.type=act, which learns it between "
                f"them, got {options.noise_std}."
            )
        vectors = [name for name in (OBS_STATE, OBS_ENV_STATE) if name in config.input_features]
        super().__init__(policy, config.dim_model + sum(config.input_features[name].shape[0] for name in vectors))
        self.decision_steps, self._vectors = config.n_action_steps, vectors
        device = next(policy.parameters()).device
        std = torch.full(config.action_feature.shape, options.noise_std, device=device)
        self.log_std = nn.Parameter(std.log())

    def sample_actions(
        self, batch: Batch, *, temperature: float = 1.0, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """See `TrainablePolicy`; the trace is the actions, `log_prob` (B, n). Temperature 0 is ACT's own chunk."""
        mean, features = self._forward(batch)
        value = self.critic(features)
        if temperature == 0:
            return {"actions": mean, "trace": mean, "log_prob": torch.zeros_like(mean[..., 0]), "value": value}
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        actions = mean + temperature * self._std * noise
        log_prob = Normal(mean, temperature * self._std).log_prob(actions).sum(-1)
        return {"actions": actions, "trace": actions, "log_prob": log_prob, "value": value}

    def evaluate_actions(
        self, batch: Batch, trace: Tensor, *, temperature: float = 1.0
    ) -> dict[str, Tensor | None]:
        """See `TrainablePolicy`."""
        mean, features = self._forward(batch)
        distribution = Normal(mean, temperature * self._std)
        return {
            "log_prob": distribution.log_prob(trace).sum(-1),
            "entropy": distribution.entropy().mean((1, 2)),
            "value": self.critic(features),
        }

    def features(self, batch: Batch) -> Tensor:
        """See `CriticAdapter`."""
        return self._forward(batch)[1]

    def policy_parameters(self) -> list[nn.Parameter]:
        """What of ACT is trained, but not the encoder of its latent, which acting does not use; the noise."""
        named = self.policy.named_parameters()
        return [*(p for name, p in named if p.requires_grad and ".vae_encoder" not in name), self.log_std]

    @property
    def _std(self) -> Tensor:
        # Not the clamped value alone: that has no gradient to come back with.
        with torch.no_grad():
            self.log_std.clamp_(*LOG_STD_RANGE)
        return self.log_std.exp()

    def _forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """The first actions of ACT's chunk (B, n, A), and what the critic reads (B, F), without gradient."""
        batch = dict(batch)
        if self.config.image_features:
            batch[OBS_IMAGES] = [batch[key] for key in self.config.image_features]
        encoded: list[Tensor] = []
        # `model` of PEFT's wrapper is the policy, not its network.
        network = unwrapped(self.policy).model
        handle = network.encoder.register_forward_hook(lambda _, __, tokens: encoded.append(tokens))
        try:
            chunk = network(batch)[0]
        finally:
            handle.remove()
        vectors = [batch[name] for name in self._vectors]
        # Tokens come first in LeRobot's ACT: (S, B, D).
        features = torch.cat([encoded[0].mean(0), *vectors], dim=1).detach()
        return chunk[:, : self.decision_steps], features
