"""What the streams achieved between two policy updates, as it is logged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from cronos_lerobot.protocol.loop_state import Event, SegmentEnd, Step


class Count(NamedTuple):
    """So many of n; a list of both in JSON, a rate in TensorBoard."""

    successes: int
    n: int

    @property
    def rate(self) -> float | None:
        """Their share; None of nothing."""
        return self.successes / self.n if self.n else None


class RolloutStatistics:
    """Success and reward of the streams between two policy updates.

    Args:
        instructions: of the task set, in the order of its indices.
        num_tasks: how many of them are evaluated, the first ones; the rest are reset tasks. None is all.
    """

    SORTS = ("success", "found_complete", "never_grasped")
    """Fields of SegmentEnd: all successes, and the two sorts that are counted apart, as far as they are known."""

    def __init__(self, instructions: Sequence[str], num_tasks: int | None = None) -> None:
        self.instructions = list(instructions)
        self.num_tasks = len(self.instructions) if num_tasks is None else num_tasks
        self._state = self._empty()

    def on_event(self, event: Event) -> None:
        """Take in a Step or the end of a segment."""
        state = self._state
        if isinstance(event, Step):
            state["reward"] += float(event.reward[~event.intervened].sum())
            state["diverged"] += int(event.diverged.sum())
        elif isinstance(event, SegmentEnd):
            if event.never_grasped is None:
                state["by_segment"].pop("never_grasped", None)
            for stream, task in enumerate(event.task):
                if event.helped[stream]:
                    state["helped"][0] += int(event.success[stream])
                    state["helped"][1] += 1
                    continue
                self._count(state["by_task"], self.instructions[task], event.success[stream])
                if task < self.num_tasks:
                    segment = str(event.segments_since_reset[stream])
                    for sort, table in state["by_segment"].items():
                        self._count(table, segment, getattr(event, sort)[stream])

    def pop(self) -> dict[str, Any]:
        """Return the statistics since the last `pop`, and begin anew.

        `success` is the rate in all `segments`, [k, n] those `found_complete` (successes for which nothing had to
        be done) and `never_grasped` (other successes whose object was never grasped; absent where the environment
        does not say what is grasped). The `..._by_segment` have one [k, n] for each number of segments since the
        scene reset, `success_by_task` one for each instruction. Learned reset tasks are in the last one only.
        Segments with help are counted in `helped`, [k, n], and in none of the others.
        """
        state = self._state
        total = {sort: _total(table.values()) for sort, table in state["by_segment"].items()}
        success = total.pop("success")
        all_segments = _total(state["by_task"].values()).n
        statistics = {
            "success": success.rate,
            "segments": success.n,
            **total,
            **{
                f"{sort}_by_segment": {key: Count(*table[key]) for key in sorted(table, key=int)}
                for sort, table in state["by_segment"].items()
            },
            "success_by_task": {
                task: Count(*state["by_task"][task]) for task in self.instructions if task in state["by_task"]
            },
            "reward_per_segment": state["reward"] / all_segments if all_segments else None,
            "diverged": state["diverged"],
            "helped": Count(*state["helped"]),
        }
        self._state = self._empty()
        return statistics

    def state_dict(self) -> dict[str, Any]:
        """What was taken in since the last `pop`."""
        return self._state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self._state = state

    @classmethod
    def _empty(cls) -> dict[str, Any]:
        by_segment: dict[str, Any] = {sort: {} for sort in cls.SORTS}
        return {"reward": 0.0, "diverged": 0, "helped": [0, 0], "by_task": {}, "by_segment": by_segment}

    @staticmethod
    def _count(table: dict[str, list[int]], key: str, success: bool) -> None:
        counts = table.setdefault(key, [0, 0])
        counts[0] += int(success)
        counts[1] += 1


def _total(counts: Any) -> Count:
    """The sum of [k, n]."""
    pairs = list(counts)
    return Count(sum(k for k, _ in pairs), sum(n for _, n in pairs))
