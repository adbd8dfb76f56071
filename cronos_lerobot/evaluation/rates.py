"""Success rates with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot_env_cronos.statistics import Z_95, wilson_interval
from scipy.stats import t as student_t


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


def effective_trials(successes: np.ndarray, clusters: np.ndarray) -> float:
    """How many independent trials would say as much as these, of which those of one cluster go together.

    n over the design effect: the variance of the rate between clusters over that of n independent trials, at least
    1, with Student's quantile in place of the normal one as there are few clusters (Korn and Graubard 1998). Where
    all trials came out alike, nothing says how much they go together: as if completely, one for each cluster.

    Args:
        successes: (n,) bool.
        clusters: (n,) whatever names a trial's cluster.
    """
    n, rate = len(successes), float(np.mean(successes))
    _, members = np.unique(clusters, return_inverse=True)
    sizes, counts = np.bincount(members), np.bincount(members, weights=successes)
    k = len(sizes)
    if k == n or k == 1 or rate in (0, 1):
        return float(k)
    between = k / (k - 1) * np.sum((counts - rate * sizes) ** 2) / n**2
    design_effect = max(1.0, between / (rate * (1 - rate) / n))
    return n / design_effect * (Z_95 / float(student_t.ppf(0.975, k - 1))) ** 2


def cluster_interval(successes: np.ndarray, clusters: np.ndarray) -> tuple[float, float]:
    """95 % interval of a success rate whose trials go together by cluster: Wilson's, of `effective_trials`."""
    n = effective_trials(successes, clusters)
    return wilson_interval(float(np.mean(successes)) * n, n)
