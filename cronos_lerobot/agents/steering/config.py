"""The settings of steering, registered with LeRobot's RL algorithms as `steering`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cronos_lerobot.agents.ppo.config import ABOVE_0, COUNT, SHARE, Interval
from cronos_lerobot.agents.registry import AgentConfig

OBSERVATIONS = ("auto", "policy", "state")
RANGES = {
    "gamma": SHARE,
    "noise_magnitude": ABOVE_0,
    "utd": ABOVE_0,
    "batch_size": COUNT,
    "warmup_decisions": COUNT,
    "memory_size": COUNT,
    "num_critics": COUNT,
    "num_target_critics": COUNT,
    "hidden_width": COUNT,
    "lr": ABOVE_0,
    "target_update": Interval(0, 1, with_low=False),
    "initial_alpha": ABOVE_0,
    "max_grad_norm": ABOVE_0,
}


@AgentConfig.register_subclass("steering")
@dataclass
class SteeringConfig(AgentConfig):
    """Soft actor-critic over the initial noise of a frozen policy. Bad values are a ValueError."""

    observation: str = "auto"
    """What actor and critics read: `policy`, the policy's features; `state`, the vectors that it observes and the
    words of the instruction; `auto` takes `state` if the environment's state is among them, else `policy`."""
    noise_magnitude: float = 1.5
    """b: every number of the noise lies in (-b, b). The policy was trained with N(0, 1)."""
    noise_repeat: bool = False
    """Choose the noise of one action and repeat it over the chunk; else that of every action of the chunk."""
    gamma: float = 0.95
    """Discount factor per control step (0.2 s)."""
    utd: float = 0.1
    """Optimizer steps for each decision that was made, at the next update. Many at once, between two looks at the
    streams, overrate what was never tried: with 1 the values grew without end."""
    batch_size: int = 1024
    """Decisions in an optimizer step of one process."""
    warmup_decisions: int = 4096
    """Decisions on noise of N(0, 1), of all processes together, before the first optimizer step."""
    memory_size: int = 100_000
    """Decisions that are remembered, of all processes together; the newest stay. A checkpoint holds them."""
    num_critics: int = 5
    """Critics."""
    num_target_critics: int = 5
    """Of them, drawn at every step, the least counts as the value of what follows."""
    hidden_width: int = 256
    """Width of the two hidden layers of the actor and of each critic."""
    lr: float = 3e-4
    """Learning rate of actor, critics and alpha."""
    target_update: float = 0.005
    """How far the target critics move towards the critics at every step."""
    initial_alpha: float = 0.01
    """Weight of the entropy at the start."""
    target_entropy: float = -0.5
    """Entropy [nats per dimension, of the noise divided by b] that alpha is adapted to; a uniform one has 0.69."""
    backup_entropy: bool = False
    """Whether the entropy is a part of the value, or only of what the actor is told."""
    max_grad_norm: float = 10.0
    """The gradients of the actor and of the critics are scaled down to this norm."""

    def __post_init__(self) -> None:
        for name, interval in RANGES.items():
            if (value := getattr(self, name)) not in interval:
                raise ValueError(f"algorithm.{name} must be {interval}, got {value}.")
        if not math.isfinite(self.target_entropy):
            raise ValueError(f"algorithm.target_entropy must be finite, got {self.target_entropy}.")
        if self.observation not in OBSERVATIONS:
            raise ValueError(f"algorithm.observation must be one of {OBSERVATIONS}, got {self.observation!r}.")
        if self.num_target_critics > self.num_critics:
            raise ValueError(
                f"algorithm.num_target_critics must be at most num_critics={self.num_critics}, got "
                f"{self.num_target_critics}."
            )
