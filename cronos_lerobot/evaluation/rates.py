"""Success rates with their intervals."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from lerobot_env_cronos.statistics import wilson_interval


@dataclass(frozen=True)
class SuccessRate:
    """Successes of n episodes."""

    successes: int
    n: int

    @classmethod
    def of(cls, flags: Iterable[bool]) -> SuccessRate:
        """The rate of some outcomes."""
        flags = list(flags)
        return cls(sum(map(bool, flags)), len(flags))

    def to_dict(self) -> dict[str, Any]:
        """Rate, n and the ends of the 95 % interval."""
        low, high = wilson_interval(self.successes, self.n)
        return {"success": self.successes / self.n, "n": self.n, "ci95": [low, high]}
