"""LeRobot's Diffusion (Chi et al., 2023), whose denoising chain is the decision: DPPO (Ren et al., 2024)."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from torch import Tensor

from cronos_lerobot.agents.adapters.denoising import DenoisingAdapter, Step
from cronos_lerobot.agents.adapters.registry import AdapterOptions, register_adapter
from cronos_lerobot.agents.base import Batch


@register_adapter("diffusion")
class DiffusionAdapter(DenoisingAdapter):
    """A decision is the chain of DDIM steps; a factor is one of them.

    A step is Gaussian: its mean is that of the policy's own scheduler with eta = noise_level, its deviation eta
    sigma_k, but never below noise_std, in drawing and in judging alike. Without that floor the last steps have
    next to no noise, and their ratios explode. Temperature 0 is eta 0 without the floor: what the policy does in
    LeRobot.

    The critic reads what the denoising is conditioned on; the value loss does not train the policy.

    Args:
        policy: a DiffusionPolicy on its device.
        options: of the noise.

    Raises:
        ValueError: the policy denoises by DDPM.
    """

    def __init__(self, policy: Any, options: AdapterOptions) -> None:
        config, model = policy.config, policy.diffusion
        if config.noise_scheduler_type != "DDIM":
            raise ValueError(
                f"--policy.noise_scheduler_type={config.noise_scheduler_type} denoises in "
                f"{model.num_inference_steps} steps: train the same weights with "
                "--policy.noise_scheduler_type=DDIM --policy.num_inference_steps=5."
            )
        super().__init__(
            policy,
            shape=(config.horizon, config.action_feature.shape[0]),
            num_steps=model.num_inference_steps,
            feature_width=_condition_width(config),
            first=config.n_obs_steps - 1,
        )
        self.observation_steps = config.n_obs_steps
        self.eta, self.min_std = options.noise_level, options.noise_std
        self._scheduler = model.noise_scheduler
        self._scheduler.set_timesteps(self.num_steps)
        self._times: list[int] = self._scheduler.timesteps.tolist()
        # Of x = 0 and a network that answers 0 a step leaves nothing but its noise.
        one = torch.ones(1, device=self._scheduler.alphas_cumprod.device)
        zero = torch.zeros_like(one)
        self._sigmas = [float(self._previous(zero, t, zero, 1.0, one)) for t in self._times]

    def observe(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """See `DenoisingAdapter`."""
        given = self.policy.diffusion._prepare_global_conditioning(self._with_history(batch))
        return given, given.detach()

    def step(self, context: Tensor, temperature: float) -> Step:
        """The scheduler's steps; see above."""
        eta, min_std = min(1.0, temperature * self.eta), temperature * self.min_std

        def step(k: int, x: Tensor) -> tuple[Tensor, Tensor]:
            time = torch.full((len(x),), self._times[k], dtype=torch.long, device=x.device)
            output = self.policy.diffusion.unet(x, time, global_cond=context)
            mean = self._previous(output, self._times[k], x, eta, torch.zeros_like(x) if eta else None)
            return mean, torch.tensor(max(eta * self._sigmas[k], min_std), device=x.device)

        return step

    def _previous(self, output: Tensor, time: int, x: Tensor, eta: float, noise: Tensor | None) -> Tensor:
        """x one step further on, drawn with `noise`."""
        return self._scheduler.step(output, time, x, eta=eta, variance_noise=noise).prev_sample

    def _with_history(self, batch: Batch) -> Batch:
        """Observations (B, n_obs_steps, ...), all cameras (B, n_obs_steps, cameras, C, H, W) in one."""
        names = [OBS_STATE, *self.config.image_features]
        if self.config.env_state_feature:
            names.append(OBS_ENV_STATE)
        one = self.config.n_obs_steps == 1
        seen = {name: batch[name].unsqueeze(1) if one else batch[name] for name in names}
        if self.config.image_features:
            seen[OBS_IMAGES] = torch.stack([seen[name] for name in self.config.image_features], dim=-4)
        return seen


def _condition_width(config: Any) -> int:
    """Of what a denoising is given: the vectors, and two numbers for each keypoint of each camera."""
    vectors = [config.robot_state_feature, config.env_state_feature]
    width = sum(feature.shape[0] for feature in vectors if feature is not None)
    width += 2 * config.spatial_softmax_num_keypoints * len(config.image_features)
    return config.n_obs_steps * width
