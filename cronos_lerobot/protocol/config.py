"""The reset-free training protocol of CRONOS (paper, Section 5 and Algorithm 1) as one config."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS
from lerobot_env_cronos.vector_env import REWARDS

RESET_PHASES = ("together", "staggered")


@dataclass
class ProtocolConfig:
    """When a stream switches task, when the policy learns, and which resets a stream gets.

    Raises:
        ValueError: an interval is no multiple of K, or a value is not valid.
    """

    task_switch_interval: int = 80
    """K: control steps of one stream between two task switches, the length of a segment."""
    update_interval: int = 160
    """U: control steps of each stream between two policy updates; a multiple of K."""
    scene_reset_interval: int | None = 1280
    """T (H in Algorithm 1): control steps of one stream between two scene resets; a multiple of K. 80 is episodic
    training, null never resets the scene."""
    curriculum: list[tuple[int, int | None]] = field(default_factory=list)
    """[[until_step, T], ...]: T up to and including that interaction step (summed over the streams), null for no
    scene reset, later scene_reset_interval. The paper's curriculum of a 1.3 M step run is [[650000, 320]]."""
    reset_phase: str = "together"
    """When a stream's scene reset is due: `together`, all streams at multiples of T, or `staggered`, each of them
    every T steps as well, but at times that are spread evenly over the streams."""
    end_effector_reset: bool = True
    """Send the arm home at every task switch (EER). The objects stay; it costs no intervention."""
    heuristic_reset: bool = False
    """At a task switch, put back the bodies that no task can reach any more (HSR). It is an intervention."""
    learned_reset: bool = False
    """After every task, the stream is told to put that object back on the table (LSR)."""
    extra_resets: list[str] = field(default_factory=list)
    """Your own strategies by their registered names, applied in this order between HSR and the scene reset."""
    reset_budget: int | None = None
    """B: stop once this many interventions, summed over the streams, have been spent. null is no limit."""
    task_order: str = "heuristic"
    """How the next task is chosen: `heuristic` (the fixed cycle of Appendix E), `random` (uniform) or the name of
    a registered order."""
    num_configurations: int = NUM_CONFIGURATIONS
    """Scene resets draw from the first N configurations of the training split. A scene of the package has 64."""
    reward: str = "difference"
    """`difference` pays the change of the reward level (0.1 grasped, 1.0 success) between two steps, `level`
    pays the level at every step."""

    def __post_init__(self) -> None:
        for name, low in (("task_switch_interval", 1), ("num_configurations", 1), ("reset_budget", 1)):
            if (value := getattr(self, name)) is not None and value < low:
                raise ValueError(f"--protocol.{name} must be >= {low}, got {value}.")
        for name, valid in (("reset_phase", RESET_PHASES), ("reward", REWARDS)):
            if getattr(self, name) not in valid:
                raise ValueError(f"--protocol.{name} must be one of {valid}, got {getattr(self, name)!r}.")
        intervals = [interval for _, interval in self.curriculum]
        for name, multiples in (
            ("update_interval", [self.update_interval]),
            ("scene_reset_interval", [self.scene_reset_interval]),
            ("curriculum", intervals),
        ):
            if any(m is not None and (m < 1 or m % self.task_switch_interval) for m in multiples):
                raise ValueError(
                    f"--protocol.{name} must be a positive multiple of --protocol.task_switch_interval="
                    f"{self.task_switch_interval}, got {getattr(self, name)}."
                )
        ends = [until_step or 0 for until_step, _ in self.curriculum]
        if ends != sorted(set(ends)) or 0 in ends:
            raise ValueError(f"--protocol.curriculum must have increasing steps > 0, got {self.curriculum}.")

    def scene_reset_interval_at(self, interaction_step: int) -> int | None:
        """T in force at `interaction_step` (summed over the streams); None means no periodic reset."""
        for until_step, interval in self.curriculum:
            if interaction_step <= until_step:
                return interval
        return self.scene_reset_interval
