"""The difference of two policies, or of two ways to train them, on the same episodes.

What is done on the same episodes goes together: the difference of each pair says more than the two rates apart.
The episodes of one configuration go together, too, as they begin in one scene, so errors are by configuration
(Miller 2024, "Adding error bars to evals", arXiv:2411.00640, has both for language models).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from lerobot_env_cronos.statistics import Z_95, wilson_interval
from scipy.optimize import brentq
from scipy.stats import t as student_t

from cronos_lerobot.evaluation.outcomes import Episode
from cronos_lerobot.evaluation.sign_flip import sign_flip_p

ALPHA = 0.05
"""Of all intervals, and of the decision for which `needed` episodes are counted."""
FEWEST = 6
"""Configurations with which p of the sign-flip test, at least 2 / 2**k, can come below ALPHA."""
FEW = 2
"""Trainings of a side of which Satterthwaite's degrees of freedom make too much."""
LEAST = 1e-300
"""A probability below which nobody would ask."""
MOST = 10**7
"""Configurations or trainings beyond which nobody would count."""


@dataclass(frozen=True)
class Pairs:
    """What the policies of two sides did on the same episodes: successes, or lengths of chains."""

    a: np.ndarray
    """(policies of A, episodes) int."""
    b: np.ndarray
    """(policies of B, episodes) int."""
    configurations: np.ndarray
    """(episodes,) the configuration, a cluster of episodes."""
    unit: str = "configuration"
    """What a cluster is, in words."""
    are_chains: bool = False
    """Whether these are lengths, even if all of them are 0 or 1."""

    @classmethod
    def of(cls, a: np.ndarray, b: np.ndarray, episodes: Sequence[Episode]) -> Pairs:
        """Pairs by configuration; where all episodes are of one, by repetition, with draws of its own each."""
        configurations = np.array([episode.configuration for episode in episodes])
        if len(np.unique(configurations)) > 1:
            return cls(a, b, configurations)
        return cls(a, b, np.array([episode.seed for episode in episodes]), "repetition of one configuration")

    @property
    def differences(self) -> np.ndarray:
        """(episodes,) mean of B's policies minus that of A's."""
        return self.b.mean(axis=0) - self.a.mean(axis=0)

    @property
    def whole_differences(self) -> np.ndarray:
        """(clusters,) sum of the differences of each, times the policies of both sides: whole numbers."""
        whole = self.b.sum(axis=0) * len(self.a) - self.a.sum(axis=0) * len(self.b)
        return np.bincount(self.clusters, weights=whole).round().astype(int)

    @property
    def units(self) -> str:
        """What the clusters are, in words that follow their number."""
        first, *rest = self.unit.split()
        if len(np.unique(self.configurations)) == 1:
            return self.unit
        return " ".join([f"{first}s", *rest])

    @property
    def clusters(self) -> np.ndarray:
        """(episodes,) the number of its configuration, from 0."""
        return np.unique(self.configurations, return_inverse=True)[1]

    @property
    def is_binary(self) -> bool:
        """Whether the successes of one policy are compared with those of one other."""
        return self.is_one_each and not self.are_chains and max(self.a.max(), self.b.max()) <= 1

    @property
    def is_one_each(self) -> bool:
        """Whether one policy is compared with one other."""
        return len(self.a) == len(self.b) == 1


@dataclass(frozen=True)
class Difference:
    """B minus A."""

    value: float
    ci95: tuple[float, float] | None
    """None where no two outcomes say how much they vary."""
    p: float | None
    """Two-sided, of no difference."""
    method: str
    """Of the interval and of p."""
    needed: int | None
    """Configurations, or trainings of each side, with which a difference of this size is found with the power that
    is asked for; None if there is no difference, or nothing to tell it from."""
    detectable: float | None
    """The difference that would have been found with that power, about: by a t-test."""

    @property
    def is_separated(self) -> bool:
        """Whether p is below ALPHA."""
        return self.p is not None and self.p < ALPHA


def compare_policies(pairs: Pairs, power: float) -> Difference:
    """These very policies, on configurations like these.

    p is that of the exact sign-flip test over the configurations (McNemar's where each has one episode). The
    interval of a difference of two policies' success rates is `newcombe_paired_interval`, of `effective_pairs`;
    any other is Student's, over the configurations.
    """
    value, k = float(pairs.differences.mean()), int(pairs.clusters.max()) + 1
    spread = sqrt(k * cluster_variance(pairs.differences, pairs.clusters)) if k > 1 else 0.0
    if pairs.is_binary:
        interval, name = _newcombe(pairs), f"Newcombe's paired interval by {pairs.unit}"
    else:
        half = float(student_t.ppf(1 - ALPHA / 2, k - 1)) * spread / sqrt(k) if k > 1 else 0.0
        interval = (value - half, value + half) if half else None
        name = f"t-interval by {pairs.unit}"
    needed = samples_needed(spread, value, power, lambda n: n - 1)
    return Difference(
        value,
        interval,
        sign_flip_p(pairs.whole_differences),
        f"{name}, exact sign-flip p over {k} {pairs.units}",
        None if needed is None else max(needed, FEWEST),
        detectable(spread, k, power, k - 1) if k >= FEWEST else None,
    )


def compare_trainings(pairs: Pairs, power: float) -> Difference | None:
    """Trainings like these, on configurations like these; None if neither side has two.

    The variance is that of two crossed factors, training and configuration, both drawn at random (Searle, Casella
    and McCulloch 1992, "Variance Components", chapter 4): that between the trainings of each side, plus that
    between the configurations, less the interaction, which both of them have in them. A side of one policy, and
    what trainings have in common, such as the base that they begin with, is taken as it is: where the trainings
    are of several bases, it does not count how those differ. The t-interval has Satterthwaite's degrees of
    freedom, or where FEW trainings stand against another number Cochran's quantile, and is no narrower than that
    of the configurations alone where trainings differ less than chance has it.
    """
    sides = [side for side in (pairs.a, pairs.b) if len(side) > 1]
    if not sides:
        return None
    k = int(pairs.clusters.max()) + 1
    value = float(pairs.differences.mean())
    of_side = [float(side.mean(axis=1).var(ddof=1)) / len(side) for side in sides]
    trainings = sum(of_side)
    both = sum(_interaction(side, pairs.clusters) for side in sides) if k > 1 else 0.0
    configurations = cluster_variance(pairs.differences, pairs.clusters) if k > 1 else 0.0
    more = max(0.0, configurations - both)
    variance = trainings + more
    spread = sqrt(sum(v * len(side) for v, side in zip(of_side, sides, strict=True)))
    counts = f"{len(pairs.a)} against {len(pairs.b)} trainings"
    method = f"t-interval and p by training and {pairs.unit} ({counts}, {k} {pairs.units})"
    per_side = len(sides)
    needed = samples_needed(spread, value, power, lambda n: per_side * (n - 1))
    parts = [(v, len(side) - 1) for v, side in zip(of_side, sides, strict=True)] + [(more, k - 1)] * (more > 0)
    estimates = [parts] if variance else []
    # A variance between trainings that is estimated below 0 is none: no surer than of these policies alone.
    if configurations and trainings < both * (1 - 1e-9):
        estimates.append([(configurations, k - 1)])
    if not estimates:
        if value:
            method += ": nothing varies, so p is of these policies"
        return Difference(value, None, sign_flip_p(pairs.whole_differences) if value else None, method, None, None)
    are_few = len(pairs.a) != len(pairs.b) and min(map(len, sides)) == FEW
    method += " with Cochran's quantile" * are_few
    tests = [_t_test(value, StudentSum(one, are_few), power) for one in estimates]
    half, p, found = map(max, zip(*tests, strict=True))
    return Difference(value, (value - half, value + half), p, method, needed, found)


class StudentSum:
    """About how an estimate is distributed whose variance is a sum of independent ones.

    Args:
        parts: variance, above 0 in all, and degrees of freedom of each.
        is_weighted: with the mean of Student's quantiles, weighted by the variances (Cochran 1964, "Approximate
            significance levels of the Behrens-Fisher test"), which is never too sure; else with Satterthwaite's
            degrees of freedom, which takes a part of one degree of freedom that is small by chance for sure.
    """

    def __init__(self, parts: Sequence[tuple[float, int]], is_weighted: bool) -> None:
        variance = sum(v for v, _ in parts)
        self.error = sqrt(variance)
        self._weights, self._dfs = np.array(parts, float).T
        if not is_weighted:
            satterthwaite = variance**2 / sum(v * v / df for v, df in parts)
            self._weights, self._dfs = np.ones(1), np.array([satterthwaite])

    def quantile(self, tail: float) -> float:
        """The deviation, in its standard errors, beyond which this much of it lies on one side."""
        if len(self._dfs) == 1:
            return float(student_t.ppf(1 - tail, self._dfs[0]))
        return float(np.average(student_t.isf(tail, self._dfs), weights=self._weights))

    def p(self, deviation: float) -> float:
        """Two-sided, of a deviation in standard errors."""
        tails = student_t.sf(abs(deviation), self._dfs)
        if len(tails) == 1:
            return 2 * float(tails[0])
        # Between that of the part with the fewest and that of the one with the most degrees of freedom; rounded.
        low, high = max(float(tails.min()) * 0.999, LEAST), max(float(tails.max()) * 1.001, 2 * LEAST)
        return 2 * float(brentq(lambda tail: self.quantile(tail) - abs(deviation), low, high, xtol=LEAST))


def _t_test(value: float, estimate: StudentSum, power: float) -> tuple[float, float, float]:
    """Half of the interval around a difference, p, and the difference that is found with that power."""
    quantile = estimate.quantile(ALPHA / 2)
    found = (quantile + estimate.quantile(1 - power)) * estimate.error
    return quantile * estimate.error, estimate.p(value / estimate.error), found


def cluster_variance(values: np.ndarray, clusters: np.ndarray) -> float:
    """Variance of the mean of values that go together by cluster, of which there are at least two."""
    k = int(clusters.max()) + 1
    sums = np.bincount(clusters, weights=values - values.mean(), minlength=k)
    return float(np.sum(sums**2)) * k / (k - 1) / len(values) ** 2


def _interaction(side: np.ndarray, clusters: np.ndarray) -> float:
    """The part of the variance of a side's mean that is of neither its trainings nor its configurations alone.

    What is the same in all trainings, such as the noise of one base that each is compared with, is not in it.
    """
    n, k = len(side), int(clusters.max()) + 1
    sums = np.stack([np.bincount(clusters, weights=row) for row in side - side.mean()])
    rest = sums - sums.mean(axis=0) - sums.mean(axis=1, keepdims=True) + sums.mean()
    return float(np.sum(rest**2)) * n * k / ((n - 1) * (k - 1)) / side.size**2


def effective_pairs(differences: np.ndarray, clusters: np.ndarray) -> float:
    """How many independent pairs would say as much as these, of which those of one cluster go together.

    As `evaluation.rates.effective_trials`, of differences: n over the design effect, at least 1, with Student's
    quantile; where no pair differs, as if clusters went together completely.
    """
    n, k = len(differences), int(clusters.max()) + 1
    variance = float(differences.var())
    if k in (1, n) or variance == 0:
        return float(k)
    design_effect = max(1.0, cluster_variance(differences, clusters) / (variance / n))
    return n / design_effect * (Z_95 / float(student_t.ppf(0.975, k - 1))) ** 2


def _newcombe(pairs: Pairs) -> tuple[float, float]:
    a, b = pairs.a[0].astype(bool), pairs.b[0].astype(bool)
    counts = np.array([(b & a).sum(), (b & ~a).sum(), (~b & a).sum(), (~b & ~a).sum()])
    n = effective_pairs(pairs.differences, pairs.clusters)
    return newcombe_paired_interval(*(counts / len(a) * n).tolist())


def newcombe_paired_interval(both: float, first: float, second: float, neither: float) -> tuple[float, float]:
    """95 % interval of the difference of two success rates on the same pairs, first minus second.

    Newcombe 1998, "Improved confidence intervals for the difference between binomial proportions based on paired
    data", method 10: the Wilson intervals of the two rates, put together with the correlation of the pairs,
    continuity corrected.

    Args:
        both: pairs in which both succeed; not necessarily a whole number, as the others.
        first: only the first.
        second: only the second.
        neither: none of them.
    """
    n = both + first + second + neither
    p1, p2 = (both + first) / n, (both + second) / n
    (low1, high1), (low2, high2) = (wilson_interval(min(n, p * n), n) for p in (p1, p2))
    margins = (both + first) * (second + neither) * (both + second) * (first + neither)
    product = both * neither - first * second
    if product > 0:
        product = max(0.0, product - n / 2)
    phi = product / sqrt(margins) if margins > 0 else 0.0

    def distance(of_first: float, of_second: float) -> float:
        return sqrt(max(0.0, of_first**2 - 2 * phi * of_first * of_second + of_second**2))

    difference = p1 - p2
    return difference - distance(p1 - low1, high2 - p2), difference + distance(high1 - p1, p2 - low2)


def samples_needed(spread: float, difference: float, power: float, df: Callable[[int], int]) -> int | None:
    """Samples for which a t-test at ALPHA finds a difference with a power, about.

    The smallest n with (t_(1 - alpha/2) + t_power) spread / sqrt(n) <= |difference|.

    Args:
        spread: standard deviation of a sample.
        difference: between the means.
        power: 0.5 to 1.
        df: the test's degrees of freedom of n samples.

    Returns:
        None if there is no difference, no spread, or if it is more than MOST.
    """
    if not spread or not difference:
        return None

    def is_enough(n: int) -> bool:
        found = detectable(spread, n, power, df(n))
        return found is not None and found <= abs(difference)

    low, high = 1, 2
    while not is_enough(high):
        low, high = high, 2 * high
        if high > MOST:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high


def detectable(spread: float, n: int, power: float, df: int) -> float | None:
    """The difference that a t-test of n samples at ALPHA finds with a power, about; None if they do not vary."""
    if df < 1 or not spread:
        return None
    quantiles = float(student_t.ppf(1 - ALPHA / 2, df)) + float(student_t.ppf(power, df))
    return quantiles * spread / sqrt(n)


def holm(ps: list[float]) -> list[float]:
    """p-values of several tests, adjusted so that the chance of any false decision stays in bounds (Holm 1979)."""
    adjusted, largest = [0.0] * len(ps), 0.0
    for rank, i in enumerate(np.argsort(ps)):
        largest = max(largest, min(1.0, (len(ps) - rank) * ps[i]))
        adjusted[i] = largest
    return adjusted
