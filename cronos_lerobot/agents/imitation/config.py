"""The settings of imitation, registered with LeRobot's RL algorithms as `imitation`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cronos_lerobot.agents.registry import AgentConfig
from cronos_lerobot.ranges import check_ranges, ranged


@dataclass
class DemosConfig:
    """Demonstrations that are learned from beside the successes."""

    repo_id: str | None = None
    """Name of the LeRobotDataset, user/name; null has none."""
    root: Path | None = None
    """Its folder; null takes LeRobot's cache or the Hub."""


@AgentConfig.register_subclass("imitation")
@dataclass
class ImitationConfig(AgentConfig):
    """Cloning of the streams' successes, or of all segments by weight, with the policy's own loss and optimizer.

    Bad values are a ValueError.
    """

    steps_per_update: int = ranged(100, minimum=1)
    """Optimizer steps between two looks at the streams (protocol.update_interval)."""
    batch_size: int = ranged(256, minimum=1)
    """Frames in one optimizer step of one process."""
    lr: float | None = ranged(None, above=0)
    """Learning rate; null takes a tenth of the one that the policy has in lerobot-train. It stays as it is, and
    groups of parameters that have their own there are scaled alike."""
    ema_decay: float = ranged(0.998, minimum=0, below=1)
    """The policy that acts, is evaluated and saved is an average of the trained weights over about
    1 / (1 - ema_decay) optimizer steps; 0 is the trained weights themselves, and saves the memory of a copy."""
    warmup_segments: int = ranged(32, minimum=0)
    """Successful segments, of all processes together, before the first optimizer step; none where demonstrations
    are cloned, too."""
    lead_steps: int | None = ranged(None, minimum=1)
    """Control steps of a segment that are kept up to its first success; null keeps all. A segment that succeeded
    late is mostly attempts that failed."""
    tail_steps: int = ranged(4, minimum=0)
    """Control steps of a segment that are kept after its first success."""
    memory_gib: float = ranged(4.0, above=0)
    """Memory of each process for segments [GiB]; the newest stay. A checkpoint holds them."""
    demos: DemosConfig = field(default_factory=DemosConfig)
    """Demonstrations."""
    demos_share: float = ranged(0.0, minimum=0, maximum=1)
    """Share of a batch that is of the demonstrations; all of it as long as there are no successes."""
    temperature: float = ranged(1.0, above=0)
    """Sampling temperature while training, of policies that have one (`sample_actions`)."""
    weighting: str = ranged("none", choices=("none", "return", "advantage"))
    """`none` clones the successful segments; with the others failed ones are kept as well, and frames are drawn in
    proportion to exp(R / beta) of their segment's `return` R, or to exp(A / beta) of its `advantage` A over the
    mean return of its instruction."""
    weighting_beta: float = ranged(0.2, above=0)
    """The smaller, the more the better segments count [reward]."""
    max_weight: float = 20.0
    """Largest exp(A / beta) of `advantage`."""
    gamma: float = ranged(0.99, minimum=0, maximum=1)
    """Discount factor per control step of the returns that weigh."""

    def __post_init__(self) -> None:
        check_ranges(self, "algorithm.")
        if not self.max_weight >= 1:
            raise ValueError(f"--algorithm.max_weight must be >= 1, got {self.max_weight}.")
        if self.demos_share and self.demos.repo_id is None:
            raise ValueError(f"--algorithm.demos_share={self.demos_share} needs --algorithm.demos.repo_id.")

    def check_reward(self, reward: str) -> None:
        """A success is remembered only until shortly after it, and `level` pays for all the time after."""
        if self.weighting != "none" and reward == "level":
            raise ValueError(
                f"--algorithm.weighting={self.weighting} with --protocol.reward=level would weigh late successes"
                " most, which lose less of their reward: give --protocol.reward=difference."
            )
