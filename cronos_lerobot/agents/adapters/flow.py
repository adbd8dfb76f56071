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

from cronos_lerobot.agents.adapters.chain import Step
from cronos_lerobot.agents.adapters.denoising import DenoisingAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions


class FlowAdapter(DenoisingAdapter):
    """See `DenoisingAdapter`; a subclass says which velocity its policy has (`velocity`).

    Args:
        policy: the LeRobot policy, on its device.
        options: of the noise.
        shape: (H, D) of the chunk as the network sees it, with padded dimensions.
        num_steps: S, as the policy's own integration has.
        feature_width: F, of what the critic reads; None if the subclass has values of its own.
    """

    def __init__(
        self,
        policy: Any,
        options: AdapterOptions,
        *,
        shape: tuple[int, int],
        num_steps: int,
        feature_width: int | None,
    ) -> None:
        super().__init__(policy, shape=shape, num_steps=num_steps, feature_width=feature_width)
        self.noise_level = options.noise_level

    @abstractmethod
    def velocity(self, context: Any, x: Tensor, time: Tensor) -> Tensor:
        """Return v (B, H, D) = noise - actions at x (B, H, D) and times (B,), which fall from 1 (noise) to 0."""

    def step(self, context: Any, temperature: float) -> Step:
        """Euler steps of the equation above, from t to t + dt, dt = -1 / S."""
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
