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

from cronos_lerobot.agents.adapters.chain import Step, sample_chain, step_log_prob
from cronos_lerobot.agents.adapters.denoising import DenoisingAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions


class FlowAdapter(DenoisingAdapter):
    """See `DenoisingAdapter`; a subclass says which velocity its policy has (`velocity`).

    With `noise_steps` J < S, only J steps of a decision have noise, drawn anew for each; the others are the
    policy's own. An update then differentiates J evaluations of the network in place of S (pi_RL's mixed steps).

    Args:
        policy: the LeRobot policy, on its device.
        options: of the noise.
        shape: (H, D) of the chunk as the network sees it, with padded dimensions.
        num_steps: S, as the policy's own integration has.
        feature_width: F, of what the critic reads; None if the subclass has values of its own.

    Raises:
        ValueError: noise at more steps than there are.
    """

    options_read = frozenset({"noise_level", "noise_steps"})

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
        self.noise_steps = num_steps if options.noise_steps is None else options.noise_steps
        if self.noise_steps > num_steps:
            raise ValueError(
                f"--algorithm.noise_steps={self.noise_steps}, but the policy denoises in {num_steps} steps: give "
                f"{num_steps} or fewer, or null for all."
            )

    @abstractmethod
    def velocity(self, context: Any, x: Tensor, time: Tensor) -> Tensor:
        """Return v (B, H, D) = noise - actions at x (B, H, D) and times (B,), which fall from 1 (noise) to 0."""

    def step(self, context: Any, temperature: float, noisy: Tensor | None = None) -> Step:
        """Euler steps of the equation above, from t to t + dt, dt = -1 / S.

        Args:
            context: of `observe`.
            temperature: factor of the noise level.
            noisy: (B, S) bool, which steps of a row have noise; None is all.
        """
        dt = -1.0 / self.num_steps
        device = next(self.policy.parameters()).device
        tables = self._tables(temperature * self.noise_level).to(device)

        def step(k: Any, x: Tensor) -> tuple[Tensor, Tensor]:
            t, past, pull, std = tables[:, k].reshape(4, -1, 1, 1)
            if noisy is not None:
                here = noisy[:, k].reshape(-1, 1, 1)
                pull, std = pull * here, std * here
            v = self.velocity(context, x, t.flatten().expand(len(x)))
            return x + dt * (v + pull * (x + past * v)), std

        return step

    def draw(
        self, context: Any, noise: Tensor, temperature: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `DenoisingAdapter`.

        With `noise_steps` J < S the trace is (B, J, 2 H + 1, D): x before and after each step with noise, and a
        row that is the step's number.
        """
        if self.noise_steps == self.num_steps:
            return super().draw(context, noise, temperature, generator)
        size = (len(noise), self.num_steps)
        order = torch.rand(size, generator=generator, device=noise.device).argsort(dim=1)
        numbers = order[:, : self.noise_steps].sort(dim=1).values
        noisy = torch.zeros(size, dtype=torch.bool, device=noise.device).scatter_(1, numbers, True)
        step = self.step(context, temperature, noisy)
        chain, log_prob = sample_chain(step, noise, self.num_steps, self.scored, generator)
        rows = torch.arange(len(noise), device=noise.device)[:, None]
        label = numbers[..., None, None].expand(-1, -1, 1, self.shape[1]).to(noise)
        trace = torch.cat([chain[rows, numbers], chain[rows, numbers + 1], label], dim=2)
        return chain[:, -1], trace, log_prob.gather(1, numbers)

    def judge(self, context: Any, trace: Tensor, temperature: float) -> Tensor:
        """See `DenoisingAdapter`; steps without noise are not looked at."""
        if self.noise_steps == self.num_steps:
            return super().judge(context, trace, temperature)
        step, height = self.step(context, temperature), self.shape[0]
        log_probs = []
        for x in trace.unbind(1):
            mean, std = step(x[:, -1, 0].long(), x[:, :height])
            log_probs.append(step_log_prob(mean, std, x[:, height:-1], self.scored))
        return torch.stack(log_probs, 1)

    def _tables(self, level: float) -> Tensor:
        """(4, S): t, 1 - t, s^2 / (2 t) and the deviation of each step's noise."""
        dt = -1.0 / self.num_steps
        columns = []
        for k in range(self.num_steps):
            t = 1.0 + k * dt
            # At t = 1 the deviation has a pole; as in Flow-GRPO the step takes that of its end.
            s = level * (t / (1 - min(t, 1 + dt))) ** 0.5
            columns.append((t, 1 - t, s**2 / (2 * t), s * (-dt) ** 0.5))
        return torch.tensor(columns, dtype=torch.float32).T
