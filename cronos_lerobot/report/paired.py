"""The difference of two policies, or of two ways to train them, on the same episodes.

Outcomes of the same episode are correlated, so the difference of each pair says more than the two rates alone.
Episodes from one configuration are correlated too, so errors are clustered by configuration (Miller 2024, "Adding
error bars to evals", arXiv:2411.00640).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

from cronos_lerobot.statistics import (
    FEWEST_SEEDS,
    cluster_variance,
    effective_trials,
    sign_flip_p,
    wilson_interval,
)

ALPHA = 0.05
"""Level of intervals and decisions."""
POWER = 0.8
"""With which `Difference.detectable` would be found."""
KEYS = ["number", "configuration", "seed"]
"""What identifies an episode of a suite and split: task or ordering, configuration, seed of the sampling."""


@dataclass(frozen=True)
class Pairs:
    """What the policies of two sides did on the same episodes: successes, or lengths of chains."""

    a: np.ndarray
    """(policies of A, episodes) int."""
    b: np.ndarray
    """(policies of B, episodes) int."""
    clusters: np.ndarray
    """(episodes,) int, from 0: episodes of one cluster are correlated."""
    unit: str = "configuration"
    """What a cluster is."""
    are_chains: bool = False
    """Whether these are lengths of chains, even if all of them are 0 or 1."""

    @property
    def differences(self) -> np.ndarray:
        """(episodes,) mean of B's policies minus that of A's."""
        return self.b.mean(axis=0) - self.a.mean(axis=0)

    @property
    def k(self) -> int:
        """Clusters."""
        return int(self.clusters.max()) + 1

    def p(self) -> float:
        """Exact sign-flip p-value of these policies, over the clusters."""
        whole = self.b.sum(axis=0) * len(self.a) - self.a.sum(axis=0) * len(self.b)
        return sign_flip_p(np.bincount(self.clusters, weights=whole).round().astype(int))

    def part(self, mask: np.ndarray) -> Pairs:
        """The pairs of some episodes; `mask` is (episodes,) bool."""
        clusters = np.unique(self.clusters[mask], return_inverse=True)[1]
        return Pairs(self.a[:, mask], self.b[:, mask], clusters, self.unit, self.are_chains)

    def reached(self, position: int) -> Pairs:
        """Whether chains came beyond a position, as successes."""
        a, b = ((lengths > position).astype(int) for lengths in (self.a, self.b))
        return Pairs(a, b, self.clusters, self.unit)

    def gains(self) -> Pairs:
        """The gain of each policy of B over the policy of A with its number, against 0."""
        return Pairs(np.zeros_like(self.a[:1]), self.b - self.a, self.clusters, self.unit, are_chains=True)


def pair(
    a: Sequence[np.ndarray], b: Sequence[np.ndarray], *, are_chains: bool = False
) -> tuple[Pairs, np.ndarray]:
    """Pair the episodes that all policies of both sides have, sorted.

    Episodes from one configuration are one cluster. If there is only one configuration, each repetition is one.

    Args:
        a: for each policy of A, its episodes (n, 4) int: seed, number, configuration, length.
        b: the same of B.
        are_chains: see `Pairs`.

    Returns:
        the pairs, and the `number` of each (task or ordering), (episodes,).

    Raises:
        ValueError: there is no shared episode, or a policy has two outcomes of one.
    """
    frames = [pd.DataFrame(one, columns=["seed", "number", "configuration", "length"]) for one in (*a, *b)]
    columns = [frame.set_index(KEYS)["length"] for frame in frames]
    if any(column.index.has_duplicates for column in columns):
        raise ValueError("a policy has two evaluations of the same episodes: name the folder of one")
    table = pd.concat(columns, axis=1, join="inner").sort_index()
    if table.empty:
        raise ValueError("no episode (task or ordering, configuration, sampling seed) was run by all policies")
    keys, lengths = table.index.to_frame(index=False), table.to_numpy().T
    is_one = keys["configuration"].nunique() == 1
    clusters = np.unique(keys["seed" if is_one else "configuration"], return_inverse=True)[1]
    unit = "repetition" if is_one else "configuration"
    return Pairs(lengths[: len(a)], lengths[len(a) :], clusters, unit, are_chains), keys["number"].to_numpy()


@dataclass(frozen=True)
class Difference:
    """B minus A."""

    value: float
    ci95: tuple[float, float] | None
    """None if the outcomes do not show how much they vary."""
    p: float
    """Two-sided, of no difference."""
    method: str
    """Of the interval and of p."""
    detectable: float | None = None
    """The difference that a t-test would find with `POWER`, about; None if outcomes do not vary."""


def compare_policies(pairs: Pairs) -> Difference:
    """The difference of these very policies, on configurations like these.

    p is that of the exact sign-flip test over the clusters: McNemar's if each has one episode. The interval of two
    policies' success rates is Newcombe's, with `effective_trials`. Any other interval is Student's over clusters.
    """
    value, k = float(pairs.differences.mean()), pairs.k
    error = sqrt(cluster_variance(pairs.differences, pairs.clusters)) if k > 1 else 0.0
    if len(pairs.a) == len(pairs.b) == 1 and not pairs.are_chains:
        interval, name = _newcombe(pairs), "Newcombe's paired interval"
    else:
        half = float(student_t.ppf(1 - ALPHA / 2, k - 1)) * error if error else 0.0
        interval, name = ((value - half, value + half) if half else None), "t-interval"
    method = f"{name} by {pairs.unit}, exact sign-flip p over {k} {pairs.unit}s"
    return Difference(value, interval, pairs.p(), method, _detectable(error, k - 1) if error else None)


def compare_trainings(pairs: Pairs) -> Difference | None:
    """The difference of trainings like these, on configurations like these.

    The variance has two crossed random factors, training and configuration (Searle, Casella and McCulloch 1992,
    "Variance Components", chapter 4): that between the trainings of each side, plus that between configurations,
    less the interaction, which both contain. A side of one policy is taken as it is, and so is what all trainings
    share, such as their base. The t-interval has Satterthwaite's degrees of freedom. If trainings vary less than
    chance, it is at least as wide as that of the configurations alone.

    Returns:
        None if no side has several policies, or one has fewer than `FEWEST_SEEDS`.
    """
    sides = [side for side in (pairs.a, pairs.b) if len(side) > 1]
    if not sides or min(map(len, sides)) < FEWEST_SEEDS:
        return None
    value = float(pairs.differences.mean())
    of_side = [float(side.mean(axis=1).var(ddof=1)) / len(side) for side in sides]
    both = sum(_interaction(side, pairs.clusters) for side in sides) if pairs.k > 1 else 0.0
    configurations = cluster_variance(pairs.differences, pairs.clusters) if pairs.k > 1 else 0.0
    more = max(0.0, configurations - both)
    parts = [*zip(of_side, [len(side) - 1 for side in sides], strict=True), (more, pairs.k - 1)]
    estimates = [_satterthwaite([part for part in parts if part[0] > 0])] if sum(of_side) + more else []
    # A variance between trainings that is estimated below 0 is none: no surer than of these policies alone.
    if configurations and sum(of_side) < both * (1 - 1e-9):
        estimates.append((sqrt(configurations), pairs.k - 1))
    method = f"t-interval and p by training and {pairs.unit} ({len(pairs.a)} against {len(pairs.b)} trainings)"
    if not estimates:
        return Difference(value, None, pairs.p(), f"{method}: nothing varies, so p is of these policies")
    half = max(float(student_t.ppf(1 - ALPHA / 2, df)) * error for error, df in estimates)
    p = max(2 * float(student_t.sf(abs(value) / error, df)) for error, df in estimates)
    return Difference(value, (value - half, value + half), p, method, max(_detectable(*one) for one in estimates))


def _satterthwaite(parts: Sequence[tuple[float, int]]) -> tuple[float, float]:
    """Standard error and degrees of freedom of a sum of independent variances with theirs."""
    variance = sum(v for v, _ in parts)
    return sqrt(variance), variance**2 / sum(v * v / df for v, df in parts)


def _detectable(error: float, df: float) -> float:
    return float(student_t.ppf(1 - ALPHA / 2, df) + student_t.ppf(POWER, df)) * error


def _interaction(side: np.ndarray, clusters: np.ndarray) -> float:
    """The part of the variance of a side's mean that is neither of its trainings nor of its clusters alone."""
    n, k = len(side), int(clusters.max()) + 1
    sums = np.stack([np.bincount(clusters, weights=row) for row in side - side.mean()])
    rest = sums - sums.mean(axis=0) - sums.mean(axis=1, keepdims=True) + sums.mean()
    return float(np.sum(rest**2)) * n * k / ((n - 1) * (k - 1)) / side.size**2


def _newcombe(pairs: Pairs) -> tuple[float, float]:
    a, b = pairs.a[0].astype(bool), pairs.b[0].astype(bool)
    counts = np.array([(b & a).sum(), (b & ~a).sum(), (~b & a).sum(), (~b & ~a).sum()])
    n = effective_trials(pairs.differences, pairs.clusters)
    return newcombe_paired_interval(*(counts / len(a) * n).tolist())


def newcombe_paired_interval(both: float, first: float, second: float, neither: float) -> tuple[float, float]:
    """95 % interval of the difference of two success rates on the same pairs, first minus second.

    Newcombe 1998, "Improved confidence intervals for the difference between binomial proportions based on paired
    data", method 10: the Wilson intervals of the two rates, joined by the correlation of the pairs.

    Args:
        both: pairs in which both succeed; an effective number, not necessarily whole, like the others.
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


def holm(ps: Sequence[float]) -> list[float]:
    """p-values of several tests, adjusted so that the chance of any false decision stays in bounds (Holm 1979)."""
    order = np.argsort(ps)
    adjusted = np.empty(len(ps))
    steps = np.arange(len(ps), 0, -1) * np.asarray(ps, float)[order]
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(steps))
    return adjusted.tolist()
