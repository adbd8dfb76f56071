"""Policies that denoise a chunk of actions in a few steps, whatever the equation of a step."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from cronos_lerobot.agents.adapters.chain import Scored, Step, chain_log_prob, sample_chain
from cronos_lerobot.agents.adapters.registry import Adapter, Critic
from cronos_lerobot.agents.base import Batch

FEATURES = "features"
"""What the critic reads, in a batch that `value_inputs` made."""


class DenoisingAdapter(Adapter):
    """A decision is the chain of a chunk, its trace (B, S + 1, H, D); a factor is one step of the chain.

    A subclass says what its policy makes of an observation (`observe`), what a step of its denoising is (`step`),
    and which parameters are trained (`policy_parameters`).

    Args:
        policy: the LeRobot policy, on its device.
        shape: (H, D) of the chunk as the network sees it, with padded dimensions.
        num_steps: S, as the policy's own denoising has.
        first: step of the chunk that is played first; n_action_steps are.
        feature_width: F, of what the critic reads; None if the subclass has values of its own.

    Raises:
        ValueError: the policy is to play more actions than a chunk has.
    """

    def __init__(
        self, policy: Any, *, shape: tuple[int, int], num_steps: int, feature_width: int | None, first: int = 0
    ) -> None:
        super().__init__(policy)
        self.decision_steps = policy.config.n_action_steps
        self.num_steps, self.shape = num_steps, shape
        played = slice(first, first + self.decision_steps)
        if played.stop > shape[0]:
            raise ValueError(
                f"--policy.n_action_steps={self.decision_steps} is more than the {shape[0] - first} actions that"
                f" --policy.type={policy.config.type} decides on at once; take at most as many."
            )
        self.scored = Scored(played, policy.config.action_feature.shape[0])
        if feature_width is not None:
            self.critic = Critic(feature_width).to(next(policy.parameters()).device)

    @abstractmethod
    def observe(self, batch: Batch) -> tuple[Any, Tensor]:
        """Return what `step` needs of an observation, any type, and the critic's features (B, F), detached."""

    @abstractmethod
    def step(self, context: Any, temperature: float) -> Step:
        """Return the steps of the denoising; temperature 0 is the policy's own, without noise."""

    def values(self, batch: Batch, context: Any, features: Tensor) -> Tensor:
        """Return the values (B,) of a batch, of which `observe` returned `context` and `features`."""
        return self.critic(features)

    def features(self, batch: Batch) -> Tensor:
        """The critic's features alone (B, F), where they can be had for less."""
        return self.observe(batch)[1]

    def policy_parameters(self) -> list[torch.nn.Parameter]:
        """What the policy's loss trains."""
        return [param for param in self.policy.parameters() if param.requires_grad]

    def sample_actions(
        self,
        batch: Batch,
        *,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        noise: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """See `TrainablePolicy`; the temperature is a factor of the noise, 0 is the policy's own denoising.

        Args:
            batch: see `TrainablePolicy`.
            temperature: see above.
            generator: draws the chain.
            noise: x_0 (B, H, D) to begin with; None draws it.
        """
        context, features = self.observe(batch)
        if noise is None:
            noise = torch.randn(
                (len(features), *self.shape), generator=generator, device=features.device, dtype=torch.float32
            )
        end, trace, log_prob = self.draw(context, noise, temperature, generator)
        value = self.values(batch, context, features)
        return {"actions": self.scored(end), "trace": trace, "log_prob": log_prob, "value": value}

    def draw(
        self, context: Any, noise: Tensor, temperature: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return x_S (B, H, D), the trace and `log_prob` (B, L) of a denoising that begins with `noise`."""
        step = self.step(context, temperature)
        chain, log_prob = sample_chain(step, noise, self.num_steps, self.scored, generator)
        return chain[:, -1], chain, log_prob

    def judge(self, context: Any, trace: Tensor, temperature: float) -> Tensor:
        """Return, differentiably, `log_prob` (B, L) of a trace."""
        return chain_log_prob(self.step(context, temperature), trace, self.scored)

    def denoise(self, context: Any, noise: Tensor) -> Tensor:
        """See `Steerable`."""
        step, x = self.step(context, 0.0), noise
        for k in range(self.num_steps):
            x = step(k, x)[0]
        return self.scored(x)

    def evaluate_actions(
        self, batch: Batch, trace: Tensor, *, temperature: float = 1.0
    ) -> dict[str, Tensor | None]:
        """See `TrainablePolicy`; the chain's entropy does not depend on the policy."""
        context, features = self.observe(batch)
        log_prob = self.judge(context, trace, temperature)
        return {"log_prob": log_prob, "entropy": None, "value": self.values(batch, context, features)}

    def predict_values(self, batch: Batch) -> Tensor:
        """See `TrainablePolicy`."""
        return self.critic(batch[FEATURES] if FEATURES in batch else self.features(batch))

    def value_inputs(self, batch: Batch) -> Batch:
        """What the critic reads."""
        return {FEATURES: self.features(batch)}

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """See `TrainablePolicy`."""
        return [
            {"name": "policy", "params": self.policy_parameters()},
            {"name": "value", "params": [*self.critic.parameters()]},
        ]
