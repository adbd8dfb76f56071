"""The tables of a report, from the tables that `load` reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from cronos_lerobot.report.load import APART, TRAIN
from cronos_lerobot.report.paired import Pairs, compare_policies, compare_trainings, pair
from cronos_lerobot.statistics import (
    Summary,
    cluster_interval,
    performance_gap,
    success_at,
    summarise,
    wilson_interval,
)

ALL = "all tasks"
Cells = dict[str, Any]


def seed_table(evaluations: pd.DataFrame) -> pd.DataFrame:
    """Success, interventions, D and C of each row, over its seeds, at the last step that all of them have reached.

    D and C are divided by the length of their axes. They are NaN if a curve does not begin at step 0.
    """
    rows = []
    for label, curves in training_curves(evaluations).items():
        curves = [curve for curve in curves if len(curve) > 1]
        if not curves:
            continue
        end = min(curve["steps"].iloc[-1] for curve in curves)
        spent = [success_at(curve["steps"], curve["interventions"], end) for curve in curves]
        gaps = [_gaps(curve, end, spent_here) for curve, spent_here in zip(curves, spent, strict=True)]
        last = curves[0].iloc[-1]
        row: Cells = {
            "runs": label,
            "seeds": len(curves),
            "split": last["split"],
            "n": last["n"],
            "steps": int(end),
        }
        row |= cells_of("success", summarise([success_at(c["steps"], c["success"], end) for c in curves], (0, 1)))
        row |= cells_of("interventions", summarise(spent))
        row |= cells_of("D / steps", summarise([d for d, _ in gaps], (0, 1)))
        rows.append(row | cells_of("C / interventions", summarise([c for _, c in gaps], (0, 1))))
    return pd.DataFrame(rows)


def training_curves(evaluations: pd.DataFrame) -> dict[str, list[pd.DataFrame]]:
    """The evaluations of each run, by row."""
    own = evaluations[evaluations["source"] == TRAIN]
    return {
        str(label): [curve for _, curve in some.groupby("folder", sort=False)]
        for label, some in own.groupby("row", sort=False)
    }


def is_at_end(last: pd.DataFrame) -> pd.Series:
    """Which runs of a row have come as far as the others, by their last evaluations, or spent their budget."""
    return (last["steps"] == last["steps"].max()) | last["is_budget_spent"].astype(bool)


def _gaps(curve: pd.DataFrame, end: float, spent: float) -> tuple[float, float]:
    """D and C of a curve, divided by their axes."""
    if curve["steps"].iloc[0]:
        return np.nan, np.nan
    axes = ((curve["steps"], end), (curve["interventions"], spent))
    by_steps, by_resets = (performance_gap(x, curve["success"], up_to) for x, up_to in axes)
    return by_steps, by_resets


def cells_of(name: str, summary: Summary) -> Cells:
    """The cells of a summary: mean, standard deviation and ends of the interval."""
    low, high = summary.ci95 or (None, None)
    return {name: summary.mean, f"{name} std": summary.std, f"{name} ci95_low": low, f"{name} ci95_high": high}


def gain_table(evaluations: pd.DataFrame, before: pd.DataFrame, after: pd.DataFrame) -> pd.DataFrame:
    """Success before and after, and the gain, of all tasks and of each.

    Args:
        evaluations: the first and last ones of each training are compared, if it came as far as the others.
        before: evaluations of the policy that a training began with, compared by suite and split.
        after: the same of the policies that came out.
    """
    rows = []
    for key, new in after.groupby(["suite", "split"], sort=False):
        old = before[(before["suite"] == key[0]) & (before["split"] == key[1])]
        if len(old):
            rows += _gain_rows("--after", "_".join(key), old, new)
    for label, curves in training_curves(evaluations).items():
        ended = is_at_end(pd.concat([curve.tail(1) for curve in curves]))
        whole = [c for c, there in zip(curves, ended, strict=True) if there and len(c) > 1]
        whole = [curve for curve in whole if curve["steps"].iloc[0] == 0]
        if whole:
            old, new = (pd.concat([curve.iloc[[place]] for curve in whole]) for place in (0, -1))
            rows += _gain_rows(label, f"periodic evaluation, {new['split'].iloc[0]}", old, new)
    return pd.DataFrame(rows)


def _gain_rows(runs: str, suite: str, old: pd.DataFrame, new: pd.DataFrame) -> Iterator[Cells]:
    are_chains = new["suite"].iloc[0] != "independent"
    try:
        pairs, numbers = pair(list(old["episodes"]), list(new["episodes"]), are_chains=are_chains)
    except ValueError:
        # Of other episodes: there is nothing to compare.
        return
    names = [part["part"] for part in new["parts"].iloc[0]]
    tasks = {} if are_chains else {name: numbers == i for i, name in enumerate(names)}
    for task, mask in ({ALL: np.full(len(numbers), True)} | tasks).items():
        if mask.any():
            yield {"runs": runs, "suite": suite, "task": task} | _gain_cells(pairs.part(mask))


def _gain_cells(pairs: Pairs) -> Cells:
    seeds = len(pairs.b)
    is_each_own = len(pairs.a) == seeds > 1
    found = compare_trainings(pairs.gains() if is_each_own else pairs) if seeds > 1 else compare_policies(pairs)
    low, high = (found.ci95 if found else None) or (None, None)
    cells = {"n": pairs.b.shape[1], "seeds": seeds}
    for name, lengths in (("before", pairs.a), ("after", pairs.b)):
        ends = _interval(lengths, pairs)
        cells |= {name: float(lengths.mean()), f"{name} ci95_low": ends[0], f"{name} ci95_high": ends[1]}
    cells |= {"gain": float(pairs.differences.mean()), "gain ci95_low": low, "gain ci95_high": high}
    return cells | {"p": found.p if found else None}


def _interval(lengths: np.ndarray, pairs: Pairs) -> tuple[float | None, float | None]:
    """Of one policy by configuration, of several over the trainings."""
    if len(lengths) == 1 and not pairs.are_chains:
        return cluster_interval(lengths[0] > 0, pairs.clusters)
    return summarise(lengths.mean(axis=1)).ci95 or (None, None)


def part_table(evaluations: pd.DataFrame, columns: Sequence[str], *, with_all: bool = True) -> pd.DataFrame:
    """Success of all tasks together and of each task, position or segment, one row for each.

    Args:
        evaluations: any of them.
        columns: of theirs, repeated in each row.
        with_all: whether to begin with a row of all.
    """
    rows = []
    apart = [name for name in APART if evaluations[name].notna().any()]
    rate = ["n", "success", "ci95_low", "ci95_high", *apart]
    for _, one in evaluations.iterrows():
        overall = [{"part": ALL} | one[rate].to_dict()] if with_all else []
        rows += [one[list(columns)].to_dict() | cells for cells in (*overall, *one["parts"])]
    table = pd.DataFrame(rows)
    # Whole numbers, beside rows that have none.
    table = table.astype({name: "Int64" for name in APART if name in table})
    return table.rename(columns={"ci95_low": "success ci95_low", "ci95_high": "success ci95_high", "part": "task"})


def chain_table(parts: pd.DataFrame) -> pd.DataFrame:
    """The `part_table` of the sequential suite, to read: a column for each position."""
    table = parts.rename(columns={"std": "success std"})
    table = merged(table).pivot(index=["policy", "split", "orderings", "n"], columns="task", values="success")
    return table.reset_index().rename_axis(columns=None)


def rates_by_part(segments: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Training success by `by`: of one run with a Wilson interval, of several with Student's over the seeds.

    Returns:
        `by`, successes, n, success, ci95_low, ci95_high (NaN for two seeds). Of one run segments count as
        independent.
    """
    rows = []
    for key, some in segments.groupby(list(by), sort=False):
        counts = some.groupby("folder")[["successes", "n"]].sum()
        successes, n = (int(count) for count in counts.sum())
        if len(counts) == 1:
            ends = wilson_interval(successes, n)
        else:
            ends = summarise(counts["successes"] / counts["n"], (0, 1)).ci95 or (np.nan, np.nan)
        rate = {"successes": successes, "n": n, "success": successes / n, "ci95_low": ends[0]}
        rows.append(dict(zip(by, key, strict=True)) | rate | {"ci95_high": ends[1]})
    return pd.DataFrame(rows)


def merged(table: pd.DataFrame) -> pd.DataFrame:
    """For reading: a number with its `std`, `ci95_low` and `ci95_high` in one cell instead of four."""
    parts = ("std", "ci95_low", "ci95_high")
    shown = table.copy()
    for name in table:
        own = [f"{name} {part}" for part in parts]
        if any(column in table for column in own):
            columns = table.reindex(columns=[name, *own]).itertuples(index=False, name=None)
            shown[name] = [_spread(*numbers) for numbers in columns]
    return shown.drop(columns=[name for name in table if str(name).endswith(tuple(f" {part}" for part in parts))])


def _spread(value: Any, std: Any, low: Any, high: Any) -> str:
    if pd.isna(value):
        return ""
    text = f"{value:.4g}" + ("" if pd.isna(std) else f" ± {std:.2g}")
    return text if pd.isna(low) or pd.isna(high) else f"{text} [{low:.4g}, {high:.4g}]"
