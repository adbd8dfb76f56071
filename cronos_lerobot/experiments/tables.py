"""The tables of an experiment, from the evaluations of its runs."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from cronos_lerobot.experiments.definitions import Experiment
from cronos_lerobot.experiments.plan import Run
from cronos_lerobot.statistics import Summary, performance_gap, success_at, summarise

TRAIN = "cronos-train"
"""The source of evaluations that a run makes of itself."""


def collect(runs: Sequence[Run]) -> pd.DataFrame:
    """All evaluations of some runs, as `load_evaluations` has them; `row` and `seed` are the experiment's.

    One column more: `finished`, whether the run has come to its end.
    """
    from cronos_lerobot.report.load import load_evaluations

    tables = []
    for run in runs:
        if not (run.folder / "train/metrics.jsonl").is_file():
            continue
        found = load_evaluations([run.folder])
        own = {"row": run.row.name, "seed": run.seed, "finished": (run.folder / "train/.done").is_file()}
        tables.append(found.assign(**own))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=["row", "seed", "finished"])


def curve(found: pd.DataFrame, split: str) -> pd.DataFrame:
    """One run's independent evaluations on a split by interaction steps, its own or cronos-eval's."""
    chosen = found[(found["suite"] == "independent") & (found["split"] == split)]
    own = chosen[chosen["source"] == TRAIN]
    return (own if len(own) else chosen).sort_values("steps")


def main_table(experiment: Experiment, found: pd.DataFrame) -> pd.DataFrame:
    """Success at the end, interventions, D and C of every row, over its finished seeds.

    D and C are the areas between the curve and 1.0 over interaction steps and interventions (Equations 3 and 4),
    divided by the length of the axis.
    """
    rows = []
    paper = dict(zip([row.name for row in experiment.rows], experiment.paper, strict=False))
    for row in experiment.rows:
        runs = [run for _, run in found[(found["row"] == row.name) & found["finished"]].groupby("seed")]
        if not runs:
            continue
        curves = [curve(run, "train") for run in runs]
        held_out = [end for run in runs if len(end := curve(run, "held_out"))]
        cells = {
            "row": row.label,
            "seeds": len(runs),
            "base": show(summarise([one["success"].iloc[0] for one in curves])),
            "train": show(summarise([one["success"].iloc[-1] for one in curves], (0, 1))),
            "held out": show(summarise([one["success"].iloc[-1] for one in held_out], (0, 1))),
            "n": int(curves[0]["n"].iloc[-1]),
            "interventions": round(sum(one["interventions"].iloc[-1] for one in curves) / len(curves)),
            "D / steps": show(summarise([_gap(one, "steps") for one in curves])),
            "C / interventions": show(summarise([_gap(one, "interventions") for one in curves])),
        }
        if row.name in paper:
            cells["paper"] = "{:.3f} ± {:.3f}".format(*paper[row.name])
        rows.append(cells)
    return pd.DataFrame(rows)


def budget_table(experiment: Experiment, found: pd.DataFrame, budgets: Sequence[int]) -> pd.DataFrame:
    """Success after numbers of interventions, interpolated between evaluations; empty where a run spent fewer."""
    rows = []
    for row in experiment.rows:
        runs = [run for _, run in found[(found["row"] == row.name) & found["finished"]].groupby("seed")]
        curves = [curve(run, "train") for run in runs]
        cells = {"row": row.label}
        for budget in budgets:
            reached = [one for one in curves if one["interventions"].iloc[-1] >= budget]
            values = [success_at(one["interventions"], one["success"], budget) for one in reached]
            cells[f"{budget:,}"] = show(summarise(values)) if len(values) == len(curves) else ""
        if curves and budgets:
            rows.append(cells)
    return pd.DataFrame(rows)


def sequential_table(experiment: Experiment, found: pd.DataFrame) -> pd.DataFrame:
    """SEQ 0-3 and the chain length of every row and split, over its finished seeds."""
    if "suite" not in found:
        return pd.DataFrame()
    chosen = found[(found["suite"] == "sequential") & found["finished"]]
    rows = []
    for row in experiment.rows:
        for split, runs in chosen[chosen["row"] == row.name].groupby("split", sort=False):
            parts = [
                {part["part"]: part["success"] for part in some if part["orderings"] == "all"}
                for some in runs["parts"]
            ]
            means = {name: show(summarise([one[name] for one in parts])) for name in parts[0]}
            rows.append(
                {"row": row.label, "split": split, "seeds": len(parts), "n": int(runs["n"].iloc[0])} | means
            )
    return pd.DataFrame(rows)


def show(summary: Summary | None) -> str:
    """Mean, standard deviation over seeds, and from three seeds on the 95 % interval of the mean."""
    if summary is None:
        return ""
    interval = "" if summary.ci95 is None else " [{:.3f}, {:.3f}]".format(*summary.ci95)
    return f"{summary.mean:.3f}" + ("" if summary.std is None else f" ± {summary.std:.3f}") + interval


def _gap(one: pd.DataFrame, axis: str) -> float:
    return performance_gap(one[axis], one["success"]).normalised
