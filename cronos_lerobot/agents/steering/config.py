"""The settings of steering, registered with LeRobot's RL algorithms as `steering`."""

from __future__ import annotations

from dataclasses import dataclass

from cronos_lerobot.agents.registry import AgentConfig
from cronos_lerobot.ranges import check_ranges, ranged


@AgentConfig.register_subclass("steering")
@dataclass
class SteeringConfig(AgentConfig):
    """Soft actor-critic over the initial noise of a frozen policy. Bad values are a ValueError."""

    observation: str = ranged("auto", choices=("auto", "policy", "state"))
    """What actor and critics read: `policy`, the policy's features; `state`, the vectors that it observes and the
    words of the instruction; `auto` takes `state` if the environment's state is among them, else `policy`."""
    noise_magnitude: float = ranged(1.5, above=0)
    """b: every number of the noise lies in (-b, b). The policy was trained with N(0, 1)."""
    noise_repeat: bool = False
    """Choose the noise of one action and repeat it over the chunk; else that of every action of the chunk."""
    gamma: float = ranged(0.95, minimum=0, maximum=1)
    """Discount factor per control step (0.2 s)."""
    utd: float = ranged(0.1, above=0)
    """Optimizer steps for each decision that was made, at the next update. Many at once, between two looks at the
    streams, overrate what was never tried: with 1 the values grew without end."""
    batch_size: int = ranged(1024, minimum=1)
    """Decisions in an optimizer step of one process."""
    warmup_decisions: int = ranged(4096, minimum=1)
    """Decisions on noise of N(0, 1), of all processes together, before the first optimizer step."""
    memory_size: int = ranged(100_000, minimum=1)
    """Decisions that are remembered, of all processes together; the newest stay. A checkpoint holds them."""
    num_critics: int = ranged(5, minimum=1)
    """Critics."""
    num_target_critics: int = ranged(5, minimum=1)
    """Of them, drawn at every step, the least counts as the value of what follows."""
    hidden_width: int = ranged(256, minimum=1)
    """Width of the two hidden layers of the actor and of each critic."""
    lr: float = ranged(3e-4, above=0)
    """Learning rate of actor, critics and alpha."""
    target_update: float = ranged(0.005, above=0, maximum=1)
    """How far the target critics move towards the critics at every step."""
    initial_alpha: float = ranged(0.01, above=0)
    """Weight of the entropy at the start."""
    target_entropy: float = -0.5
    """Entropy [nats per dimension, of the noise divided by b] that alpha is adapted to; a uniform one has 0.69."""
    backup_entropy: bool = False
    """Whether the entropy is a part of the value, or only of what the actor is told."""
    max_grad_norm: float = ranged(10.0, above=0)
    """The gradients of the actor and of the critics are scaled down to this norm."""

    def __post_init__(self) -> None:
        check_ranges(self, "algorithm.")
        if self.num_target_critics > self.num_critics:
            raise ValueError(
                f"--algorithm.num_target_critics must be at most num_critics={self.num_critics}, got "
                f"{self.num_target_critics}."
            )
