"""PPO's settings, registered with LeRobot's RL algorithms as `ppo` and `ppo_paper`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from cronos_lerobot.agents.imitation.config import DemosConfig

LR_SCHEDULES = ("fixed", "kl_step", "kl_update")
VALUE_LOSSES = ("huber", "mse")
RATIOS = ("decision", "factor")
CRITIC_OBSERVATIONS = ("policy", "environment_state")


@dataclass(frozen=True)
class Interval:
    """Where a setting has to lie. NaN lies nowhere."""

    low: float
    high: float = math.inf
    with_low: bool = True
    with_high: bool = True

    def __contains__(self, value: float) -> bool:
        above = value >= self.low if self.with_low else value > self.low
        below = value <= self.high if self.with_high else value < self.high
        return above and below and not math.isinf(value)

    def __str__(self) -> str:
        low = f"{'>=' if self.with_low else '>'} {self.low:g}"
        return low if math.isinf(self.high) else f"{low} and {'<=' if self.with_high else '<'} {self.high:g}"


COUNT = Interval(1)
FROM_0 = Interval(0)
ABOVE_0 = Interval(0, with_low=False)
SHARE = Interval(0, 1)
DECAY = Interval(0, 1, with_high=False)
RANGES = {
    "epochs": COUNT,
    "value_epochs": FROM_0,
    "value_warmup_updates": FROM_0,
    "minibatch_size": COUNT,
    "grad_accumulation": COUNT,
    "clip": Interval(0, 1, with_low=False),
    "denoising_discount": Interval(0, 1, with_low=False),
    "gamma": SHARE,
    "gae_lambda": SHARE,
    "entropy_coef": FROM_0,
    "value_coef": FROM_0,
    "huber_delta": ABOVE_0,
    "value_clip": ABOVE_0,
    "policy_lr": FROM_0,
    "value_lr": FROM_0,
    "target_kl": ABOVE_0,
    "kl_decay_updates": ABOVE_0,
    "kl_stop_factor": ABOVE_0,
    "lr_factor": Interval(1),
    "policy_lr_min": FROM_0,
    "policy_lr_max": FROM_0,
    "kl_base_coef": FROM_0,
    "max_grad_norm": ABOVE_0,
    "value_max_grad_norm": ABOVE_0,
    "beta1": DECAY,
    "beta2": DECAY,
    "weight_decay": FROM_0,
    "temperature": ABOVE_0,
    "noise_std": ABOVE_0,
    "noise_level": ABOVE_0,
    "noise_steps": COUNT,
    "demos_share": SHARE,
}
"""Valid values of the numbers; those that may be null are free to be."""
SELF_IMITATION_RANGES = {
    "coef": FROM_0,
    "batch_size": COUNT,
    "max_age": FROM_0,
    "tail_steps": FROM_0,
    "memory_gib": ABOVE_0,
}


@dataclass
class SelfImitationConfig:
    """Cloning of the streams' own successes beside PPO's loss. Bad values are a ValueError."""

    coef: float = 0.0
    """Weight of the policy's cloning loss (its LeRobot `forward`) in every optimizer step; 0 keeps no memory."""
    batch_size: int = 256
    """Frames that are cloned in one optimizer step of one process."""
    max_age: int = 10
    """Policy updates after which a success is no longer cloned; 0 keeps those of the last rollout."""
    tail_steps: int = 4
    """Control steps of a segment that are kept after its first success."""
    memory_gib: float = 4.0
    """Memory of each process for segments [GiB]; the newest stay. A checkpoint holds them."""

    def __post_init__(self) -> None:
        _check_ranges(self, SELF_IMITATION_RANGES, "algorithm.self_imitation")


def _check_ranges(config: Any, ranges: dict[str, Interval], group: str) -> None:
    for name, interval in ranges.items():
        value = getattr(config, name)
        if value is not None and value not in interval:
            raise ValueError(f"{group}.{name} must be {interval}, got {value}.")


@RLAlgorithmConfig.register_subclass("ppo")
@dataclass
class PPOConfig(RLAlgorithmConfig):
    """PPO with settings for PocketVLA, a small network trained on a laptop CPU. Bad values are a ValueError."""

    epochs: int = 3
    """Passes over the rollout that train the policy and the value."""
    value_epochs: int = 1
    """Passes after them that train the value alone."""
    value_warmup_updates: int = 2
    """Updates at the start of a run that train the value alone, because it starts from noise."""
    minibatch_size: int = 512
    """Decisions in one backward pass of one process."""
    grad_accumulation: int = 1
    """Minibatches of each process in one optimizer step."""
    clip: float = 0.2
    """The probability ratio is clipped to 1 - clip .. 1 + clip."""
    ratio: str = "decision"
    """What has a ratio: the whole `decision`, or each `factor` of it, which a policy must tell apart (the steps of
    a denoising chain)."""
    denoising_discount: float = 1.0
    """Of L factors the last one counts in the policy's loss, each before it this much of the one after it (DPPO's
    denoising discount): the first steps of a denoising are forgotten by those that follow."""
    gamma: float = 0.99
    """Discount factor per control step (0.2 s)."""
    gae_lambda: float = 0.9
    """GAE's weight of the longer returns."""
    normalize_advantage: bool = True
    """Give the advantages of a rollout mean 0 and standard deviation 1."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus."""
    value_coef: float = 1.0
    """Weight of the value loss, in all passes; it matters where policy and value share parameters."""
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
    kl_decay_updates: float | None = None
    """Updates after which the target has halved: it is target_kl / (1 + updates / kl_decay_updates), for steps
    along a noisy gradient must become shorter to settle (Robbins and Monro, 1951). null keeps target_kl."""
    kl_stop_factor: float | None = 2.0
    """The policy's training in an update stops once a step sees a KL above this times target_kl, and an adaptive
    learning rate falls; null never stops it."""
    lr_factor: float = 1.5
    """Factor by which the adaptive learning rate rises or falls."""
    policy_lr_min: float = 1e-6
    """Lower end of the adaptive learning rate."""
    policy_lr_max: float = 1e-3
    """Upper end of the adaptive learning rate."""
    kl_base_coef: float = 0.0
    """Weight of KL(policy || the policy that the run began with), whose trained parameters are kept in memory."""
    max_grad_norm: float = 1.0
    """The gradient of the policy's parameters is scaled down to this norm."""
    value_max_grad_norm: float = 1.0
    """The gradient of the value's parameters is scaled down to this norm."""
    beta1: float = 0.9
    """AdamW's decay of the gradient's mean."""
    beta2: float = 0.999
    """AdamW's decay of the gradient's square."""
    weight_decay: float = 0.0
    """AdamW's weight decay."""
    temperature: float = 1.0
    """Sampling temperature while training."""
    noise_std: float = 0.1
    """Standard deviation at the start, in normalised units, of the noise around the actions of a policy that has
    none of its own (ACT), where it is learned; the least deviation of a step of Diffusion's denoising."""
    noise_level: float = 0.5
    """Noise of the denoising of a flow policy (PocketVLA's flow head, SmolVLA, pi0), which has none of its own;
    Diffusion's is DDIM's eta, above 0 and at most 1."""
    noise_steps: int | None = None
    """At how many steps of a flow policy's denoising there is noise, drawn for each decision; an update evaluates
    the network at these alone. null is all of them."""
    critic_observation: str = "policy"
    """What the critic beside a policy that has none of its own (ACT, Diffusion, SmolVLA, pi0) reads: what the
    `policy` makes of its observation, or the privileged `environment_state`, the robot's state and the
    instruction; the environment then shows it beside pixels."""
    self_imitation: SelfImitationConfig = field(default_factory=SelfImitationConfig)
    """The streams' successes, cloned beside PPO's loss."""
    demos: DemosConfig = field(default_factory=DemosConfig)
    """Demonstrations that are cloned with them, against forgetting."""
    demos_share: float = 0.0
    """Share of what is cloned that is of the demonstrations; all of it as long as there are no successes."""

    def __post_init__(self) -> None:
        _check_ranges(self, RANGES, "algorithm")
        self._check_demos()
        for name, choices in (
            ("lr_schedule", LR_SCHEDULES), ("value_loss", VALUE_LOSSES), ("ratio", RATIOS),
            ("critic_observation", CRITIC_OBSERVATIONS),
        ):  # fmt: skip
            if getattr(self, name) not in choices:
                raise ValueError(f"algorithm.{name} must be one of {choices}, got {getattr(self, name)!r}.")
        if self.denoising_discount < 1 and self.ratio != "factor":
            raise ValueError(
                f"algorithm.denoising_discount={self.denoising_discount} is between factors: it needs "
                "algorithm.ratio=factor."
            )
        if self.denoising_discount < 1 and self.noise_steps is not None:
            raise ValueError(
                f"algorithm.denoising_discount={self.denoising_discount} is of all steps of a chain, of which "
                f"algorithm.noise_steps={self.noise_steps} leaves some out: choose one of them."
            )
        if self.target_kl is None and self.lr_schedule != "fixed":
            raise ValueError(f"algorithm.lr_schedule={self.lr_schedule} needs algorithm.target_kl.")
        if self.target_kl is None and self.kl_decay_updates is not None:
            raise ValueError(f"algorithm.kl_decay_updates={self.kl_decay_updates} needs algorithm.target_kl.")
        if self.kl_decay_updates is not None and self.lr_schedule == "fixed" and self.kl_stop_factor is None:
            raise ValueError(
                f"algorithm.kl_decay_updates={self.kl_decay_updates} has no effect where neither "
                "algorithm.lr_schedule nor algorithm.kl_stop_factor goes by the KL divergence."
            )
        if self.policy_lr_min > self.policy_lr_max:
            raise ValueError(
                f"algorithm.policy_lr_min must be at most policy_lr_max={self.policy_lr_max}, got "
                f"{self.policy_lr_min}."
            )

    def check_start(self) -> None:
        """Raise a ValueError, if an adaptive rate begins beyond its ends: it would leap to them, whichever way it
        should go.
        """
        if self.lr_schedule != "fixed" and not self.policy_lr_min <= self.policy_lr <= self.policy_lr_max:
            raise ValueError(
                f"algorithm.policy_lr must be policy_lr_min={self.policy_lr_min} to policy_lr_max="
                f"{self.policy_lr_max}, got {self.policy_lr}; or algorithm.lr_schedule=fixed."
            )

    def _check_demos(self) -> None:
        self.demos.check(self.demos_share)
        if self.demos_share and not self.self_imitation.coef:
            raise ValueError(
                f"algorithm.demos_share={self.demos_share} is of what PPO clones beside its loss, with a weight "
                "--algorithm.self_imitation.coef above 0."
            )

    @property
    def unread(self) -> dict[str, str]:
        """Settings without effect beside the others, each with what it needs."""
        needs: dict[str, str] = {}
        if self.value_loss != "huber":
            needs["huber_delta"] = "--algorithm.value_loss=huber"
        if self.lr_schedule == "fixed":
            names = ("lr_factor", "policy_lr_min", "policy_lr_max")
            needs |= dict.fromkeys(names, "an --algorithm.lr_schedule of kl_step or kl_update")
            if self.kl_stop_factor is None:
                needs["target_kl"] = "an adaptive --algorithm.lr_schedule, or --algorithm.kl_stop_factor"
        if self.target_kl is None:
            needs["kl_stop_factor"] = "--algorithm.target_kl"
        if not self.self_imitation.coef:
            names = (f"self_imitation.{name}" for name in SELF_IMITATION_RANGES if name != "coef")
            needs |= dict.fromkeys(names, "an --algorithm.self_imitation.coef above 0")
        elif self.demos_share == 1:
            names = (f"self_imitation.{name}" for name in ("max_age", "tail_steps", "memory_gib"))
            needs |= dict.fromkeys(names, "an --algorithm.demos_share below 1")
        return needs

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> PPOConfig:
        """Return the defaults: nothing of PPO depends on the policy's config."""
        return cls()


@RLAlgorithmConfig.register_subclass("ppo_paper")
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
