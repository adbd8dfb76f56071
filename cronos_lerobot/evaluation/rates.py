"""Success rates with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from lerobot_env_cronos.statistics import wilson_interval


@dataclass(frozen=True)
class SuccessRate:
    """Successes of n episodes, and how many of them nobody picked anything up for."""

    successes: int
    n: int
    found_complete: int = 0
    """Successes of tasks that were complete when they were given."""
    never_grasped: int = 0
    """Other successes whose object was never grasped."""

    @classmethod
    def of(cls, records: Iterable[Mapping[str, Any]], position: int = 0) -> SuccessRate:
        """The rate of the tasks at a position of some chains (see `store.chain_records`).

        Every chain counts; a task whose chain failed before it is a failure.
        """
        records = list(records)
        counts = [
            sum(position in record[name] for record in records) for name in ("found_complete", "never_grasped")
        ]
        return cls(sum(record["length"] > position for record in records), len(records), *counts)

    def to_dict(self) -> dict[str, Any]:
        """Rate, n, the ends of the 95 % interval, and the successes that were found or came without a grasp."""
        low, high = wilson_interval(self.successes, self.n)
        rate = {"success": self.successes / self.n, "n": self.n, "ci95": [low, high]}
        return rate | {"found_complete": self.found_complete, "never_grasped": self.never_grasped}
