"""PPO's settings, registered with LeRobot's RL algorithms as `ppo` and `ppo_paper`."""

from __future__ import annotations

from dataclasses import dataclass

from cronos_lerobot.agents.registry import AgentConfig
from cronos_lerobot.ranges import check_ranges, ranged


@AgentConfig.register_subclass("ppo")
@dataclass
class PPOConfig(AgentConfig):
    """PPO with settings for PocketVLA, a small network trained on a laptop CPU. Bad values are a ValueError."""

    epochs: int = ranged(3, minimum=1)
    """Passes over the rollout that train the policy and the value."""
    value_epochs: int = ranged(1, minimum=0)
    """Passes after them that train the value alone."""
    value_warmup_updates: int = ranged(2, minimum=0)
    """Updates at the start of a run that train the value alone, because it starts from noise."""
    minibatch_size: int = ranged(512, minimum=1)
    """Decisions in one backward pass of one process."""
    grad_accumulation: int = ranged(1, minimum=1)
    """Minibatches of each process in one optimizer step."""
    clip: float = ranged(0.2, above=0, maximum=1)
    """The probability ratio is clipped to 1 - clip .. 1 + clip."""
    ratio: str = ranged("decision", choices=("decision", "factor"))
    """What has a ratio: the whole `decision`, or each `factor` of it, which a policy must tell apart (the steps of
    a denoising chain)."""
    denoising_discount: float = ranged(1.0, above=0, maximum=1)
    """Of L factors the last one counts in the policy's loss, each before it this much of the one after it (DPPO's
    denoising discount): the first steps of a denoising are forgotten by those that follow."""
    gamma: float = ranged(0.99, minimum=0, maximum=1)
    """Discount factor per control step (0.2 s)."""
    gae_lambda: float = ranged(0.9, minimum=0, maximum=1)
    """GAE's weight of the longer returns."""
    normalize_advantage: bool = True
    """Give the advantages of a rollout mean 0 and standard deviation 1."""
    entropy_coef: float = ranged(0.0, minimum=0)
    """Weight of the entropy bonus."""
    value_coef: float = ranged(1.0, minimum=0)
    """Weight of the value loss, in all passes; it matters where policy and value share parameters."""
    value_loss: str = ranged("huber", choices=("huber", "mse"))
    """`huber` or `mse` (half the squared error)."""
    huber_delta: float = ranged(10.0, above=0)
    """Error beyond which the Huber loss is linear."""
    value_clip: float | None = ranged(None, above=0)
    """Largest change of a value that an update is paid for; null does not clip."""
    policy_lr: float = ranged(5e-5, minimum=0)
    """Learning rate of the policy's parameters, at the start of the run if it adapts."""
    value_lr: float = ranged(1e-3, minimum=0)
    """Learning rate of the value's parameters."""
    lr_schedule: str = ranged("kl_update", choices=("fixed", "kl_step", "kl_update"))
    """`fixed`; `kl_step` or `kl_update` scale the policy's learning rate after every optimizer step or
    update to keep the KL divergence of an update near target_kl."""
    target_kl: float | None = ranged(0.05, above=0)
    """KL divergence [nats] between the policies before and after an update that is aimed at; null if none."""
    kl_decay_updates: float | None = ranged(None, above=0)
    """Updates after which the target has halved: it is target_kl / (1 + updates / kl_decay_updates), for steps
    along a noisy gradient must become shorter to settle (Robbins and Monro, 1951). null keeps target_kl."""
    kl_stop_factor: float | None = ranged(2.0, above=0)
    """The policy's training in an update stops once a step sees a KL above this times target_kl, and an adaptive
    learning rate falls; null never stops it."""
    lr_factor: float = ranged(1.5, minimum=1)
    """Factor by which the adaptive learning rate rises or falls."""
    policy_lr_min: float = ranged(1e-6, minimum=0)
    """Lower end of the adaptive learning rate."""
    policy_lr_max: float = ranged(1e-3, minimum=0)
    """Upper end of the adaptive learning rate."""
    kl_base_coef: float = ranged(0.0, minimum=0)
    """Weight of KL(policy || the policy that the run began with), whose trained parameters are kept in memory."""
    max_grad_norm: float = ranged(1.0, above=0)
    """The gradient of the policy's parameters is scaled down to this norm."""
    value_max_grad_norm: float = ranged(1.0, above=0)
    """The gradient of the value's parameters is scaled down to this norm."""
    beta1: float = ranged(0.9, minimum=0, below=1)
    """AdamW's decay of the gradient's mean."""
    beta2: float = ranged(0.999, minimum=0, below=1)
    """AdamW's decay of the gradient's square."""
    weight_decay: float = ranged(0.0, minimum=0)
    """AdamW's weight decay."""
    temperature: float = ranged(1.0, above=0)
    """Sampling temperature while training."""
    noise_std: float = ranged(0.1, above=0)
    """Standard deviation, in normalised units, of the noise around the actions of a policy that has none of its
    own (ACT), where this is its start and it is learned, and of `noise_repeat`; the least deviation of a step of
    Diffusion's denoising."""
    noise_level: float = ranged(1.0, above=0, maximum=1)
    """Noise of the denoising of a flow policy (PocketVLA's flow head, SmolVLA, pi0) or of Diffusion: DDIM's eta.
    1 draws all of the noise anew that the forward process would have added."""
    noise_steps: int | None = ranged(None, minimum=1)
    """At how many steps of a flow policy's denoising there is noise, drawn for each decision; an update evaluates
    the network at these alone. null is all but the last, which has none."""
    noise_repeat: bool = False
    """For a flow policy: no noise in the denoising, but one action's of `noise_std` for the whole chunk."""
    critic_observation: str = ranged("policy", choices=("policy", "environment_state"))
    """What the critic beside a policy that has none of its own (ACT, Diffusion, SmolVLA, pi0) reads: what the
    `policy` makes of its observation, or the privileged `environment_state`, the robot's state and the
    instruction; the environment then shows it beside pixels."""

    def __post_init__(self) -> None:
        check_ranges(self, "algorithm.")
        if self.denoising_discount < 1 and self.noise_steps is not None:
            raise ValueError(
                f"--algorithm.denoising_discount={self.denoising_discount} weighs all steps of a chain, and "
                f"--algorithm.noise_steps={self.noise_steps} leaves some out: choose one of them."
            )
        if self.target_kl is None and self.lr_schedule != "fixed":
            raise ValueError(f"--algorithm.lr_schedule={self.lr_schedule} needs --algorithm.target_kl.")
        if self.lr_schedule != "fixed" and not self.policy_lr_min <= self.policy_lr <= self.policy_lr_max:
            raise ValueError(
                f"--algorithm.policy_lr must be policy_lr_min={self.policy_lr_min} to policy_lr_max="
                f"{self.policy_lr_max}, got {self.policy_lr}; or --algorithm.lr_schedule=fixed."
            )


@AgentConfig.register_subclass("ppo_paper")
@dataclass
class PaperPPOConfig(PPOConfig):
    """PPO with the settings of the paper (Table 2) for a 7B policy with LoRA.

    What the paper leaves open follows RL4VLA, which it builds on: minibatches of 8, gradient norm 10, a clipped
    Huber value loss with delta 10, normalised advantages, PyTorch's weight decay. One thing does not: policy and
    value head have a gradient norm each, where RL4VLA clips both together.
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
    value_max_grad_norm: float = 10.0
    weight_decay: float = 0.01
