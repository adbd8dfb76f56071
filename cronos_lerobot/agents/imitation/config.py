"""The settings of imitation, registered with LeRobot's RL algorithms as `imitation`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.rl.algorithms.configs import RLAlgorithmConfig


@dataclass
class DemosConfig:
    """Demonstrations that are learned from beside the successes."""

    repo_id: str | None = None
    """Name of the LeRobotDataset, user/name; null has none."""
    root: Path | None = None
    """Its folder; null takes LeRobot's cache or the Hub."""

    def check(self, share: float) -> None:
        """Check that `share`, `algorithm.demos_share`, has demonstrations, and they a share.

        Raises:
            ValueError: as it says.
        """
        if share and self.repo_id is None:
            raise ValueError(f"algorithm.demos_share={share} needs --algorithm.demos.repo_id.")
        for name in ("repo_id", "root"):
            if not share and (value := getattr(self, name)) is not None:
                raise ValueError(
                    f"algorithm.demos.{name}={value} is not learned from with --algorithm.demos_share=0: give a "
                    "share above 0, up to 1."
                )


WEIGHTINGS = ("none", "return", "advantage")


@RLAlgorithmConfig.register_subclass("imitation")
@dataclass
class ImitationConfig(RLAlgorithmConfig):
    """Cloning of the streams' successes, or of all segments by weight, with the policy's own loss and optimizer.

    Bad values are a ValueError.
    """

    steps_per_update: int = 100
    """Optimizer steps between two looks at the streams (protocol.update_interval)."""
    batch_size: int = 256
    """Frames in one optimizer step of one process."""
    lr: float | None = None
    """Learning rate; null takes a tenth of the one that the policy has in lerobot-train. It stays as it is, and
    groups of parameters that have their own there are scaled alike."""
    ema_decay: float = 0.998
    """The policy that acts, is evaluated and saved is an average of the trained weights over about
    1 / (1 - ema_decay) optimizer steps; 0 is the trained weights themselves, and saves the memory of a copy."""
    warmup_segments: int = 32
    """Successful segments, of all processes together, before the first optimizer step; none where demonstrations
    are cloned, too."""
    tail_steps: int = 4
    """Control steps of a segment that are kept after its first success."""
    memory_gib: float = 4.0
    """Memory of each process for segments [GiB]; the newest stay. A checkpoint holds them."""
    demos: DemosConfig = field(default_factory=DemosConfig)
    """Demonstrations."""
    demos_share: float = 0.0
    """Share of a batch that is of the demonstrations; all of it as long as there are no successes."""
    temperature: float = 1.0
    """Sampling temperature while training, of policies that have one (`sample_actions`)."""
    weighting: str = "none"
    """`none` clones the successful segments; with the others failed ones are kept as well, and frames are drawn in
    proportion to exp(R / beta) of their segment's `return` R, or to exp(A / beta) of its `advantage` A over the
    mean return of its instruction."""
    weighting_beta: float = 0.2
    """The smaller, the more the better segments count [reward]."""
    max_weight: float = 20.0
    """Largest exp(A / beta) of `advantage`."""
    gamma: float = 0.99
    """Discount factor per control step of the returns that weigh."""

    def __post_init__(self) -> None:
        for name, low in (("steps_per_update", 1), ("batch_size", 1), ("warmup_segments", 0), ("tail_steps", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"algorithm.{name} must be >= {low}, got {getattr(self, name)}.")
        if self.weighting not in WEIGHTINGS:
            raise ValueError(f"algorithm.weighting must be one of {WEIGHTINGS}, got {self.weighting!r}.")
        if not self.max_weight >= 1:
            raise ValueError(f"algorithm.max_weight must be >= 1, got {self.max_weight}.")
        for name in ("lr", "memory_gib", "temperature", "weighting_beta"):
            if (value := getattr(self, name)) is not None and not 0 < value < math.inf:
                raise ValueError(f"algorithm.{name} must be > 0 and finite, got {value}.")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"algorithm.ema_decay must be >= 0 and < 1, got {self.ema_decay}.")
        for name in ("demos_share", "gamma"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"algorithm.{name} must be >= 0 and <= 1, got {getattr(self, name)}.")
        self.demos.check(self.demos_share)

    @property
    def unread(self) -> dict[str, str]:
        """Settings without effect beside the others, each with what it needs."""
        needs: dict[str, str] = {}
        if self.weighting == "none":
            needs |= dict.fromkeys(("weighting_beta", "gamma"), "an --algorithm.weighting of return or advantage")
        if self.weighting != "advantage":
            needs["max_weight"] = "--algorithm.weighting=advantage"
        if self.demos_share == 1:
            of_memory = ("tail_steps", "memory_gib", "weighting", "weighting_beta", "max_weight", "gamma")
            needs |= dict.fromkeys(of_memory, "an --algorithm.demos_share below 1")
        if self.demos_share:
            needs["warmup_segments"] = "--algorithm.demos_share=0"
        return needs

    def check_reward(self, reward: str) -> None:
        """A success is remembered only until shortly after it, and `level` pays for all the time after."""
        if self.weighting != "none" and reward == "level":
            raise ValueError(
                f"--algorithm.weighting={self.weighting} with --protocol.reward=level would weigh late successes"
                " most, which lose less of their reward: give --protocol.reward=difference."
            )

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> ImitationConfig:
        """Return the defaults: what depends on the policy is asked of it when the agent is made."""
        return cls()
