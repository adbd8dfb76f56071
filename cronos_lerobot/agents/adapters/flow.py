"""Flow policies whose denoising becomes a stochastic chain: Flow-SDE (Flow-GRPO, Liu et al., 2025; pi_RL, 2025).

A flow policy integrates dx = v dt from noise (t = 1) to actions (t = 0); its answer to a noise is certain, so it
has no likelihood that can be computed. The stochastic differential equation

    dx = (v + s^2 / (2 t) (x + (1 - t) v)) dt + s dw,   s = noise_level * sqrt(t / (1 - t))

has the same marginals at every t, and its Euler steps are Gaussians. With noise_level 0 it is LeRobot's own
integration.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from cronos_lerobot.agents.adapters.chain import Scored, Step, chain_log_prob, sample_chain
from cronos_lerobot.agents.adapters.critic import Critic
from cronos_lerobot.agents.adapters.registry import Adapter, AdapterOptions
from cronos_lerobot.agents.base import Batch

FEATURES = "features"
"""What the critic reads, in a batch that `value_inputs` made."""


class FlowAdapter(Adapter):
    """A decision is the chain of a chunk, its trace (B, S + 1, H, D); a factor is one step of the chain.

    A subclass says what its policy makes of an observation (`observe`), which velocity it has (`velocity`), and
    which parameters are trained (`policy_parameters`).

    Args:
        policy: the LeRobot policy, on its device.
        options: of the noise.
        shape: (H, D) of the chunk as the network sees it, with padded dimensions.
        num_steps: S, as the policy's own integration has.
        feature_width: F, of what the critic reads.
    """

    def __init__(
        self, policy: Any, options: AdapterOptions, *, shape: tuple[int, int], num_steps: int, feature_width: int
    ) -> None:
        super().__init__(policy)
        self.decision_steps = policy.config.n_action_steps
        self.noise_level, self.num_steps, self.shape = options.noise_level, num_steps, shape
        self.scored = Scored(slice(self.decision_steps), policy.config.action_feature.shape[0])
        self.critic = Critic(feature_width).to(next(policy.parameters()).device)

    @abstractmethod
    def observe(self, batch: Batch) -> tuple[Any, Tensor]:
        """Return what `velocity` needs of an observation, any type, and the critic's features (B, F), detached."""

    @abstractmethod
    def velocity(self, context: Any, x: Tensor, time: Tensor) -> Tensor:
        """Return v (B, H, D) = noise - actions at x (B, H, D) and times (B,), which fall from 1 (noise) to 0."""

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
        """See `TrainablePolicy`; the temperature is a factor of the noise level, 0 is the policy's integration.

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
        step = self._step(context, temperature)
        chain, log_prob = sample_chain(step, noise, self.num_steps, self.scored, generator)
        actions = self.scored(chain[:, -1])
        return {"actions": actions, "trace": chain, "log_prob": log_prob, "value": self.critic(features)}

    def denoise(self, context: Any, noise: Tensor) -> Tensor:
        """See `Steerable`."""
        step, x = self._step(context, 0.0), noise
        for k in range(self.num_steps):
            x = step(k, x)[0]
        return self.scored(x)

    def evaluate_actions(
        self, batch: Batch, trace: Tensor, *, temperature: float = 1.0
    ) -> dict[str, Tensor | None]:
        """See `TrainablePolicy`; the chain's entropy does not depend on the policy."""
        context, features = self.observe(batch)
        log_prob = chain_log_prob(self._step(context, temperature), trace, self.scored)
        return {"log_prob": log_prob, "entropy": None, "value": self.critic(features)}

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

    def _step(self, context: Any, temperature: float) -> Step:
        """One Euler step of the equation above, from t to t + dt, dt = -1 / S."""
        dt = -1.0 / self.num_steps
        level = temperature * self.noise_level

        def step(k: int, x: Tensor) -> tuple[Tensor, Tensor]:
            t = 1.0 + k * dt
            time = torch.tensor(t, dtype=torch.float32, device=x.device)
            v = self.velocity(context, x, time.expand(len(x)))
            if level == 0:
                return x + dt * v, torch.zeros((), device=x.device)
            # At t = 1 the deviation has a pole; as in Flow-GRPO the step takes that of its end.
            s = level * (t / (1 - min(t, 1 + dt))) ** 0.5
            drift = v + s**2 / (2 * t) * (x + (1 - t) * v)
            return x + dt * drift, torch.tensor(s * (-dt) ** 0.5, device=x.device)

        return step
