"""The reset-free training protocol of CRONOS (paper, Section 5 and Algorithm 1) as one config."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS
from lerobot_env_cronos.vector_env import REWARDS

from cronos_lerobot.protocol.interventions import Intervention

COUNTED_INTERVENTIONS = (Intervention.SCENE_RESET, Intervention.HEURISTIC_RESET, Intervention.DIVERGENCE)
"""What spends the budget B. Task switches, end-effector resets and the first placement are free."""


@dataclass
class ProtocolConfig:
    """When a stream switches task, when the policy learns, what help a stream gets. Misfits are a ValueError."""

    task_switch_interval: int = 80
    """K: control steps of one stream between two task switches, the length of a segment."""
    update_interval: int = 160
    """U: control steps of each stream between two policy updates; a multiple of K."""
    scene_reset_interval: int | None = 1280
    """T (H in Algorithm 1): control steps of one stream between two scene resets; a multiple of K.
    80 is episodic training, null never resets the scene."""
    curriculum: list[tuple[int, int]] = field(default_factory=list)
    """[[until_step, T], ...]: T up to and including that interaction step (summed over the streams), later
    scene_reset_interval. The paper's curriculum of a 1.3 M step run is [[650000, 320]]."""
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
    """Scene resets draw from the first so many configurations of the training split, 1 to 64."""
    reward: str = "difference"
    """`difference` pays the change of the reward level (0.1 grasped, 1.0 success) between two steps, `level`
    pays the level at every step."""

    def __post_init__(self) -> None:
        if self.task_switch_interval < 1:
            raise ValueError(f"protocol.task_switch_interval must be >= 1, got {self.task_switch_interval}.")
        self._check_multiple_of_k("update_interval", self.update_interval)
        if self.scene_reset_interval is not None:
            self._check_multiple_of_k("scene_reset_interval", self.scene_reset_interval)
        self._check_curriculum()
        if self.reset_budget is not None and self.reset_budget < 1:
            raise ValueError(f"protocol.reset_budget must be >= 1 or null, got {self.reset_budget}.")
        if self.reward not in REWARDS:
            raise ValueError(f"protocol.reward must be one of {REWARDS}, got {self.reward!r}.")
        if not 1 <= self.num_configurations <= NUM_CONFIGURATIONS:
            raise ValueError(
                f"protocol.num_configurations must be 1 to {NUM_CONFIGURATIONS}, got {self.num_configurations}."
            )

    def scene_reset_interval_at(self, interaction_step: int) -> int | None:
        """T in force at `interaction_step` (summed over the streams); None means no periodic reset."""
        for until_step, interval in self.curriculum:
            if interaction_step <= until_step:
                return interval
        return self.scene_reset_interval

    def _check_multiple_of_k(self, name: str, interval: int) -> None:
        if interval < 1 or interval % self.task_switch_interval:
            raise ValueError(
                f"protocol.{name} must be a positive multiple of protocol.task_switch_interval="
                f"{self.task_switch_interval}, got {interval}."
            )

    def _check_curriculum(self) -> None:
        last = 0
        for until_step, interval in self.curriculum:
            self._check_multiple_of_k("curriculum's T", interval)
            if until_step <= last:
                raise ValueError(
                    f"protocol.curriculum must have increasing until_steps > 0, got {self.curriculum}."
                )
            last = until_step
