"""Success rates, their gains, and 95 % intervals of both."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from lerobot_env_cronos.statistics import wilson_interval


@dataclass(frozen=True)
class Rate:
    """`successes` out of `n` independent episodes."""

    successes: int
    n: int

    @property
    def value(self) -> float:
        """The rate, 0 to 1."""
        return self.successes / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % Wilson score interval."""
        return wilson_interval(self.successes, self.n)

    def __add__(self, other: Rate) -> Rate:
        """Both sets of episodes together."""
        return Rate(self.successes + other.successes, self.n + other.n)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.value:.3f} [{low:.3f}, {high:.3f}] n={self.n}"


@dataclass(frozen=True)
class Gain:
    """Success before and after a training."""

    before: Rate
    after: Rate

    @property
    def value(self) -> float:
        """After minus before."""
        return self.after.value - self.before.value

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval by `newcombe_interval`."""
        return newcombe_interval(self.before, self.after)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.value:+.3f} [{low:+.3f}, {high:+.3f}]"


def newcombe_interval(before: Rate, after: Rate) -> tuple[float, float]:
    """Return the 95 % interval of `after - before`, two independent proportions.

    Newcombe 1998, "Interval estimation for the difference between independent proportions", method 10: the
    distances from the rates to the ends of their Wilson intervals, added in quadrature.
    """
    difference = after.value - before.value
    (low_b, high_b), (low_a, high_a) = before.interval, after.interval
    below = hypot(after.value - low_a, high_b - before.value)
    above = hypot(high_a - after.value, before.value - low_b)
    return difference - below, difference + above
