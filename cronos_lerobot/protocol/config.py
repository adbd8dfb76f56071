"""The reset-free training protocol of CRONOS (paper, Section 5 and Algorithm 1) as one config."""

from __future__ import annotations

from dataclasses import dataclass, field

RESET_PHASES = ("together", "staggered")
REWARDS = ("difference", "level")
OF_THE_WORLD = -1
"""Value of an interval that follows from the steps of a task."""


@dataclass
class ProtocolConfig:
    """When a stream switches task, when the policy learns, and which resets a stream gets.

    The intervals follow from the environment's steps of a task unless they are given; see `resolve`.

    Raises:
        ValueError: an interval is no multiple of K, or a value is not valid.
    """

    task_switch_interval: int = OF_THE_WORLD
    """K: control steps of one stream between two task switches, the length of a segment; -1 takes the
    environment's, 80 for kitchen_2x2."""
    update_interval: int = OF_THE_WORLD
    """U: control steps of each stream between two policy updates; a multiple of K. -1 is 2 K."""
    scene_reset_interval: int | None = OF_THE_WORLD
    """T (H in Algorithm 1): control steps of one stream between two scene resets; a multiple of K. -1 is 16 K, K
    is episodic training, null never resets the scene."""
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
    num_configurations: int | None = None
    """Scene resets draw from the first N configurations of the training split; null draws from all."""
    reward: str = "difference"
    """`difference` pays the change of the reward level (0.1 grasped, 1.0 success) between two steps, `level`
    pays the level at every step."""

    def __post_init__(self) -> None:
        for name in ("num_configurations", "reset_budget"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"--protocol.{name} must be >= 1, got {value}.")
        if self.task_switch_interval != OF_THE_WORLD:
            self.resolve(self.task_switch_interval)
        for name, valid in (("reset_phase", RESET_PHASES), ("reward", REWARDS)):
            if getattr(self, name) not in valid:
                raise ValueError(f"--protocol.{name} must be one of {valid}, got {getattr(self, name)!r}.")
        ends = [until_step or 0 for until_step, _ in self.curriculum]
        if ends != sorted(set(ends)) or 0 in ends:
            raise ValueError(f"--protocol.curriculum must have increasing steps > 0, got {self.curriculum}.")

    def resolve(self, steps_per_task: int) -> ProtocolConfig:
        """Fill in the intervals that were not given, for a world whose tasks have so many control steps.

        Raises:
            ValueError: an interval is no multiple of K.
        """
        if self.task_switch_interval == OF_THE_WORLD:
            self.task_switch_interval = steps_per_task
        if (K := self.task_switch_interval) < 1:
            raise ValueError(f"--protocol.task_switch_interval must be >= 1, got {K}.")
        if self.update_interval == OF_THE_WORLD:
            self.update_interval = 2 * K
        if self.scene_reset_interval == OF_THE_WORLD:
            self.scene_reset_interval = 16 * K
        for name, multiples in (
            ("update_interval", [self.update_interval]),
            ("scene_reset_interval", [self.scene_reset_interval]),
            ("curriculum", [interval for _, interval in self.curriculum]),
        ):
            if any(m is not None and (m < 1 or m % K) for m in multiples):
                raise ValueError(
                    f"--protocol.{name} must be a positive multiple of --protocol.task_switch_interval={K}, got "
                    f"{getattr(self, name)}."
                )
        return self

    def scene_reset_interval_at(self, interaction_step: int) -> int | None:
        """T in force at `interaction_step` (summed over the streams); None means no periodic reset."""
        for until_step, interval in self.curriculum:
            if interaction_step <= until_step:
                return interval
        return self.scene_reset_interval
