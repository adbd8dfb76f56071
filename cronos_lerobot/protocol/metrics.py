"""How efficient a run was, and what several seeds came to (paper, Equations 3 and 4).

A curve is the success of the evaluations of one run, `y`, against interaction steps or interventions, `x`: both
(points,), `x` never falling. Several evaluations at one `x`, which happens on the axis of interventions whenever
nothing was reset between two evaluations, are a vertical part of the curve: it adds nothing to an area, the part
before it ends at the first of them, the part after it begins at the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan, sqrt
from typing import Any

import numpy as np
from scipy.stats import t as student_t

Numbers = Sequence[float] | np.ndarray

OPTIMUM = 1.0
"""J of the optimal policy: it always succeeds."""


@dataclass(frozen=True)
class Gap:
    """The area between a curve and the optimum."""

    area: float
    """D where `x` is interaction steps, C where it is interventions; in units of `x`. Smaller is better."""
    length: float
    """Of the axis: last `x` minus first."""

    @property
    def normalised(self) -> float:
        """The mean gap, 0 to 1: the area divided by the axis' length, NaN on an axis without length."""
        return self.area / self.length if self.length > 0 else nan


def performance_gap(x: Numbers, y: Numbers, up_to: float | None = None) -> Gap:
    """D or C (Equations 3 and 4), by the trapezoid rule, from the first evaluation on.

    Runs of `cronos-train` are evaluated before their first step, at 0 on both axes.

    Args:
        x: interaction steps or interventions at each evaluation.
        y: success at each evaluation, 0 to 1.
        up_to: end of the axis; the last evaluation if None. Runs compare if they share it. The gap is NaN if the
            curve does not reach it.

    Raises:
        ValueError: there is no point, or `x` falls.
    """
    xs, ys = _curve(x, y)
    if up_to is not None:
        end = success_at(xs, ys, up_to)
        if not isfinite(end):
            return Gap(nan, nan)
        # At the end itself, the first evaluation there closes the area.
        inside = xs < up_to
        at_end = ys[xs == up_to]
        xs = np.append(xs[inside], up_to)
        ys = np.append(ys[inside], at_end[0] if len(at_end) else end)
    return Gap(float(np.trapezoid(OPTIMUM - ys, xs)), float(xs[-1] - xs[0]))


def success_at(x: Numbers, y: Numbers, at: float) -> float:
    """Success at `at` by linear interpolation; NaN where the run has not been. Of several evaluations the last.

    Raises:
        ValueError: there is no point, or `x` falls.
    """
    return float(interpolate(x, y, [at])[0])


def interpolate(x: Numbers, y: Numbers, at: Numbers, *, is_first: bool = False) -> np.ndarray:
    """`success_at` for several places: (len(at),), NaN beyond the curve's ends.

    Args:
        x: interaction steps or interventions at each evaluation.
        y: success at each evaluation.
        at: the places.
        is_first: of several evaluations at a place take the first one, in place of the last.

    Raises:
        ValueError: there is no point, or `x` falls.
    """
    xs, ys = _curve(x, y)
    last = np.append(xs[1:] != xs[:-1], True)
    first = np.append(True, xs[1:] != xs[:-1])
    unique, values_before, values_after = xs[last], ys[first], ys[last]
    places = np.asarray(at, float)
    result = np.full(len(places), nan)
    inside = (places >= unique[0]) & (places <= unique[-1])
    left = np.searchsorted(unique, places[inside], side="right") - 1
    right = np.minimum(left + 1, len(unique) - 1)
    width = np.where(right > left, unique[right] - unique[left], 1.0)
    share = (places[inside] - unique[left]) / width
    result[inside] = values_after[left] + share * (values_before[right] - values_after[left]) * (right > left)
    if is_first:
        exact = np.flatnonzero(inside)[places[inside] == unique[left]]
        result[exact] = values_before[np.searchsorted(unique, places[exact])]
    return result


def _curve(x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    if len(xs) == 0 or xs.shape != ys.shape:
        raise ValueError(f"a curve needs as many x as y, at least one, got {xs.shape} and {ys.shape}")
    if np.any(np.diff(xs) < 0):
        raise ValueError("x must not fall along a curve")
    return xs, ys


@dataclass(frozen=True)
class Summary:
    """A number of each seed, aggregated."""

    mean: float
    std: float | None
    """Sample standard deviation (ddof = 1); None for one seed."""
    ci95: tuple[float, float] | None
    """95 % t-interval of the mean over the seeds; None for one seed."""
    n: int
    """Seeds."""

    @property
    def varied_ci95(self) -> tuple[float, float] | None:
        """`ci95` of numbers that vary: that a few trainings came to the same success does not say that all do."""
        return self.ci95 if self.std else None

    def within(self, low: float, high: float) -> Summary:
        """The same with an interval that ends where the number does: that of two or three seeds can be wider."""
        if self.ci95 is None:
            return self
        return replace(self, ci95=(max(self.ci95[0], low), min(self.ci95[1], high)))

    def __str__(self) -> str:
        return f"{self.mean:.3f}" if self.std is None else f"{self.mean:.3f} ± {self.std:.3f}"


def summarise_rates(values: Numbers) -> Summary | None:
    """As `summarise`, of numbers between 0 and 1, where the interval ends, too; none where all are alike."""
    summary = summarise(values)
    return summary and replace(summary, ci95=summary.varied_ci95).within(0.0, 1.0)


def summarise(values: Numbers) -> Summary | None:
    """Mean, standard deviation and t-interval over the seeds; None if a value is missing or none is there.

    The interval is Student's, mean +- t std / sqrt(n) with n - 1 degrees of freedom. With the three to five seeds
    of an experiment it covers what it says, where resampling three seeds covers .73 and five .84.

    Args:
        values: one for each seed; NaN is a missing value.
    """
    numbers = np.asarray(values, float)
    if len(numbers) == 0 or not np.isfinite(numbers).all():
        return None
    mean = float(numbers.mean())
    if len(numbers) == 1:
        return Summary(mean, None, None, 1)
    std = float(numbers.std(ddof=1))
    half = float(student_t.ppf(0.975, len(numbers) - 1)) * std / sqrt(len(numbers))
    return Summary(mean, std, (mean - half, mean + half), len(numbers))
