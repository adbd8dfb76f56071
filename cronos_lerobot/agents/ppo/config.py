"""PPO's settings, registered with LeRobot's RL algorithms as `ppo` and `ppo_paper`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.rl.algorithms.configs import RLAlgorithmConfig

LR_SCHEDULES = ("fixed", "kl_step", "kl_update")
VALUE_LOSSES = ("huber", "mse")


@RLAlgorithmConfig.register_subclass("ppo")
@dataclass
class PPOConfig(RLAlgorithmConfig):
    """PPO with settings for PocketVLA, a small network trained on a laptop CPU. Bad values are a ValueError."""

    epochs: int = 4
    """Passes over the rollout that train the policy and the value."""
    value_epochs: int = 3
    """Passes after them that train the value alone."""
    value_warmup_updates: int = 2
    """Updates at the start of a run that train the value alone, because it starts from noise."""
    minibatch_size: int = 2048
    """Transitions in one backward pass of one process."""
    grad_accumulation: int = 1
    """Minibatches of each process in one optimizer step."""
    clip: float = 0.2
    """The probability ratio is clipped to 1 - clip .. 1 + clip."""
    gamma: float = 0.99
    """Discount factor per control step (0.2 s)."""
    gae_lambda: float = 0.9
    """GAE's weight of the longer returns."""
    normalize_advantage: bool = True
    """Give the advantages of a rollout mean 0 and standard deviation 1."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus."""
    value_coef: float = 1.0
    """Weight of the value loss; it matters where policy and value share parameters."""
    value_loss: str = "huber"
    """`huber` or `mse` (half the squared error)."""
    huber_delta: float = 10.0
    """Error beyond which the Huber loss is linear."""
    value_clip: float | None = None
    """Largest change of a value that an update is paid for; null does not clip."""
    policy_lr: float = 5e-5
    """Learning rate of the policy's parameters, at the start of the run if it adapts."""
    value_lr: float = 1e-3
    """Learning rate of the value's parameters."""
    lr_schedule: str = "kl_update"
    """`fixed`; `kl_step` or `kl_update` scale the policy's learning rate after every optimizer step or
    update to keep the KL divergence of an update near target_kl."""
    target_kl: float | None = 0.05
    """KL divergence [nats] between the policies before and after an update that is aimed at; null if none."""
    kl_stop_factor: float | None = 2.0
    """The policy's training in an update stops once a step sees a KL above this times target_kl; null never
    stops it."""
    lr_factor: float = 1.5
    """Factor by which the adaptive learning rate rises or falls."""
    policy_lr_min: float = 1e-6
    """Lower end of the adaptive learning rate."""
    policy_lr_max: float = 1e-3
    """Upper end of the adaptive learning rate."""
    kl_base_coef: float = 0.0
    """Weight of the KL divergence from the policy that the run began with, which is then kept in memory."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm, over all parameters."""
    beta1: float = 0.9
    """AdamW's decay of the gradient's mean."""
    beta2: float = 0.999
    """AdamW's decay of the gradient's square."""
    weight_decay: float = 0.0
    """AdamW's weight decay."""
    temperature: float = 1.0
    """Sampling temperature while training."""

    def __post_init__(self) -> None:
        for name in ("epochs", "minibatch_size", "grad_accumulation"):
            if getattr(self, name) < 1:
                raise ValueError(f"algorithm.{name} must be >= 1, got {getattr(self, name)}.")
        for name in ("value_epochs", "value_warmup_updates"):
            if getattr(self, name) < 0:
                raise ValueError(f"algorithm.{name} must be >= 0, got {getattr(self, name)}.")
        for name, choices in (("lr_schedule", LR_SCHEDULES), ("value_loss", VALUE_LOSSES)):
            if getattr(self, name) not in choices:
                raise ValueError(f"algorithm.{name} must be one of {choices}, got {getattr(self, name)!r}.")
        if self.target_kl is None and self.lr_schedule != "fixed":
            raise ValueError(f"algorithm.lr_schedule={self.lr_schedule} needs algorithm.target_kl.")
        if self.temperature <= 0:
            raise ValueError(f"algorithm.temperature must be > 0 while training, got {self.temperature}.")

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> PPOConfig:
        """Return the defaults: nothing of PPO depends on the policy's config."""
        return cls()


@RLAlgorithmConfig.register_subclass("ppo_paper")
@dataclass
class PaperPPOConfig(PPOConfig):
    """PPO with the settings of the paper (Table 2) for a 7B policy with LoRA.

    What the paper leaves open follows RL4VLA, which it builds on: minibatches of 8, gradient norm 10, a clipped
    Huber value loss with delta 10, normalised advantages.
    """

    epochs: int = 1
    value_epochs: int = 0
    value_warmup_updates: int = 0
    minibatch_size: int = 8
    grad_accumulation: int = 20
    gae_lambda: float = 0.95
    value_clip: float | None = 0.2
    policy_lr: float = 1e-4
    value_lr: float = 3e-3
    lr_schedule: str = "fixed"
    target_kl: float | None = None
    max_grad_norm: float = 10.0
