"""Writes an experiment's tables and figures, finished or not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from cronos_lerobot.experiments import plots, tables
from cronos_lerobot.experiments.definitions import Experiment
from cronos_lerobot.experiments.plan import Run

NOTES = """\
Mean ± standard deviation over the seeds that are finished; in brackets, from three seeds on, the 95 % t-interval
of the mean. n: episodes of one evaluation. D and C: areas between the curve and 1.0 over interaction steps and
over interventions (Equations 3 and 4), divided by the length of the axis; smaller is better."""
PAPER_NOTE = """\
The paper's numbers are of another simulator, policy and base policy: compare the order of the rows."""
CURVE_COLUMNS = ["row", "seed", "finished", "source", "suite", "split", "steps", "interventions", "n", "success"]


def write_outputs(experiment: Experiment, runs: Sequence[Run], folder: Path) -> str:
    """Write NAME.md, NAME.csv, NAME_evaluations.csv and pictures into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    name, options = experiment.name, runs[0].options
    found = tables.collect(runs)
    finished = found[found["finished"].astype(bool)]
    main = tables.main_table(experiment, finished)
    budgets = [options.scale.scaled(budget, experiment.steps) for budget in experiment.budgets]
    sections = {
        "": main,
        "Success after so many interventions": tables.budget_table(experiment, finished, budgets),
        "Sequences of tasks": tables.sequential_table(experiment, finished),
        "Streams without a reset": tables.stream_table(experiment, finished),
    }
    where = f"{experiment.source} of the paper. " if experiment.source else ""
    lines = [f"# {experiment.title}", ""]
    lines.append(f"{where}{experiment.scene}, {options.obs}, {runs[0].steps:,} interaction steps.")
    if options.extra:
        lines += ["", f"All runs have these flags besides: `{' '.join(options.extra)}`."]
    for title, table in sections.items():
        if len(table):
            lines += ["", f"## {title}", ""] if title else [""]
            lines.append(table.to_markdown(index=False, disable_numparse=True))
    lines += ["", NOTES] + [PAPER_NOTE] * bool(experiment.paper)
    missing = [run.name for run in runs if not (run.folder / "train/.done").is_file()]
    lines += ["", "Not finished: " + ", ".join(missing) + "."] if missing else []
    lines += [f"\n![{file}]({file})" for file in _draw(experiment, found, folder)]
    main.to_csv(folder / f"{name}.csv", index=False)
    found.reindex(columns=CURVE_COLUMNS).to_csv(folder / f"{name}_evaluations.csv", index=False)
    page = "\n".join(lines) + "\n"
    (folder / f"{name}.md").write_text(page)
    return f"{page}\nWritten to {folder}"


def _draw(experiment: Experiment, found: pd.DataFrame, folder: Path) -> list[str]:
    """Write the pictures; returns their names."""
    if not len(found):
        return []
    name = experiment.name
    finished = found[found["finished"].astype(bool)]
    figures = {name: plots.curves_figure(experiment, found)}
    if len(finished):
        figures[f"{name}_ends"] = plots.ends_figure(experiment, finished)
    figures[f"{name}_by_task"] = plots.by_task_figure(experiment, found)
    for file, figure in figures.items():
        figure.savefig(folder / f"{file}.png", dpi=120)
    return [f"{file}.png" for file in figures]
