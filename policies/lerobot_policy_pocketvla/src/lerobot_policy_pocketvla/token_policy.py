"""PocketVLA with a head of tokens: one bin for each dimension of one action."""

from typing import Any, Literal

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_policy_pocketvla.heads import (
    Bins,
    CategoricalHead,
    GaussianHead,
    actions_to_tokens,
    tokens_to_actions,
)
from lerobot_policy_pocketvla.modeling_pocketvla import Batch, PocketVLAPolicy


class PocketVLATokenPolicy(PocketVLAPolicy, heads=("gaussian", "categorical")):
    """Draws a bin for each dimension, and says how likely it was."""

    head: GaussianHead | CategoricalHead

    def _build_head(self) -> GaussianHead | CategoricalHead:
        config = self.config
        if config.head == "categorical":
            return CategoricalHead(config.hidden_width, config.action_dim, config.num_bins)
        return GaussianHead(
            config.hidden_width,
            config.action_dim,
            config.num_bins,
            config.gripper_dim,
            config.sigma_init,
            config.sigma_min,
            config.sigma_max,
            config.gripper_logit_limit,
        )

    def forward(
        self, batch: Batch, reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Behaviour cloning: negative log-likelihood of the bins of the demonstrated actions.

        Args:
            batch: with `action` (B, D) or (B, 1, D), normalised, and `action_is_pad` (B,) or (B, 1) if some
                actions are padding.
            reduction: `mean` over the samples that are not padding, or `none`.

        Returns:
            The loss, a scalar or (B,), in nats summed over the action's dimensions, and numbers for the log.
        """
        with self._full_precision():
            features, taught, metrics = self._cloning_features(batch)
            distribution: Bins = self.head(features)
        target = batch[ACTION].reshape(-1, self.config.action_dim)
        tokens = self._target_tokens(target)
        losses = -distribution.log_prob(tokens, 1.0)
        valid = torch.ones_like(losses)
        if "action_is_pad" in batch:
            valid = 1.0 - batch["action_is_pad"].reshape(-1).to(losses.dtype)
        losses = (losses + taught) * valid
        loss = losses if reduction == "none" else losses.sum() / valid.sum().clamp(min=1.0)
        return loss, self._metrics(distribution, target, valid) | metrics

    def _target_tokens(self, actions: Tensor) -> Tensor:
        tokens = actions_to_tokens(actions, self.config.num_bins)
        if isinstance(self.head, GaussianHead) and self.head.gripper_dim is not None:
            gripper = self.head.gripper_dim
            tokens[:, gripper] = torch.where(actions[:, gripper] >= 0, self.config.num_bins - 1, 0)
        return tokens

    @torch.no_grad()
    def _metrics(self, distribution: Bins, target: Tensor, valid: Tensor) -> dict[str, float]:
        greedy = tokens_to_actions(distribution.mode(), self.config.num_bins)
        error = (greedy - target.clamp(-1.0, 1.0)).abs().mean(-1)
        metrics = {"greedy_abs_error": float((error * valid).sum() / valid.sum().clamp(min=1.0))}
        if isinstance(self.head, GaussianHead):
            metrics["sigma_mean"] = float(self.head.sigma().mean())
        return metrics

    @torch.no_grad()
    def select_action(  # ty: ignore[incompatible-method-override]
        self,
        batch: Batch,
        *,
        temperature: float | None = None,
        generator: torch.Generator | None = None,
        **_: Any,
    ) -> Tensor:
        """Choose one normalised action per sample, (B, D) float32; the critic's inputs are not needed.

        Args:
            batch: observations and `task`.
            temperature: of the sampling, 0 is greedy; None takes the configuration's.
            generator: random source; None is torch's global one.
        """
        temperature = self.config.temperature if temperature is None else temperature
        with self._full_precision():
            tokens = self._draw(self._features(batch), temperature, generator)[0]
        return tokens_to_actions(tokens, self.config.num_bins)

    def _draw(
        self,
        features: Tensor,
        temperature: float,
        generator: torch.Generator | None,
        uniform: Tensor | None = None,
    ) -> tuple[Tensor, Bins]:
        """Bins (B, D) and their distribution: the likeliest at temperature 0, else at the quantiles `uniform`."""
        distribution: Bins = self.head(features)
        if temperature == 0:
            return distribution.mode(), distribution
        if uniform is None:
            shape = (len(features), self.config.action_dim)
            uniform = torch.rand(shape, generator=generator, device=features.device)
        return distribution.sample(temperature, uniform), distribution

    def predict_action_chunk(self, batch: Batch, **kwargs: Any) -> Tensor:
        """`select_action` as a chunk of one action, (B, 1, D)."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    def reset(self) -> None:
        """Nothing to forget: the policy has no memory between steps."""

    # What an actor-critic trainer needs.

    @torch.no_grad()
    def sample_actions(
        self,
        batch: Batch,
        *,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        uniform: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Draw actions with what is needed to learn from them.

        Args:
            batch: observations and `task`.
            temperature: of the sampling, 0 is greedy.
            generator: random source; None is torch's global one.
            uniform: the randomness itself, (B, D) in [0, 1), instead of a generator: a sample then does not
                depend on the others of its batch.

        Returns:
            `actions` (B, 1, D) float32, normalised; `trace` (B, D) int64, the bins; `log_prob` (B,), summed over
            the dimensions, at this temperature; `value` (B,). Temperature 0 is greedy, its `log_prob` is 0.
        """
        with self._full_precision():
            batch = self._with_encoding(batch)
            tokens, distribution = self._draw(self._features(batch), temperature, generator, uniform)
            log_prob = (
                distribution.log_prob(tokens, temperature)
                if temperature
                else tokens.new_zeros(len(tokens), dtype=torch.float32)
            )
            return {
                "actions": tokens_to_actions(tokens, self.config.num_bins).unsqueeze(1),
                "trace": tokens,
                "log_prob": log_prob,
                "value": self._values(batch),
            }

    def evaluate_actions(self, batch: Batch, tokens: Tensor, *, temperature: float = 1.0) -> dict[str, Tensor]:
        """Evaluate drawn bins (B, D) under the policy as it is now, differentiable.

        Returns:
            `log_prob` (B,), summed over the dimensions; `entropy` (B,), mean over the dimensions, in nats;
            `value` (B,).
        """
        with self._full_precision():
            batch = self._with_encoding(batch)
            distribution: Bins = self.head(self._features(batch))
            return {
                "log_prob": distribution.log_prob(tokens, temperature),
                "entropy": distribution.entropy(temperature),
                "value": self._values(batch),
            }
