"""Writes an experiment's tables and figures, finished or not."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cronos_lerobot.experiments import plots, tables
from cronos_lerobot.experiments.columns import (
    Columns,
    budget_columns,
    claim_columns,
    difference_columns,
    gain_columns,
    main_columns,
    order_columns,
    quarter_columns,
    segment_columns,
    sequential_columns,
)
from cronos_lerobot.experiments.definitions import Experiment, Row
from cronos_lerobot.experiments.differences import Gain, RowDifference, compare_rows, gains, to_first
from cronos_lerobot.experiments.intervention_plots import interventions_figure
from cronos_lerobot.experiments.jobs import this_commit
from cronos_lerobot.experiments.orders import MARGIN, Order, paper_orders
from cronos_lerobot.experiments.results import (
    ExperimentResult,
    RowResult,
    SeedResult,
    collect,
    paper_results,
)
from cronos_lerobot.experiments.specs import Options, base_policy
from cronos_lerobot.report.paired import ALPHA
from cronos_lerobot.report.png import to_png
from cronos_lerobot.report.tables import write_csv
from cronos_lerobot.training.logging import METRICS

DPI, DPI_BY_TASK = 150, 100
"""Dots an inch; a figure by task has four times the panels."""


def write_outputs(experiment: Experiment, rows: Iterable[Row], options: Options, folder: Path) -> str:
    """Write NAME.md, .json, .csv, .png and the like into `folder`; returns the page, as text for a terminal."""
    result = collect(experiment, rows, options)
    folder.mkdir(parents=True, exist_ok=True)
    name = experiment.name
    differences = compare_rows(result)
    learned = gains(result)
    data = {
        name: tables.main_rows(result),
        f"{name}_differences": tables.difference_rows(differences),
        f"{name}_gains": tables.gain_rows(learned),
        f"{name}_curves": tables.curve_rows(result),
        f"{name}_segments": tables.segment_rows(result),
        f"{name}_tasks": tables.task_rows(result),
        f"{name}_sequential": tables.sequential_rows(result),
    }
    for file, table in data.items():
        # What is there is of other rows or seeds, if it is not of these.
        (folder / f"{file}.csv").unlink(missing_ok=True)
        if table:
            write_csv(folder / f"{file}.csv", table)
    first = interventions_figure if experiment.by_base else plots.curves_figure
    drawings = {
        name: first(result),
        f"{name}_bars": plots.bars_figure(result),
        f"{name}_segments": plots.segments_figure(result),
        f"{name}_sequential": plots.sequential_figure(result),
    }
    drawn = []
    for file, figure in drawings.items():
        (folder / f"{file}.png").unlink(missing_ok=True)
        if figure is not None:
            png = to_png(figure, DPI_BY_TASK if experiment.by_task else DPI)
            (folder / f"{file}.png").write_bytes(png)
            drawn.append(f"{file}.png")
    summary = _settings(result) | {"rows": data[name], "claims": tables.claim_rows(result)}
    orders = paper_orders(result)
    summary |= {"gains": data[f"{name}_gains"], "differences": data[f"{name}_differences"]}
    summary |= {"orders": tables.order_rows(orders)}
    summary["bases"] = {recipe: sorted(policies) for recipe, policies in result.bases.items()}
    summary["hours"] = round(sum(seed.seconds for row in result.rows for seed in row.seeds) / 3600, 2)
    summary |= {"segments": data[f"{name}_segments"], "sequential": data[f"{name}_sequential"]}
    (folder / f"{name}.json").write_text(json.dumps(summary, indent=2))
    page = markdown(result, learned, differences, orders, drawn)
    (folder / f"{name}.md").write_text(page)
    return f"{page}\nWritten to {folder}"


def _settings(result: ExperimentResult) -> dict[str, Any]:
    options, experiment = result.options, result.experiment
    bases = [row.row.begins_with(experiment.scene) for row in result.rows]
    return {
        "experiment": experiment.name,
        "title": experiment.title,
        "paper": {"where": experiment.source, "source": paper_results()["_source"]},
        "scene": experiment.scene,
        "obs_type": options.obs_type,
        "scale": options.scale.name,
        "steps": options.scale.steps[experiment.steps],
        "paper_steps": experiment.steps,
        "seeds": list(options.seeds),
        "temperature": options.temperature,
        "base_policies": list(dict.fromkeys(base_policy(base, options) for base in bases)),
        "extra_flags": list(options.extra),
        "runs": [
            {"run": seed.spec.name, "finished": seed.finished, "metrics": str(seed.spec.train_folder / METRICS)}
            for row in result.rows
            for seed in row.seeds
        ],
        "left_out": result.changed,
        "made_at_another_commit": result.commits,
    }


def markdown(
    result: ExperimentResult,
    learned: Sequence[Gain],
    differences: Sequence[RowDifference],
    orders: Sequence[Order],
    figures: Sequence[str],
) -> str:
    """The page: what was run, the table, what the paper's text says, the figures, what is missing."""
    lines = [*_introduction(result), "", *_table(main_columns(result)), "", NOTES, *_learning_notes(result)]
    if result.experiment.source:
        lines += _about_the_paper(result)
    if grown := gain_columns(learned):
        lines += [*_section("What each row has learned", grown), "", GAIN_NOTES]
    if separated := difference_columns(to_first(result, differences)):
        lines += [*_section("Which rows differ", separated), "", DIFFERENCE_NOTES]
    if spent := budget_columns(result):
        lines += [*_section("Success after so many interventions", spent), *_budget_notes(result)]
    lines += _section("What the text says", claim_columns(tables.claim_rows(result)))
    if orders:
        lines += [*_section("What the text says of two rows", order_columns(orders)), "", ORDER_NOTES]
    lines += _section("Sequences of tasks", sequential_columns(result, tables.sequential_rows(result)))
    lines += _section("Success while training, by segment since the last scene reset", segment_columns(result))
    lines += _section("Success while training, by quarter of the run", quarter_columns(result))
    for file in figures:
        lines += ["", f"![{file}]({file})"]
    lines += _unfinished(result)
    return "\n".join(lines) + "\n"


NOTES = (
    "Numbers are mean ± standard deviation (ddof = 1) over the seeds that are finished; in brackets the 95 %"
    " t-interval of the mean over seeds, of one seed alone, or of several that came to the same, the Wilson"
    " interval of one evaluation. n: episodes of one seed's evaluation. D and C are the areas between the curve"
    " and 1.0 over interaction steps and over interventions (Equations 3 and 4), divided by the length of the"
    " axis: smaller is better. Found complete, never grasped: of the successes at the end, all seeds together,"
    " those for which nothing had to be done, and others without a grasp."
)
GAIN_NOTES = (
    "Success at the end of each run minus that of the base policy it began with, on the same episodes; 95 %"
    " interval and p of trainings like these from these bases, clustered by training and configuration, or of one"
    " seed of these policies alone. p (Holm) is adjusted for the lines of this table."
)
DIFFERENCE_NOTES = (
    "Success of a row minus that of its reference, the first finished row from the same base policy, at the end of"
    " the runs and on the same episodes; 95 % interval and p are those of `cronos-report compare`: of trainings"
    " like these, clustered by training and configuration, or where a row has one seed of these policies alone,"
    " which says nothing of other trainings. Of two rows that have seeds in common these alone are compared. p"
    " (Holm) is adjusted for the lines of this table. Not separated is no sign that two rows do alike. All pairs"
    " of rows that were evaluated on the same episodes are in the CSV file."
)
BUDGET_NOTES = (
    "A number without a mark is measured, by the evaluation at the first policy update at which so many"
    " interventions had been counted; ~ is interpolated between two evaluations."
)
ORDER_NOTES = (
    "Differences as above, of the first row minus the second, on the episodes of the suite that is named: of"
    " chains, how many tasks were done before the first failure. Holds: yes"
    f" or no where p < {ALPHA}, not adjusted; of two rows that are said to do alike, where the whole interval is"
    f" within {MARGIN} of zero, or beyond it; two of these that differ (p < {ALPHA}), by more than that or by"
    " less, are undecided. Not applicable: the base policies of both leave nothing to learn."
)
PPO_NOTES = (
    "A scale is that of steps, streams and seeds. The learning algorithm is `ppo`, with this project's settings,"
    " at every scale; the paper's settings are `-- --algorithm.type=ppo_paper`."
)


def _introduction(result: ExperimentResult) -> list[str]:
    experiment, options = result.experiment, result.options
    lines = [f"# {experiment.title}", ""]
    if experiment.source:
        lines += [f"{experiment.source} of the paper, repeated by `cronos-reproduce`.", ""]
    steps = options.scale.steps[experiment.steps]
    text = f"{experiment.scene}, {options.obs_type}, {steps:,} interaction steps ({options.scale.name} scale),"
    lines.append(f"{text} sampling temperature {options.temperature} in evaluations.")
    if options.extra:
        flags = " ".join(map(shlex.quote, options.extra))
        lines += ["", f"All runs have these flags besides, whatever a row is called: `{flags}`."]
    return lines


def _learning_notes(result: ExperimentResult) -> list[str]:
    """Nothing where flags after `--` choose another agent: they are named above."""
    if any(flag.startswith("--algorithm.type=") for flag in result.options.extra):
        return []
    own = {
        each.row.label: flag
        for each in result.rows
        for flag in each.row.flags
        if flag.startswith("--algorithm.type=")
    }
    lines = [] if len(own) == len(result.rows) else ["", PPO_NOTES]
    if own:
        named = ", ".join(f"{label} (`{flag}`)" for label, flag in own.items())
        lines += ["", f"Rows with an agent of their own: {named}."]
    return lines


def _about_the_paper(result: ExperimentResult) -> list[str]:
    paper_steps = result.experiment.steps
    steps = result.options.scale.steps[paper_steps]
    lines = [
        "",
        f"The paper's numbers: {paper_results()['_source']} Another simulator, another policy and another base:"
        " compare the order of the rows, not the numbers.",
    ]
    if steps != paper_steps:
        lines += [
            "",
            f"These runs have {steps:,} of the paper's {paper_steps:,} steps and as many fewer interventions:"
            f" multiply them by {paper_steps / steps:.1f} to compare.",
        ]
    return lines


def _budget_notes(result: ExperimentResult) -> list[str]:
    """What is measured, and for each cell that is not, why or between what it is interpolated."""
    lines = []
    for row in result.rows:
        for budget in tables.budgets(result) if row.finished else ():
            found = row.success_at(budget)
            if found.reason:
                lines.append(f"- {row.row.label} at {budget:,}: not applicable, {found.reason}.")
            elif found.between and found.summary:
                low, high = found.between
                lines.append(f"- {row.row.label} at {budget:,}: a straight line between {low:,} and {high:,}.")
    return ["", BUDGET_NOTES, *([""] if lines else []), *lines]


def _unfinished(result: ExperimentResult) -> list[str]:
    lines = []
    for row in result.rows:
        for seed in row.seeds:
            if not seed.finished:
                lines.append(
                    f"- {seed.spec.name}: {seed.run.last['interaction_steps']:,} of {seed.spec.steps:,} steps"
                    f" ({seed.status or 'no note of its start'})"
                )
            lines += [f"- {name}: not evaluated" for name in seed.missing if seed.finished]
        lines += [f"- {name}: no record so far ({state})" for name, state in row.unrecorded.items()]
        missing = row.wanted - len(row.seeds) - len(row.unrecorded) - row.left_out
        if missing:
            lines.append(f"- {_group(result, row)}: {missing} of {row.wanted} seeds not begun")
    if lines:
        lines = [
            "",
            "## Not finished",
            "",
            "Unfinished runs are drawn only where a row has no finished one.",
            "",
            *dict.fromkeys(lines),
        ]
    if early := _ended_early(result):
        lines += ["", "## Ended by their budget of interventions", "", *early]
    if result.changed:
        lines += ["", "## Left out: made by another command or version, or damaged", ""]
        lines += [f"- {text}" for text in result.changed]
    for name, policies in result.bases.items():
        if len(policies) > 1:
            lines += ["", f"## Not one base policy: {len(policies)} policies called {name}", ""]
            lines += [f"- {base}: {_names(seeds)}" for base, seeds in policies.items()]
    if mixed := result.mixed:
        lines += ["", "## Rows whose runs had other settings by default", ""]
        lines += [f"- {row}: {'; '.join(settings)}" for row, settings in mixed.items()]
    if result.commits:
        lines += ["", f"## Made at another commit than {this_commit() or 'this one'}", ""]
        lines += ["The versions are the same, so they count.", "", *(f"- {text}" for text in result.commits)]
    return lines


def _ended_early(result: ExperimentResult) -> list[str]:
    return [
        f"- {seed.spec.name}: after {seed.run.last['interaction_steps']:,} of {seed.spec.steps:,} steps"
        for row in result.rows
        for seed in row.finished
        if seed.run.last["interaction_steps"] < seed.spec.steps
    ]


def _names(seeds: Sequence[SeedResult]) -> str:
    return ", ".join(f"{seed.spec.row.name} seed {seed.spec.seed}" for seed in seeds)


def _group(result: ExperimentResult, row: RowResult) -> str:
    return row.seeds[0].spec.group if row.seeds else row.row.name


def _section(title: str, columns: Columns) -> list[str]:
    return ["", f"## {title}", "", *_table(columns)] if columns else []


def _table(columns: Columns) -> list[str]:
    titles = list(columns)
    lines = [titles, ["---"] * len(titles), *(list(cells) for cells in zip(*columns.values(), strict=True))]
    return [f"| {' | '.join(line)} |" for line in lines]
