"""Flow policies whose denoising becomes a stochastic chain, which has a likelihood (Flow-GRPO, Liu et al., 2025).

A flow policy integrates dx = v dt from noise (t = 1) to actions (t = 0). Its answer to a noise is certain, so it
has no likelihood. Here a step from t to t' < t takes the policy's own estimates of the actions, a = x - t v, and
of the noise, e = x + (1 - t) v, and draws a part of the noise anew:

    x' = (1 - t') a + sqrt(t'^2 - s^2) e + s z,   z ~ N(0, 1)
    s = eta t' sqrt(1 - (t' (1 - t) / (t (1 - t')))^2)

This is DDIM's step (Song et al., 2021) for x = (1 - t) a + t e; eta is `noise_level`. Eta 0 is LeRobot's Euler
step, eta 1 the posterior of the forward process (DDPM). Every x' has (1 - t') of the actions and t' of the noise,
however few the steps are, so the last one, t' = 0, adds no noise. In the limit of small steps it is Flow-SDE's
equation with s = eta sqrt(2 t / (1 - t)). Its Euler steps would add eta sqrt(2 / (S (S - 1))) to the actions: with
five steps its marginals are not the flow's.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from cronos_lerobot.agents.adapters.denoising import DenoisingAdapter, Step, sample_chain, step_log_prob
from cronos_lerobot.agents.adapters.registry import AdapterOptions


class FlowAdapter(DenoisingAdapter):
    """See `DenoisingAdapter`; a subclass says which velocity its policy has (`velocity`).

    The last of the S steps has no noise, so it has no likelihood: a trace is (B, S, H, D), `log_prob` (B, S - 1).
    With `noise_steps` J < S - 1, only J steps of a decision have noise, drawn anew for each. An update then
    differentiates J evaluations of the network instead of S - 1 (pi_RL's mixed steps).

    With `noise_repeat` no step has noise. One action's noise, of deviation `noise_std`, is added to every action
    of the denoised chunk. The likelihood is that of the mean of the played actions: A numbers for a decision
    instead of (S - 1) n A, so an advantage says more of each. A trace is (B, H + 1, D): the noise that the
    denoising began with, and the drawn mean. `log_prob` is (B, 1).

    Args:
        policy: see `DenoisingAdapter`, as the others.
        options: of the noise.
        shape: (H, D) of the chunk.
        num_steps: S.
        feature_width: F.

    Raises:
        ValueError: noise at more steps than can have it.
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
        self.noise_repeat, self.noise_std = options.noise_repeat, options.noise_std
        self.noise_steps = num_steps - 1 if options.noise_steps is None else options.noise_steps
        if not 0 < self.noise_steps < num_steps:
            raise ValueError(
                f"--algorithm.noise_steps must be 1 to {num_steps - 1}, got {self.noise_steps}: of the policy's "
                f"{num_steps} steps (--policy.num_inference_steps) the last has no noise."
            )

    @abstractmethod
    def velocity(self, context: Any, x: Tensor, time: Tensor) -> Tensor:
        """Return v (B, H, D) = noise - actions at x (B, H, D) and times (B,), which fall from 1 (noise) to 0."""

    def step(self, context: Any, temperature: float, noisy: Tensor | None = None) -> Step:
        """The steps above, from t to t' = t - 1 / S.

        Args:
            context: of `observe`.
            temperature: factor of the noise level, which ends at 1.
            noisy: (B, S) bool, which steps of a row have noise; None is all but the last.
        """
        dt = -1.0 / self.num_steps
        device = next(self.policy.parameters()).device
        tables = self._tables(min(1.0, temperature * self.noise_level)).to(device)

        def step(k: Any, x: Tensor) -> tuple[Tensor, Tensor]:
            t, past, change, std = tables[:, k].reshape(4, -1, 1, 1)
            if noisy is not None:
                here = noisy[:, k].reshape(-1, 1, 1)
                change, std = change * here, std * here
            v = self.velocity(context, x, t.flatten().expand(len(x)))
            return x + dt * v + change * (x + past * v), std

        return step

    def draw(
        self, context: Any, noise: Tensor, temperature: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `DenoisingAdapter`.

        With `noise_steps` J < S - 1 the trace is (B, J, 2 H + 1, D): x before and after each step with noise, and
        a row that is the step's number.
        """
        if self.noise_repeat:
            end = self.integrate(context, noise)
            mean, std = self._played_mean(end), self._std(temperature, end)
            drawn = mean + std * torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
            log_prob = step_log_prob(mean, std, drawn, self.scored)
            return end + (drawn - mean), torch.cat((noise, drawn), dim=1), log_prob[:, None]
        if self.noise_steps == self.num_steps - 1:
            end, chain, log_prob = super().draw(context, noise, temperature, generator)
            return end, chain[:, :-1], log_prob[:, :-1]
        size = (len(noise), self.num_steps - 1)
        order = torch.rand(size, generator=generator, device=noise.device).argsort(dim=1)
        numbers = order[:, : self.noise_steps].sort(dim=1).values
        noisy = torch.zeros((len(noise), self.num_steps), dtype=torch.bool, device=noise.device)
        step = self.step(context, temperature, noisy.scatter_(1, numbers, True))
        chain, log_prob = sample_chain(step, noise, self.num_steps, self.scored, generator)
        rows = torch.arange(len(noise), device=noise.device)[:, None]
        label = numbers[..., None, None].expand(-1, -1, 1, self.shape[1]).to(noise)
        trace = torch.cat([chain[rows, numbers], chain[rows, numbers + 1], label], dim=2)
        return chain[:, -1], trace, log_prob.gather(1, numbers)

    def judge(self, context: Any, trace: Tensor, temperature: float) -> Tensor:
        """See `DenoisingAdapter`; steps without noise are not looked at."""
        if self.noise_repeat:
            mean = self._played_mean(self.integrate(context, trace[:, :-1]))
            return step_log_prob(mean, self._std(temperature, mean), trace[:, -1:], self.scored)[:, None]
        if self.noise_steps == self.num_steps - 1:
            return super().judge(context, trace, temperature)
        step, height = self.step(context, temperature), self.shape[0]
        log_probs = []
        for x in trace.unbind(1):
            mean, std = step(x[:, -1, 0].long(), x[:, :height])
            log_probs.append(step_log_prob(mean, std, x[:, height:-1], self.scored))
        return torch.stack(log_probs, 1)

    def _played_mean(self, x: Tensor) -> Tensor:
        """Mean (B, 1, D) of the actions of x (B, H, D) that are played."""
        return x[:, self.scored.steps].mean(dim=1, keepdim=True)

    def _std(self, temperature: float, x: Tensor) -> Tensor:
        return x.new_full((1, 1, 1), temperature * self.noise_std)

    def _tables(self, eta: float) -> Tensor:
        """(4, S): t, 1 - t, what a step adds of the estimated noise beside Euler's, the deviation of new noise."""
        columns = []
        for k in range(self.num_steps):
            t, after = 1.0 - k / self.num_steps, (self.num_steps - k - 1) / self.num_steps
            kept = after * (1 - t) / (t * (1 - after))
            s = eta * after * (1 - kept**2) ** 0.5
            columns.append((t, 1 - t, (after**2 - s**2) ** 0.5 - after, s))
        return torch.tensor(columns, dtype=torch.float32).T
