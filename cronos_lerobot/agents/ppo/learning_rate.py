"""The policy's learning rate, led by how far an update moves the policy."""

from __future__ import annotations

import logging
from typing import Any

from torch.optim import Optimizer

from cronos_lerobot.agents.ppo.config import PPOConfig


def target_kl(config: PPOConfig, updates: int) -> float | None:
    """Return the KL divergence [nats] that the update after `updates` others aims at, or None; see PPOConfig."""
    if config.target_kl is None or config.kl_decay_updates is None:
        return config.target_kl
    return config.target_kl / (1 + updates / config.kl_decay_updates)


def adapted_lr(lr: float, kl: float, target: float, config: PPOConfig) -> float:
    """Return a smaller learning rate if `kl` is above twice the target, a larger one if below half of it."""
    if kl > 2 * target:
        return lowered_lr(lr, config)
    if kl < target / 2:
        return min(lr * config.lr_factor, config.policy_lr_max)
    return lr


def lowered_lr(lr: float, config: PPOConfig) -> float:
    """Return the next smaller learning rate."""
    return max(lr / config.lr_factor, config.policy_lr_min)


class AdaptiveLR:
    """Reads and writes the learning rate of the group `policy`.

    A KL divergence says something of the learning rate only after a step with a gradient: until there was one in
    an update, the learning rate holds.
    """

    def __init__(self, optimizer: Optimizer, config: PPOConfig) -> None:
        self._optimizer = optimizer
        self._config = config
        self._target: float | None = None
        self._moved = False
        self._told = False

    @property
    def value(self) -> float:
        """The learning rate now."""
        return self._groups()[0]["lr"]

    @value.setter
    def value(self, lr: float) -> None:
        for group in self._groups():
            group["lr"] = lr

    def begin_update(self, target: float | None) -> None:
        """Nothing has moved the policy yet in this update, which aims at this KL divergence."""
        self._target = target
        self._moved = False

    def after_step(self, grad_norm: float) -> None:
        """The optimizer took a step with this norm of the policy's gradient."""
        self._moved |= grad_norm > 0

    def see(self, when: str, kl: float | None) -> None:
        """Adapt to the KL divergence seen after a step (`kl_step`) or in an update (`kl_update`), if any was."""
        if self._config.lr_schedule == when and self._moved and kl is not None and self._target is not None:
            self.value = adapted_lr(self.value, kl, self._target, self._config)

    def stopped_early(self) -> None:
        """The update moved the policy too far."""
        if self._config.lr_schedule != "fixed":
            self.value = lowered_lr(self.value, self._config)

    def end_update(self) -> None:
        """Warn, once until it has changed, if there was no gradient in the whole update."""
        if not self._moved and not self._told:
            logging.warning(
                "The policy got no gradient: no reward told one action from another in this update. Its learning "
                f"rate stays at {self.value:g}."
            )
        self._told = not self._moved

    def _groups(self) -> list[dict[str, Any]]:
        # Asked for each time: a checkpoint that is loaded brings groups of its own.
        return [group for group in self._optimizer.param_groups if group["name"] == "policy"]
