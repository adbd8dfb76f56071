"""The reset-free training protocol of CRONOS (paper, Section 5 and Algorithm 1) as one config."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field

from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS
from lerobot_env_cronos.vector_env import REWARDS

from cronos_lerobot.protocol.interventions import Intervention

COUNTED_INTERVENTIONS = (Intervention.SCENE_RESET, Intervention.HEURISTIC_RESET, Intervention.DIVERGENCE)
"""What spends 1 of the budget B. Task switches, end-effector resets and the first placement are free; a takeover
spends `ProtocolConfig.takeover_price`."""
MAX_FAILURES = 16
"""Half of the segments that `LoopState` remembers: with learned resets every second one is no task."""

RESET_PHASES = ("together", "staggered")
SCENE_RESETS = ("periodic", "critic")
RESET_STARTS = ("random", "learnable")
VALUELESS_ORDERS = ("heuristic", "random")
"""Task orders that ask for no values; those of a user's may."""


@dataclass
class CriticConfig:
    """How the agent's values choose tasks (`task_order=critic`) and scene resets (`scene_reset=critic`)."""

    certain_value: float = 0.8
    """The value from which on a success is taken for certain: p = V / certain_value, clipped to [0, 1]. That of a
    success some twenty steps away at gamma = 0.99, for `reward=difference`; `level` pays many times as much."""
    floor: float = 0.02
    """What every task has beside p (1 - p), so that none is ever left out for its value."""
    sharpness: float = 2.0
    """A task is drawn with a probability proportional to (p (1 - p) + floor) ** sharpness; 0 is uniform."""
    knows_complete: bool = True
    """Complete tasks are known, and not given while there are others. false: a robot is told no more than whether
    the task that it has just tried is complete."""
    failures: int = 2
    """Tasks in a row that a stream has failed, all since its last scene reset, before it may get one."""

    def __post_init__(self) -> None:
        for name in ("certain_value", "floor"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise ValueError(f"protocol.critic.{name} must be > 0 and finite, got {value}.")
        if not 0 <= self.sharpness < math.inf:
            raise ValueError(f"protocol.critic.sharpness must be >= 0 and finite, got {self.sharpness}.")
        if not 1 <= self.failures <= MAX_FAILURES:
            raise ValueError(f"protocol.critic.failures must be 1 to {MAX_FAILURES}, got {self.failures}.")


CRITIC_READERS = {
    "certain_value": ("task_order",),
    "floor": ("task_order",),
    "sharpness": ("task_order",),
    "knows_complete": ("task_order", "scene_reset"),
    "failures": ("scene_reset",),
}
"""Who goes by each setting of CriticConfig, if it is `critic`."""


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
    curriculum: list[tuple[int, int | None]] = field(default_factory=list)
    """[[until_step, T], ...]: T up to and including that interaction step (summed over the streams), null
    for no scene reset, later scene_reset_interval. The paper's curriculum of a 1.3 M step run is
    [[650000, 320]]."""
    reset_phase: str = "together"
    """When a stream's scene reset is due: `together`, all streams at multiples of T, or `staggered`, each of them
    every T steps as well, but at times that are spread evenly over the streams."""
    scene_reset: str = "periodic"
    """Who asks for scene resets: `periodic`, every T steps, or `critic`, for streams that have failed their last
    tasks, those first of which the agent's values expect least, as many at a switch as `reset_budget`, spread
    evenly over the run, has by then."""
    reset_starts: str = "random"
    """Where scene resets put a stream: `random`, any training configuration, the next task being the order's, or
    `learnable`, a configuration and a first task of which the policy neither always succeeds nor always fails."""
    critic: CriticConfig = field(default_factory=CriticConfig)
    """How values choose, for `task_order=critic` and `scene_reset=critic`."""
    end_effector_reset: bool = True
    """Send the arm home at every task switch (EER). The objects stay; it costs no intervention."""
    heuristic_reset: bool = False
    """At a task switch, put back the bodies that no task can reach any more (HSR). It is an intervention."""
    learned_reset: bool = False
    """After every task, the stream is told to put that object back on the table (LSR)."""
    extra_resets: list[str] = field(default_factory=list)
    """Your own strategies by their registered names, applied in this order between HSR and the scene reset."""
    reset_budget: int | None = None
    """B: stop once this many interventions, summed over the streams, have been spent. null is no limit. With
    `scene_reset=critic` the resets that are asked for are paced so that a run gets to its last step with it."""
    task_order: str = "heuristic"
    """How the next task is chosen: `heuristic` (the fixed cycle of Appendix E), `random` (uniform), `critic` (what
    the agent's values call neither hopeless nor certain) or the name of a registered order."""
    takeover_after: int | None = None
    """An expert does the next segment of a task that a stream has failed at so many times in a row, those that it
    found complete left out of the count; null is never."""
    takeover_budget: int | None = None
    """What takeovers may add to the interventions in the whole run, paced evenly over its steps; null is no limit
    but reset_budget."""
    takeover_price: int = 1
    """How many interventions a takeover counts as."""
    takeover_expert: str = "scripted"
    """Who takes over: `scripted` or the name of a registered expert."""
    num_configurations: int = NUM_CONFIGURATIONS
    """Scene resets draw from the first so many configurations of the training split; a scene's own has 64, and a
    benchmark as many as it was made with."""
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
        self._check_scene_reset()
        if self.reset_budget is not None and self.reset_budget < 1:
            raise ValueError(f"protocol.reset_budget must be >= 1 or null, got {self.reset_budget}.")
        self._check_takeovers()
        self._check_who_reads_critic()
        if repeated := sorted({name for name in self.extra_resets if self.extra_resets.count(name) > 1}):
            raise ValueError(f"protocol.extra_resets must name each strategy once, got {repeated} more than once.")
        if self.reward not in REWARDS:
            raise ValueError(f"protocol.reward must be one of {REWARDS}, got {self.reward!r}.")
        if self.num_configurations < 1:
            raise ValueError(f"protocol.num_configurations must be >= 1, got {self.num_configurations}.")

    def check_start(self) -> None:
        """Raise a ValueError, if a run should not begin so; one that is resumed may have begun with it."""
        if self.takeover_after is None or self.reset_budget is None:
            return
        if self.reset_budget < self.takeover_price:
            raise ValueError(
                f"protocol.reset_budget={self.reset_budget} pays for no takeover at "
                f"protocol.takeover_price={self.takeover_price}: give at least as much, or null."
            )

    def scene_reset_interval_at(self, interaction_step: int) -> int | None:
        """T in force at `interaction_step` (summed over the streams); None means no periodic reset."""
        if self.scene_reset != "periodic":
            return None
        for until_step, interval in self.curriculum:
            if interaction_step <= until_step:
                return interval
        return self.scene_reset_interval

    def _check_scene_reset(self) -> None:
        choices = {"reset_phase": RESET_PHASES, "scene_reset": SCENE_RESETS, "reset_starts": RESET_STARTS}
        for name, valid in choices.items():
            if getattr(self, name) not in valid:
                raise ValueError(f"protocol.{name} must be one of {valid}, got {getattr(self, name)!r}.")
        intervals = {T or 0 for T in (self.scene_reset_interval, *(T for _, T in self.curriculum))}
        if self.reset_starts != "random":
            self._check_reset_starts(intervals if self.scene_reset == "periodic" else None)
        if self.scene_reset == "periodic":
            longest = max(intervals)
            if self.reset_phase == "staggered" and longest <= self.task_switch_interval:
                raise ValueError(
                    "protocol.reset_phase=staggered puts resets at other task switches, and there is none between "
                    f"them with protocol.scene_reset_interval={self.scene_reset_interval}: leave it out."
                )
            return
        if self.reset_budget is None:
            raise ValueError("protocol.scene_reset=critic spends a budget: give protocol.reset_budget, as 1000.")
        if self.curriculum or self.reset_phase != "together":
            raise ValueError(
                "protocol.curriculum and protocol.reset_phase say when periodic scene resets come; with "
                "protocol.scene_reset=critic there are none: leave them out."
            )
        # The default cannot be told from one that was given.
        if self.scene_reset_interval not in (None, ProtocolConfig.scene_reset_interval):
            raise ValueError(
                f"protocol.scene_reset_interval={self.scene_reset_interval} is for periodic scene resets; with "
                "protocol.scene_reset=critic there are none: leave it out, or give null."
            )

    def _check_reset_starts(self, intervals: set[int] | None) -> None:
        if self.learned_reset:
            raise ValueError(
                f"protocol.reset_starts={self.reset_starts} says which task comes first after a scene reset, and "
                "with protocol.learned_reset=true it may be a reset task: choose one of them."
            )
        if intervals == {0}:
            raise ValueError(
                f"protocol.reset_starts={self.reset_starts} says where scene resets put a stream that are "
                "periodic or that the critic asks for, and with protocol.scene_reset_interval=null there are none "
                "of them: leave one of the two out."
            )
        if intervals == {self.task_switch_interval} and self.task_order != "heuristic":
            raise ValueError(
                f"protocol.reset_starts={self.reset_starts} says which task comes first after a scene reset, and "
                f"with one at every task switch protocol.task_order={self.task_order} would say nothing: leave "
                "one of the two out."
            )

    def _check_takeovers(self) -> None:
        for name in ("takeover_after", "takeover_budget"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"protocol.{name} must be >= 1 or null, got {value}.")
        if self.takeover_price < 1:
            raise ValueError(f"protocol.takeover_price must be >= 1, got {self.takeover_price}.")
        if self.takeover_after is None:
            for name in ("takeover_budget", "takeover_price", "takeover_expert"):
                value, default = getattr(self, name), getattr(ProtocolConfig, name)
                if value != default:
                    raise ValueError(
                        f"protocol.{name}={value} is for takeovers, and there are none without "
                        f"protocol.takeover_after: give that, as 2, or leave this at {default or 'null'}."
                    )
        if self.takeover_budget is not None and self.takeover_budget < self.takeover_price:
            raise ValueError(
                f"protocol.takeover_budget={self.takeover_budget} pays for no takeover at "
                f"protocol.takeover_price={self.takeover_price}: give at least as much, or null."
            )

    def _check_who_reads_critic(self) -> None:
        # Strategies and orders of a user's may go by values, too.
        if self.task_order not in (*VALUELESS_ORDERS, "critic") or self.extra_resets:
            return
        default = CriticConfig()
        for name, value in vars(self.critic).items():
            readers = CRITIC_READERS[name]
            if value != getattr(default, name) and not any(
                getattr(self, reader) == "critic" for reader in readers
            ):
                wanted = " or ".join(f"protocol.{reader}=critic" for reader in readers)
                raise ValueError(
                    f"protocol.critic.{name}={json.dumps(value)} is read by {wanted} alone: give that, or leave "
                    f"it at {json.dumps(getattr(default, name))}."
                )

    def _check_multiple_of_k(self, name: str, interval: int) -> None:
        if interval < 1 or interval % self.task_switch_interval:
            raise ValueError(
                f"protocol.{name} must be a positive multiple of protocol.task_switch_interval="
                f"{self.task_switch_interval}, got {interval}."
            )

    def _check_curriculum(self) -> None:
        last = 0
        for until_step, interval in self.curriculum:
            if interval is not None:
                self._check_multiple_of_k("curriculum's T", interval)
            # Draccus takes null for every number.
            if until_step is None or until_step <= last:
                raise ValueError(
                    f"protocol.curriculum must have increasing until_steps > 0, got {self.curriculum}."
                )
            last = until_step
