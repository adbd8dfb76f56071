"""The tables of an experiment, from the evaluations of its runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isnan
from pathlib import Path
from statistics import mean
from typing import Any

import pandas as pd

from cronos_lerobot.experiments.definitions import Experiment, Row
from cronos_lerobot.experiments.plan import Run
from cronos_lerobot.report.load import EVALUATIONS, TRAIN, load_evaluations
from cronos_lerobot.statistics import Summary, performance_gap, success_at, summarise

Parts = list[dict[str, Any]]
"""Numbers of an evaluation by task, position or segment, as in the column `parts`."""


def collect(runs: Sequence[Run]) -> pd.DataFrame:
    """All evaluations of some runs, as `load_evaluations` has them; `row` and `seed` are the experiment's.

    One column more: `finished`, whether the run has come to its end.
    """
    tables = []
    for run in runs:
        if not (run.folder / "train/metrics.jsonl").is_file():
            continue
        found = load_evaluations([run.folder])
        evaluated = found["source"] != TRAIN
        # Their folders have the steps; the base policy's own are those of its cloning.
        if evaluated.any():
            found.loc[evaluated, "steps"] = [int(Path(path).parents[1].name) for path in found[evaluated]["path"]]
        found.loc[found["steps"] == 0, "interventions"] = 0
        own = {"row": run.row.name, "seed": run.seed, "finished": (run.folder / "train/.done").is_file()}
        tables.append(found.assign(**own))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=[*EVALUATIONS, "finished"])


def curves(found: pd.DataFrame, row: Row, split: str) -> list[pd.DataFrame]:
    """The independent evaluations of each seed on a split by interaction steps, the run's own or cronos-eval's."""
    chosen = found[(found["row"] == row.name) & (found["suite"] == "independent") & (found["split"] == split)]
    several = []
    for _, one in chosen.groupby("seed"):
        own = one[one["source"] == TRAIN]
        several.append((own if len(own) else one).sort_values("steps"))
    return several


def main_table(experiment: Experiment, found: pd.DataFrame) -> pd.DataFrame:
    """Success at the end, interventions, D and C of every row, over its seeds.

    D and C are the areas between the curve and 1.0 over interaction steps and interventions (Equations 3 and 4),
    divided by the length of the axis.
    """
    rows = []
    paper = dict(zip([row.name for row in experiment.rows], experiment.paper, strict=False))
    for row in experiment.rows:
        seeds, held_out = curves(found, row, "train"), curves(found, row, "held_out")
        if not seeds:
            continue
        cells = {
            "row": row.label,
            "seeds": len(seeds),
            "base": show(summarise([one["success"].iloc[0] for one in seeds])),
            "train": show(summarise([one["success"].iloc[-1] for one in seeds], (0, 1))),
            "held out": show(summarise([one["success"].iloc[-1] for one in held_out], (0, 1))),
            "n": int(seeds[0]["n"].iloc[-1]),
            "interventions": round(sum(one["interventions"].iloc[-1] for one in seeds) / len(seeds)),
        }
        for name, axis in (("D / steps", "steps"), ("C / interventions", "interventions")):
            gaps = [performance_gap(one[axis], one["success"]) for one in seeds]
            cells[name] = show(summarise(gaps))
        if row.name in paper:
            cells["paper"] = "{:.3f} ± {:.3f}".format(*paper[row.name])
        rows.append(cells)
    return pd.DataFrame(rows)


def budget_table(experiment: Experiment, found: pd.DataFrame, budgets: Sequence[int]) -> pd.DataFrame:
    """Success after numbers of interventions, interpolated between evaluations; empty where a run spent fewer."""
    rows = []
    for row in experiment.rows if budgets else ():
        seeds = curves(found, row, "train")
        cells = {"row": row.label}
        for budget in budgets:
            is_reached = all(one["interventions"].iloc[-1] >= budget for one in seeds)
            values = [success_at(one["interventions"], one["success"], budget) for one in seeds]
            cells[f"{budget:,}"] = show(summarise(values)) if is_reached else ""
        if seeds:
            rows.append(cells)
    return pd.DataFrame(rows)


def sequential_table(experiment: Experiment, found: pd.DataFrame) -> pd.DataFrame:
    """SEQ 0-3 and the chain length of every row and split, over its seeds."""

    def values(parts: Parts) -> dict[str, float]:
        return {part["part"]: part["success"] for part in parts if part["orderings"] == "all"}

    return _by_split(experiment, found[found["suite"] == "sequential"], values)


def stream_table(experiment: Experiment, found: pd.DataFrame) -> pd.DataFrame:
    """Success in streams without a reset, of every row and split, over its seeds; n counts streams."""

    def values(parts: Parts) -> dict[str, float]:
        segments = [part["success"] for part in parts]
        half = segments[len(segments) // 2 :]
        return {"all": mean(segments), "first segment": segments[0], "second half": mean(half)}

    return _by_split(experiment, found[found["suite"] == "stream"], values)


def _by_split(
    experiment: Experiment, found: pd.DataFrame, values: Callable[[Parts], dict[str, float]]
) -> pd.DataFrame:
    rows = []
    for row in experiment.rows:
        for split, runs in found[found["row"] == row.name].groupby("split", sort=False):
            seeds = [values(parts) for parts in runs["parts"]]
            means = {name: show(summarise([one[name] for one in seeds])) for name in seeds[0]}
            rows.append(
                {"row": row.label, "split": split, "seeds": len(seeds), "n": int(runs["n"].iloc[0])} | means
            )
    return pd.DataFrame(rows)


def show(summary: Summary) -> str:
    """Mean, standard deviation over seeds, and from three seeds on the 95 % interval of the mean."""
    if isnan(summary.mean):
        return ""
    interval = "" if summary.ci95 is None else " [{:.3f}, {:.3f}]".format(*summary.ci95)
    return f"{summary.mean:.3f}" + ("" if summary.std is None else f" ± {summary.std:.3f}") + interval
