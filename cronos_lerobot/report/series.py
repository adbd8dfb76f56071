"""Curves over a run: one point per evaluation or update, and their mean over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cronos_lerobot.protocol.metrics import interpolate
from cronos_lerobot.report.runs import Group, TrainingRun
from cronos_lerobot.report.statistics import Rate, SeedRate

Record = dict[str, Any]
LAST_PART = 0.25
"""Share of a run, at its end, that stands for what it has come to."""
LONGEST_CYCLE = 1 / 3
"""Share of a run that a whole cycle between two scene resets may be, to stand for its end."""


@dataclass(frozen=True)
class Curve:
    """A line with a band around it, all (points,)."""

    x: np.ndarray
    y: np.ndarray
    low: np.ndarray
    high: np.ndarray
    is_band_over_seeds: bool
    """Whether the band is the standard deviation over seeds, or the 95 % interval of a single run."""


def evaluation_curve(group: Group, axis: str) -> Curve | None:
    """Success of the periodic evaluations against `axis`, `interaction_steps` or `interventions`.

    Of each run those made as its last one.
    """
    runs = [run.alike for run in group.runs if run.evaluations]
    curves = [([e[axis] for e in run], [e["success"] for e in run]) for run in runs]
    if len(runs) == 1:
        x, y = curves[0]
        ends = np.array([e["ci95"] for e in runs[0]])
        return Curve(np.array(x), np.array(y), ends[:, 0], ends[:, 1], is_band_over_seeds=False)
    return mean_curve(curves) if curves else None


def update_curve(group: Group, value: Callable[[Record], float | None]) -> Curve | None:
    """A number of every update against interaction steps; updates without one are left out."""
    curves = []
    for run in group.runs:
        points = [(u["interaction_steps"], v) for u in run.updates if (v := value(u)) is not None]
        if points:
            x, y = zip(*points, strict=True)
            curves.append((x, y))
    return mean_curve(curves) if curves else None


def mean_curve(curves: list[tuple[Any, Any]]) -> Curve:
    """Mean and standard deviation of (x, y) curves over the range of x that all of them have.

    Where a curve is evaluated more than once at one x, as between two interventions, the mean goes from the first
    of them straight to the last, as the areas of `performance_gap` have it.
    """
    xs = [np.asarray(x, float) for x, _ in curves]
    ys = [np.asarray(y, float) for _, y in curves]
    low, high = max(x.min() for x in xs), min(x.max() for x in xs)
    places: Any = np.unique(np.concatenate(xs))
    places = places[(places >= low) & (places <= high)]
    is_twice = np.isin(places, np.concatenate([x[1:][x[1:] == x[:-1]] for x in xs]))
    grid = np.repeat(places, 1 + is_twice)
    is_first = np.append(grid[1:] == grid[:-1], False)
    values = np.stack(
        [
            np.where(is_first, interpolate(x, y, grid, is_first=True), interpolate(x, y, grid))
            for x, y in zip(xs, ys, strict=True)
        ]
    )
    mean = values.mean(0)
    spread = values.std(0, ddof=1) if len(values) > 1 else np.zeros(len(grid))
    return Curve(grid, mean, mean - spread, mean + spread, is_band_over_seeds=len(values) > 1)


def segment_rates(group: Group, last_part: float = LAST_PART) -> dict[int, SeedRate]:
    """Success by number of task switches since the scene reset, in the last part of the runs of a group.

    Of one run the segments count as independent episodes.
    """
    runs: list[dict[int, Rate]] = []
    for run in group.runs:
        runs.append(rates := {})
        for update in _last_updates(run, last_part):
            for position, (successes, n) in update["rollout"]["success_by_segment"].items():
                rates[int(position)] = rates.get(int(position), Rate(0, 0)) + Rate(successes, n)
    return _of_seeds(runs)


def _of_seeds(runs: Sequence[dict[Any, Rate]]) -> dict[Any, SeedRate]:
    """The rates of several runs, key by key; a run without a key has no episode of it."""
    keys = sorted({key for rates in runs for key in rates})
    return {key: SeedRate.of(rates.get(key, Rate(0, 0)) for rates in runs) for key in keys}


SINGLE = 16
"""Segments since a scene reset that are shown one by one: all that T = 1280 has."""


def segment_spans(rates: Mapping[int, Rate]) -> dict[tuple[int, int], Rate]:
    """The rates of `segment_rates` as they are read: by (first, last) segment, counted from 1.

    Few streams come to the hundredth segment at the same time, and nobody reads a hundred columns: from the 17th
    on they are taken together in spans that double, 17 to 32, 33 to 64 and so on.
    """
    spans: dict[tuple[int, int], Rate] = {}
    for position, rate in rates.items():
        number = position + 1
        first = number if number <= SINGLE else 2 ** ((number - 1).bit_length() - 1) + 1
        span = (first, number if number <= SINGLE else 2 * (first - 1))
        spans[span] = spans[span] + rate if span in spans else rate
    return spans


def task_rates(group: Group, parts: int = 4) -> dict[tuple[int, str], SeedRate]:
    """Success while training by part of the run (0 is the first) and instruction, learned resets' among them.

    Of one run the segments count as independent episodes.
    """
    runs: list[dict[tuple[int, str], Rate]] = []
    for run in group.runs:
        runs.append(rates := {})
        for i, update in enumerate(run.updates):
            for instruction, (successes, n) in update["rollout"]["success_by_task"].items():
                key = (i * parts // len(run.updates), instruction)
                rates[key] = rates.get(key, Rate(0, 0)) + Rate(successes, n)
    return _of_seeds(runs)


def _last_updates(run: TrainingRun, last_part: float) -> list[Record]:
    """The last part of a run, or a whole cycle between two scene resets where that is a little longer.

    A whole cycle has every segment, and one that is the larger part of a run would not be of its end.
    """
    if not run.updates:
        return []
    end = run.updates[-1]["interaction_steps"]
    protocol = run.config.get("protocol", {})
    cycle = (protocol.get("scene_reset_interval") or 0) * run.config.get("num_envs", 0)
    start = min(end * (1 - last_part), end - cycle if cycle <= end * LONGEST_CYCLE else end)
    return [update for update in run.updates if update["interaction_steps"] > start]


def segment_history(group: Group, max_columns: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Success by segment over the run.

    Returns:
        edges (columns + 1,) in interaction steps, and rates (segments, columns), NaN where there is no episode.
    """
    updates = [update for run in group.runs for update in run.updates]
    end = max(update["interaction_steps"] for update in updates)
    protocol = group.runs[0].config.get("protocol", {})
    cycle = (protocol.get("scene_reset_interval") or 0) * group.runs[0].config.get("num_envs", 0)
    columns = max(1, min(max_columns, end // cycle if cycle else max_columns))
    num_segments = 1 + max(int(p) for u in updates for p in u["rollout"]["success_by_segment"])
    counts = np.zeros((2, num_segments, columns))
    for update in updates:
        column = min(columns - 1, int((update["interaction_steps"] - 1) * columns / end))
        for position, (successes, n) in update["rollout"]["success_by_segment"].items():
            counts[:, int(position), column] += successes, n
    with np.errstate(invalid="ignore"):
        return np.linspace(0, end, columns + 1), counts[0] / counts[1]
