"""The tables of an experiment, as plain data and as Markdown, the paper's numbers beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from cronos_lerobot.experiments.definitions import INTERACTION_STEPS, INTERVENTIONS
from cronos_lerobot.experiments.differences import Gain, RowDifference
from cronos_lerobot.experiments.orders import Order
from cronos_lerobot.experiments.results import (
    APART,
    ExperimentResult,
    RowResult,
    paper_results,
    sequential,
    summarise_points,
)
from cronos_lerobot.protocol.metrics import Summary, interpolate, summarise
from cronos_lerobot.report.series import segment_rates, task_rates
from cronos_lerobot.report.statistics import Rate

Row = dict[str, Any]
TICK = {True: "✓", False: "–"}


def budgets(result: ExperimentResult) -> list[int]:
    """Numbers of interventions at which success is given: the paper's, scaled as the steps are."""
    steps = result.options.scale.steps[result.experiment.steps]
    return [budget * steps // result.experiment.steps for budget in result.experiment.budgets]


def main_rows(result: ExperimentResult) -> list[Row]:
    """One row of each way of training: settings, success at the end, the paper's, interventions, D and C."""
    shared = _shared_budget(result)
    return [_main_row(result, row, shared) for row in result.rows]


def _shared_budget(result: ExperimentResult) -> float | None:
    """The interventions that every finished run has come to."""
    spent = [seed.run.last["interventions"] for row in result.rows for seed in row.finished]
    return min(spent, default=None)


def _main_row(result: ExperimentResult, row: RowResult, shared: float | None) -> Row:
    setting = row.row
    cells: Row = {
        "row": setting.name,
        "T": setting.interval,
        "EER": setting.end_effector_reset,
        "CL": setting.curriculum,
        "LSR": setting.learned_reset,
        "HSR": setting.heuristic_reset,
        "base": setting.base,
        "task_order": setting.task_order,
        "configurations": setting.num_configurations,
        "seeds": len(row.finished),
        "seeds_wanted": row.wanted,
    }
    for split in result.experiment.splits:
        cells |= _numbers(f"success_{split}", row.success(split))
        cells[f"seeds_{split}"] = len(row.finals(split))
        cells[f"n_{split}"] = next((point.n for point in row.finals(split)), None)
        cells |= {f"{name}_{split}": row.apart(split).get(name) for name in APART}
    paper = paper_results()["final_success"].get(result.experiment.name, {}).get(setting.name)
    cells |= {"paper_mean": paper[0] if paper else None, "paper_std": paper[1] if paper else None}
    starts = [seed.curve("train")[0] for seed in row.finished if seed.curve("train")]
    cells |= _numbers("base_success", summarise_points([point for point in starts if not point.interaction_steps]))
    cells |= _numbers("interventions", summarise([seed.run.last["interventions"] for seed in row.finished]))
    cells |= _numbers("D", row.area(INTERACTION_STEPS))
    cells |= _numbers("D_normalised", row.gap(INTERACTION_STEPS))
    cells |= _numbers("C", row.area(INTERVENTIONS))
    cells |= _numbers("C_normalised", row.gap(INTERVENTIONS))
    cells |= {"shared_budget": shared} | _numbers("C_normalised_shared", row.gap(INTERVENTIONS, up_to=shared))
    for budget in budgets(result):
        at = row.success_at(budget)
        cells |= _numbers(f"success_at_{budget}", at.summary)
        cells[f"success_at_{budget}_interpolated_between"] = "-".join(map(str, at.between)) if at.between else None
        cells[f"success_at_{budget}_not_applicable"] = at.reason or None
    return cells


def _numbers(name: str, summary: Summary | None) -> Row:
    """Columns of a summary; empty where there is none."""
    low, high = (summary.ci95 if summary else None) or (None, None)
    return {
        f"{name}_mean": summary.mean if summary else None,
        f"{name}_std": summary.std if summary else None,
        f"{name}_ci95_low": low,
        f"{name}_ci95_high": high,
    }


def _rate_cells(rate: Rate) -> Row:
    low, high = rate.interval
    return {"success": rate.value, "successes": rate.successes, "n": rate.n, "ci95_low": low, "ci95_high": high}


def difference_rows(found: Sequence[RowDifference]) -> list[Row]:
    """Success of a row minus that of its reference, on the same episodes."""
    return [
        {
            "row": one.row.row.name,
            "reference": one.reference.row.name,
            "seeds": one.seeds[0],
            "seeds_reference": one.seeds[1],
            "episodes": one.episodes,
            "difference": one.difference.value,
        }
        | _certainty(one)
        for one in found
    ]


def gain_rows(found: Sequence[Gain]) -> list[Row]:
    """Success at the end of a row's runs minus that of the base policies, on the same episodes."""
    return [
        {
            "row": one.row.row.name,
            "seeds": one.seeds,
            "episodes": one.episodes,
            "before": one.before,
            "after": one.after,
            "gain": one.difference.value,
        }
        | _certainty(one)
        for one in found
    ]


def _certainty(one: RowDifference | Gain) -> Row:
    low, high = one.difference.ci95 or (None, None)
    return {"ci95_low": low, "ci95_high": high, "p": one.difference.p, "of_trainings": one.of_trainings}


def segment_rows(result: ExperimentResult) -> list[Row]:
    """Success while training by segment since the last scene reset, in the last quarter of the runs."""
    return [
        {"row": row.row.name, "segment": segment} | _rate_cells(rate)
        for row in result.rows
        for segment, rate in segment_rates(row.group).items()
    ]


def task_rows(result: ExperimentResult) -> list[Row]:
    """Success while training by quarter of the runs and instruction; those of learned resets are told apart."""
    return [
        {"row": row.row.name, "quarter": quarter + 1, "is_reset_task": instruction not in result.tasks}
        | {"task": instruction}
        | _rate_cells(rate)
        for row in result.rows
        for (quarter, instruction), rate in task_rates(row.group).items()
    ]


def curve_rows(result: ExperimentResult) -> list[Row]:
    """Every evaluation of every run, finished or not, for all tasks together and for each."""
    rows = []
    for row in result.rows:
        for seed in row.seeds:
            for split in result.experiment.splits:
                for task in (None, *result.tasks):
                    identity = {"row": row.row.name, "seed": seed.spec.seed, "finished": seed.finished}
                    identity |= {"split": split, "task": task or "all tasks"}
                    for point in seed.curve(split, task):
                        cells = asdict(point)
                        low, high = cells.pop("ci95")
                        cells |= cells.pop("apart")
                        cells["at_interventions"] = " ".join(map(str, point.at_interventions))
                        rows.append(identity | cells | {"ci95_low": low, "ci95_high": high})
    return rows


ORDERINGS = ("all", "seen", "unseen")
"""In training: heuristic streams run the training cycle without end."""


def sequential_rows(result: ExperimentResult) -> list[Row]:
    """SEQ 0-3 and the average chain length of every row and split, seen and unseen orderings apart."""
    kinds = [
        (split, row, orderings)
        for evaluation in result.experiment.evaluations
        if evaluation.suite == "sequential"
        for split in evaluation.splits
        for row in result.rows
        for orderings in ORDERINGS
    ]
    rows = []
    for split, row, orderings in kinds:
        if found := sequential(row, split, orderings):
            cells: Row = {"row": row.row.name, "split": split, "orderings": orderings}
            cells |= {"seeds": found["chain_length"].n, "n": found["n"]}
            for position, summary in enumerate(found["positions"]):
                cells |= _numbers(f"SEQ {position}", summary)
            rows.append(
                cells | _numbers("chain_length", found["chain_length"]) | {name: found[name] for name in APART}
            )
    return rows


def claim_rows(result: ExperimentResult) -> list[Row]:
    """Numbers in the paper's text, each beside our own, which is None where it is not known (yet)."""
    name, paper = result.experiment.name, paper_results()
    rows = {row.row.name: row for row in result.rows}
    claims: list[Row] = []
    for row, count in paper["interventions_at_the_end"].get(name, {}).items():
        if row in rows:
            spent = summarise([seed.run.last["interventions"] for seed in rows[row].finished])
            claims.append(_claim(f"interventions of {row} at the end", count, spent.mean if spent else None))
    if reach := paper["interventions_to_reach"].get(name):
        for row, count in reach["rows"].items():
            if row in rows:
                text = f"interventions of {row} to reach the end of {reach['goal']}"
                claims.append(_claim(text, count, *_reach(rows[row], rows.get(reach["goal"]))))
    if gap := paper["difference_at_interventions"].get(name):
        claims.append(_difference(gap, rows, result))
    return claims


def order_rows(orders: Sequence[Order]) -> list[Row]:
    """What the paper says of two rows, the difference here, and whether it holds."""
    rows = []
    for one in orders:
        told = {
            name: getattr(one, name) for name in ("row", "reference", "says", "where", "suite", "split", "unit")
        }
        found = difference_rows([one.found] if one.found else [])
        rows.append(
            told | {"holds": one.holds, "not_applicable": one.reason or None} | (found[0] if found else {})
        )
    return rows


def _difference(gap: dict[str, Any], rows: dict[str, RowResult], result: ExperimentResult) -> Row:
    """A row's success minus another's after a number of interventions."""
    steps = result.options.scale.steps[result.experiment.steps]
    at = gap["interventions"] * steps // result.experiment.steps
    text = f"{gap['better']} minus {gap['worse']} after {gap['interventions']} interventions"
    text += "" if at == gap["interventions"] else f" (ours: {at})"
    found = {name: rows[name].success_at(at) for name in (gap["better"], gap["worse"]) if name in rows}
    reasons = "; ".join(f"{name}: {one.reason}" for name, one in found.items() if one.reason)
    means = [one.summary.mean for one in found.values() if one.summary]
    ours = means[0] - means[1] if len(means) == 2 else None
    is_interpolated = ours is not None and any(one.between for one in found.values())
    return _claim(text, gap["difference"], ours, reasons, interpolated=is_interpolated)


def _claim(what: str, paper: float, ours: float | None, reason: str = "", *, interpolated: bool = False) -> Row:
    claim: Row = {"claim": what, "paper": paper, "ours": ours, "interpolated": interpolated}
    return claim | {"not_applicable": reason or None}


def _reach(row: RowResult, goal_row: RowResult | None) -> tuple[float | None, str]:
    """Interventions until a row comes to another one's end, or why that says nothing."""
    goal = goal_row.success("train") if goal_row else None
    starts = [curve[0].success for seed in row.finished if (curve := seed.curve("train"))]
    if goal is None or not starts:
        return None, ""
    base = float(np.mean(starts))
    if base >= goal.mean:
        return None, f"the base policy is there from the start: {base:.3f}, the goal is {goal.mean:.3f}"
    ours = interventions_to_reach(row, goal.mean)
    return ours, "" if ours is not None else f"it never came to {goal.mean:.3f}"


def interventions_to_reach(row: RowResult, goal: float) -> float | None:
    """The first number of interventions at which the mean of the finished seeds is `goal`; None if it never is."""
    curves = [seed.curve("train") for seed in row.finished if seed.curve("train")]
    if not curves:
        return None
    xs = [[point.interventions for point in curve] for curve in curves]
    grid = np.arange(max(x[0] for x in xs), min(x[-1] for x in xs) + 1)
    if len(grid) == 0:
        return None
    mean = np.mean([interpolate(x, [p.success for p in c], grid) for x, c in zip(xs, curves, strict=True)], axis=0)
    reached = np.flatnonzero(mean >= goal)
    return float(grid[reached[0]]) if len(reached) else None
