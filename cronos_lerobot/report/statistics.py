"""Success rates, their gains, and 95 % intervals of both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from math import hypot, sqrt
from operator import add, attrgetter

import numpy as np
from lerobot_env_cronos.statistics import wilson_interval
from scipy.stats import t as student_t

from cronos_lerobot.evaluation.rates import cluster_interval
from cronos_lerobot.protocol.metrics import summarise, summarise_rates


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
class ChainRate(Rate):
    """Chains of tasks, of which those from one configuration go together."""

    flags: tuple[bool, ...] = ()
    """Whether each was completed."""
    configurations: tuple[int, ...] = ()
    """Where each began."""

    @classmethod
    def of(cls, flags: Sequence[bool], starts: Sequence[int]) -> ChainRate:
        """The rate of chains that begin with one of these configurations after the other, and anew."""
        return cls(sum(flags), len(flags), tuple(flags), tuple(starts[i % len(starts)] for i in range(len(flags))))

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval, by configuration."""
        return cluster_interval(np.array(self.flags), np.array(self.configurations))

    def __add__(self, other: Rate) -> Rate:
        """Both sets of chains together."""
        if not isinstance(other, ChainRate):
            return super().__add__(other)
        flags, configurations = self.flags + other.flags, self.configurations + other.configurations
        return ChainRate(self.successes + other.successes, self.n + other.n, flags, configurations)


@dataclass(frozen=True)
class SeedRate(Rate):
    """The episodes of several seeds together. Those of a seed are no more independent than its training."""

    seeds: tuple[Rate, ...] = ()
    """Each of them."""

    @classmethod
    def of(cls, seeds: Iterable[Rate]) -> SeedRate:
        """The rate of some seeds."""
        rates = tuple(seeds)
        return cls(sum(rate.successes for rate in rates), sum(rate.n for rate in rates), rates)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % t-interval of the mean over the seeds, within 0 and 1; of one, or of some all alike, that of one.

        Seeds are evaluated on the same episodes: together they are no more of them. Where they have other numbers
        of episodes, it is the one of a ratio (Cochran 1977, section 6.3), which is the same for equal numbers.
        """
        seeds = [rate for rate in self.seeds if rate.n]
        if len({rate.n for rate in seeds}) > 1:
            return _ratio_interval(seeds)
        summary = summarise_rates([rate.value for rate in seeds])
        over_seeds = summary.ci95 if summary else None
        return over_seeds or seeds[0].interval

    def __add__(self, other: Rate) -> Rate:
        """Both sets of episodes together, seed by seed if they are of as many."""
        if not isinstance(other, SeedRate) or len(other.seeds) != len(self.seeds):
            return super().__add__(other)
        return SeedRate.of(map(add, self.seeds, other.seeds))

    def __str__(self) -> str:
        return super().__str__() + (f" ({len(self.seeds)} seeds)" if len(self.seeds) > 1 else "")


def _ratio_interval(seeds: Sequence[Rate]) -> tuple[float, float]:
    """Of all successes over all episodes of two seeds or more; of some all alike that of the one with most."""
    k, n = len(seeds), sum(rate.n for rate in seeds)
    value = sum(rate.successes for rate in seeds) / n
    residuals = np.array([rate.successes - value * rate.n for rate in seeds])
    if np.allclose(residuals, 0):
        return max(seeds, key=attrgetter("n")).interval
    half = float(student_t.ppf(0.975, k - 1)) * sqrt(k / (k - 1) * float(residuals @ residuals)) / n
    return max(value - half, 0.0), min(value + half, 1.0)


def sum_rates(rates: Iterable[Rate]) -> Rate:
    """All episodes together."""
    found = list(rates)
    return reduce(add, found) if found else Rate(0, 0)


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
        """Its 95 % interval, within -1 and 1: over the seeds where each has a before of its own, else Newcombe's.

        The second is of the interval over the seeds after, if there are several, and of the one before.
        """
        before, after = (getattr(rate, "seeds", ()) for rate in (self.before, self.after))
        if len(before) == len(after) > 1:
            summary = summarise([new.value - old.value for old, new in zip(before, after, strict=True)])
            if summary and (ends := summary.within(-1.0, 1.0).varied_ci95):
                return ends
        return newcombe_interval(self.before, self.after)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.value:+.3f} [{low:+.3f}, {high:+.3f}]"


def newcombe_interval(before: Rate, after: Rate) -> tuple[float, float]:
    """Return the 95 % interval of `after - before`, two independent proportions or means with their intervals.

    Newcombe 1998, "Interval estimation for the difference between independent proportions", method 10: the
    distances from the rates to the ends of their (Wilson) intervals, added in quadrature.
    """
    difference = after.value - before.value
    (low_b, high_b), (low_a, high_a) = before.interval, after.interval
    below = hypot(after.value - low_a, high_b - before.value)
    above = hypot(high_a - after.value, before.value - low_b)
    return difference - below, difference + above
