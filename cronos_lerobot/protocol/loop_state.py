"""The state of the main loop, and the events it hands to its observers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cronos_lerobot.protocol.interventions import COUNTED_INTERVENTIONS, Intervention

if TYPE_CHECKING:
    from cronos_lerobot.agents.base import ActionSample


HISTORY = 32
"""Segments of each stream that `LoopState` remembers one by one."""


@dataclass
class LoopState:
    """Counters of Algorithm 1 for `num_streams` streams; all of it is in every checkpoint.

    Every array is (num_streams, ...) and counts that stream alone; `n` and `b` are sums over the streams.
    """

    num_streams: int
    num_tasks: int
    """Tasks that are evaluated: indices 0 .. num_tasks - 1 of the task set."""
    num_reset_tasks: int = 0
    """Learned reset tasks, behind them in the task set. With any, every second segment is one."""
    t: int = 0
    """Control steps taken by each stream."""
    switches: int = 0
    """Task switches of each stream, the first task included."""
    updates: int = 0
    """Policy updates so far: the version of the policy that acts."""
    task: np.ndarray = field(init=False)
    """(N,) index of the current task in the task set."""
    piece: np.ndarray = field(init=False)
    """(N,) index of the current uncut piece of the stream: task switches and divergences both end one."""
    segments_since_reset: np.ndarray = field(init=False)
    """(N,) finished segments since the last scene reset: 0 during the first one after it."""
    begins_segment: bool = True
    """Whether the next step is the first of a segment."""
    succeeded: np.ndarray = field(init=False)
    """(N,) whether the current task has been complete at any step of its segment."""
    grasped: np.ndarray | None = field(init=False)
    """(N,) whether the current task's object has been grasped at any step of its segment; None if unknown."""
    found_complete: np.ndarray = field(init=False)
    """(N,) whether the task was complete after the segment's first step: an earlier task left it so."""
    diverged: np.ndarray = field(init=False)
    """(N,) whether the simulation broke down in the last step and waits to be put back."""
    preceded_by: np.ndarray = field(init=False)
    """(N,) Intervention between the last step and the next one."""
    intervened: np.ndarray = field(init=False)
    """(N,) whether a person or a script acted in the last step."""
    helped: np.ndarray = field(init=False)
    """(N,) whether one acted at any step of the current segment."""
    attempts: np.ndarray = field(init=False)
    """(N, tasks) finished segments of each task of the task set, reset tasks included, without those with help."""
    successes: np.ndarray = field(init=False)
    """(N, tasks) of these, those with a success."""
    recent_task: np.ndarray = field(init=False)
    """(N, HISTORY) tasks of the latest segments, the last one at the end; -1 where there was none yet."""
    recent_success: np.ndarray = field(init=False)
    """(N, HISTORY) whether they were a success, with or without help: 1 or 0; -1 where there was none."""
    interventions: np.ndarray = field(init=False)
    """(N, len(Intervention)) events of each kind."""

    def __post_init__(self) -> None:
        n = self.num_streams
        self.task = np.zeros(n, np.int64)
        self.piece = np.zeros(n, np.int64)
        self.segments_since_reset = np.zeros(n, np.int64)
        self.succeeded = np.zeros(n, np.bool_)
        self.grasped = np.zeros(n, np.bool_)
        self.found_complete = np.zeros(n, np.bool_)
        self.diverged = np.zeros(n, np.bool_)
        self.preceded_by = np.full(n, Intervention.NONE, np.int64)
        self.intervened = np.zeros(n, np.bool_)
        self.helped = np.zeros(n, np.bool_)
        self.attempts = np.zeros((n, self.num_tasks + self.num_reset_tasks), np.int64)
        self.successes = np.zeros_like(self.attempts)
        self.recent_task = np.full((n, HISTORY), -1, np.int64)
        self.recent_success = np.full((n, HISTORY), -1, np.int64)
        self.interventions = np.zeros((n, len(Intervention)), np.int64)

    @property
    def n(self) -> int:
        """Interaction steps, summed over the streams."""
        return self.t * self.num_streams

    @property
    def round(self) -> int:
        """Tasks that each stream has been given so far, reset tasks not counted."""
        return (self.switches + 1) // 2 if self.num_reset_tasks else self.switches

    @property
    def b(self) -> int:
        """Interventions that count against the budget, summed over the streams."""
        return int(self.stream_interventions.sum())

    @property
    def stream_interventions(self) -> np.ndarray:
        """(N,) interventions of each stream that count against the budget."""
        return self.interventions[:, COUNTED_INTERVENTIONS].sum(axis=1)

    def interventions_by_kind(self) -> dict[str, int]:
        """Events of each kind summed over the streams, by lower-case name."""
        return {
            kind.name.lower(): int(self.interventions[:, kind].sum())
            for kind in Intervention
            if kind is not Intervention.NONE
        }

    def switch_task(self, task: np.ndarray) -> None:
        """Begin a segment of every stream.

        Args:
            task: (N,) int, indices into the task set.

        Raises:
            ValueError: it is anything else.
        """
        task = np.asarray(task)
        is_int = task.shape == (self.num_streams,) and task.dtype.kind in "iu"
        if not (is_int and ((task >= 0) & (task < self.num_tasks + self.num_reset_tasks)).all()):
            raise ValueError(
                f"--protocol.task_order must draw ({self.num_streams},) ints from 0 to {self.num_tasks - 1}, "
                f"got {task!r}."
            )
        self.task = task.astype(np.int64)
        self.begins_segment = True
        self.switches += 1
        self.interventions[:, Intervention.TASK_SWITCH] += 1
        self.preceded_by = np.maximum(self.preceded_by, Intervention.TASK_SWITCH)

    def count_help(self, intervened: np.ndarray | None) -> None:
        """Count one HELP for each stream where help begins.

        Args:
            intervened: (N,) bool, a person or a script acted in this step; None where nobody can.
        """
        acted = np.zeros(self.num_streams, np.bool_) if intervened is None else intervened
        self.interventions[:, Intervention.HELP] += acted & ~self.intervened
        self.intervened = acted.copy()
        self.helped |= acted

    def count_step(self, info: dict[str, Any], cut: np.ndarray) -> None:
        """Count one control step of every stream.

        Args:
            info: the environment's `is_success`, `diverged` and, if known, `is_grasped` after the step, (N,) bool
                each.
            cut: (N,) bool, where the stream's piece ends here.
        """
        self.t += 1
        self.succeeded |= info["is_success"]
        now = info.get("is_grasped")
        self.grasped = None if now is None or self.grasped is None else self.grasped | now
        self.diverged = info["diverged"].copy()
        if self.begins_segment:
            # No task can be done in one step.
            self.found_complete = info["is_success"].copy()
        self.begins_segment = False
        self.piece += cut
        self.preceded_by = np.full(self.num_streams, Intervention.NONE, np.int64)

    def count_intervention(self, ids: np.ndarray, kind: Intervention) -> None:
        """Count one event of `kind` for each stream of `ids`."""
        self.interventions[ids, kind] += 1
        self.preceded_by[ids] = np.maximum(self.preceded_by[ids], kind)
        if kind in (Intervention.SCENE_RESET, Intervention.DIVERGENCE, Intervention.INITIAL):
            self.segments_since_reset[ids] = 0
        if kind is Intervention.DIVERGENCE:
            self.diverged[ids] = False

    def end_segment(self) -> SegmentEnd:
        """Close the segment of every stream and return what it came to."""
        earned = self.succeeded & ~self.found_complete
        end = SegmentEnd(
            self.task,
            self.segments_since_reset.copy(),
            success=self.succeeded,
            found_complete=self.found_complete,
            never_grasped=None if self.grasped is None else earned & ~self.grasped,
            helped=self.helped,
        )
        streams, own = np.arange(self.num_streams), ~self.helped
        self.attempts[streams, self.task] += own
        self.successes[streams, self.task] += self.succeeded & own
        self.recent_task = np.column_stack([self.recent_task[:, 1:], self.task])
        self.recent_success = np.column_stack([self.recent_success[:, 1:], self.succeeded])
        self.succeeded = np.zeros(self.num_streams, np.bool_)
        self.grasped = np.zeros(self.num_streams, np.bool_)
        self.helped = np.zeros(self.num_streams, np.bool_)
        self.segments_since_reset += 1
        return end

    def state_dict(self) -> dict[str, Any]:
        """Every field by name, arrays as nested lists, ready for JSON."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self).items()}

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> LoopState:
        """Inverse of `state_dict`."""
        loop = cls(state["num_streams"], state["num_tasks"], state["num_reset_tasks"])
        for name, value in state.items():
            template = getattr(loop, name)
            if isinstance(template, np.ndarray):
                value = np.asarray(value, template.dtype).reshape(template.shape)
            setattr(loop, name, value)
        return loop


@dataclass(frozen=True)
class Step:
    """One control step of all N streams: what was seen, done and earned at time t."""

    t: int
    """Control steps each stream had taken before this one."""
    observation: dict[str, Any]
    """o_t, the raw observation acted on."""
    instructions: list[str]
    action: ActionSample
    reward: np.ndarray
    """(N,) r_t of the task that was acted on."""
    success: np.ndarray
    """(N,) bool, the task is complete after this step."""
    diverged: np.ndarray
    """(N,) bool, the simulation broke down in this step."""
    cut: np.ndarray
    """(N,) bool, this is the last frame of its uncut piece."""
    piece: np.ndarray
    """(N,) index of that piece within its stream."""
    segments_since_reset: np.ndarray
    """(N,) finished segments since the last scene reset."""
    preceded_by: np.ndarray
    """(N,) Intervention between the step before and this one."""
    interventions: np.ndarray
    """(N,) counted interventions of the stream before this step."""
    policy_version: int
    """Number of updates of the policy that acted."""
    intervened: np.ndarray
    """(N,) bool, a person or a script acted in this step."""


@dataclass(frozen=True)
class Update:
    """The policy has been updated."""

    metrics: dict[str, float]


@dataclass(frozen=True)
class SegmentEnd:
    """A segment of every stream is over and its resets are done: where a run can be saved."""

    task: np.ndarray
    """(N,) index of the task of the segment."""
    segments_since_reset: np.ndarray
    """(N,) how many segments came before it since the last scene reset."""
    success: np.ndarray
    """(N,) bool, complete at any step of the segment."""
    found_complete: np.ndarray
    """(N,) bool, a success for which nothing had to be done: an earlier task had left it complete."""
    never_grasped: np.ndarray | None
    """(N,) bool, another success whose object was grasped at no step of the segment: pushed or dropped. None where
    the environment does not say what is grasped."""
    helped: np.ndarray
    """(N,) bool, a person or a script acted at any step of it."""


Event = Step | Update | SegmentEnd
