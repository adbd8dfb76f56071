"""Writes an experiment's tables and figures, finished or not."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from cronos_lerobot.experiments import plots, tables
from cronos_lerobot.experiments.definitions import Experiment, Row
from cronos_lerobot.experiments.differences import RowDifference, compare_rows, to_first
from cronos_lerobot.experiments.intervention_plots import interventions_figure
from cronos_lerobot.experiments.jobs import this_commit
from cronos_lerobot.experiments.results import (
    APART,
    AtBudget,
    ExperimentResult,
    RowResult,
    collect,
    paper_results,
)
from cronos_lerobot.experiments.specs import Options, base_policy
from cronos_lerobot.protocol.metrics import Summary
from cronos_lerobot.report.paired import ALPHA, holm
from cronos_lerobot.report.statistics import Rate
from cronos_lerobot.report.tables import write_csv
from cronos_lerobot.training.logging import METRICS

DPI = 150
MISSING = "–"
NOT_APPLICABLE = "not applicable"


def write_outputs(experiment: Experiment, rows: Iterable[Row], options: Options, folder: Path) -> str:
    """Write NAME.md, .json, .csv, .png and the like into `folder`; returns the page, as text for a terminal."""
    result = collect(experiment, rows, options)
    folder.mkdir(parents=True, exist_ok=True)
    name = experiment.name
    differences = compare_rows(result)
    data = {
        name: tables.main_rows(result),
        f"{name}_differences": tables.difference_rows(differences),
        f"{name}_curves": tables.curve_rows(result),
        f"{name}_segments": tables.segment_rows(result),
        f"{name}_tasks": tables.task_rows(result),
        f"{name}_sequential": tables.sequential_rows(result),
    }
    for file, table in data.items():
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
        if figure is not None:
            buffer = BytesIO()
            figure.savefig(buffer, format="png", dpi=DPI)
            (folder / f"{file}.png").write_bytes(buffer.getvalue())
            drawn.append(f"{file}.png")
    summary = _settings(result) | {"rows": data[name], "claims": tables.claim_rows(result)}
    summary |= {"differences": data[f"{name}_differences"]}
    summary |= {"segments": data[f"{name}_segments"], "sequential": data[f"{name}_sequential"]}
    (folder / f"{name}.json").write_text(json.dumps(summary, indent=2))
    page = markdown(result, differences, drawn)
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


def markdown(result: ExperimentResult, differences: Sequence[RowDifference], figures: Sequence[str]) -> str:
    """The page: what was run, the table, what the paper's text says, the figures, what is missing."""
    lines = [*_introduction(result), "", *_table(_main_columns(result)), "", NOTES, "", PPO_NOTES]
    if result.experiment.source:
        lines += _about_the_paper(result)
    if difference_columns := _difference_columns(to_first(result, differences)):
        lines += [*_section("Which rows differ", difference_columns), "", DIFFERENCE_NOTES]
    if budget_columns := _budget_columns(result):
        lines += [*_section("Success after so many interventions", budget_columns), *_budget_notes(result)]
    lines += _section("What the text says", _claim_columns(tables.claim_rows(result)))
    lines += _section("Sequences of tasks", _sequential_columns(tables.sequential_rows(result)))
    lines += _section("Success while training, by segment since the last scene reset", _segment_columns(result))
    lines += _section("Success while training, by quarter of the run", _quarter_columns(result))
    for file in figures:
        lines += ["", f"![{file}]({file})"]
    lines += _unfinished(result)
    return "\n".join(lines) + "\n"


NOTES = (
    "Numbers are mean ± standard deviation (ddof = 1) over the seeds that are finished; in brackets the 95 %"
    " t-interval of the mean over seeds, of one seed alone the Wilson interval of its"
    " evaluation. n: episodes of one seed's evaluation. D and C are the areas between the curve and 1.0 over"
    " interaction steps and over interventions (Equations 3 and 4), divided by the length of the axis: smaller is"
    " better. Found complete, never grasped: of the successes at the end, all seeds together, those for which"
    " nothing had to be done, and others without a grasp."
)
DIFFERENCE_NOTES = (
    "Success of a row minus that of its reference, the first finished row from the same base policy, at the end of"
    " the runs and on the same episodes; 95 % interval and p are those of `cronos-report compare`: of trainings"
    " like these, clustered by training and configuration, or where a row has one seed of these policies alone,"
    " which says nothing of other trainings. p (Holm) is adjusted for the lines of this table. Not separated is no"
    " sign that two rows do alike. All pairs of rows that were evaluated on the same episodes are in the CSV file."
)
BUDGET_NOTES = (
    "A number without a mark is measured, by the evaluation at the first policy update at which so many"
    " interventions had been counted; ~ is interpolated between two evaluations."
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
    return [*lines, f"{text} sampling temperature {options.temperature} in evaluations."]


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


Columns = dict[str, list[str]]


def _main_columns(result: ExperimentResult) -> Columns:
    rows = tables.main_rows(result)
    columns: Columns = {"T": [str(row["T"] or MISSING) for row in rows]}
    for aid in ("EER", "CL", "LSR", "HSR"):
        if any(row[aid] for row in rows):
            columns[aid] = [tables.TICK[row[aid]] for row in rows]
    titles = (("base", "demonstrations"), ("task_order", "order"), ("configurations", "configurations"))
    for name, title in titles:
        if len({row[name] for row in rows}) > 1:
            columns[title] = [str(row[name]).replace("_", " ") for row in rows]
    if any(row.row.tag for row in result.rows):
        columns["row"] = [row.row.tag or MISSING for row in result.rows]
    for split in result.experiment.splits:
        suffix = "" if len(result.experiment.splits) == 1 else f", {split.replace('_', '-')}"
        summaries = [row.success(split) for row in result.rows]
        columns[f"success{suffix}"] = [_cell(summary) for summary in summaries]
        columns[f"95 %{suffix}"] = [_interval(summary) for summary in summaries]
        columns[f"n{suffix}"] = [str(row[f"n_{split}"] or MISSING) for row in rows]
        for name in APART:
            columns[f"{name.replace('_', ' ')}{suffix}"] = [_number(row[f"{name}_{split}"], 0) for row in rows]
    columns["seeds"] = [f"{row['seeds']}/{row['seeds_wanted']}" for row in rows]
    if any(row["paper_mean"] is not None for row in rows):
        columns["paper"] = [f"{row['paper_mean']:.3f} ± {row['paper_std']:.3f}" for row in rows]
    columns["base"] = [_number(row["base_success_mean"], 3) for row in rows]
    columns["interventions"] = [_number(row["interventions_mean"], 0) for row in rows]
    columns["D / steps"] = [_cell(row.gap("interaction_steps")) for row in result.rows]
    columns["C / interventions"] = [_cell(row.gap("interventions")) for row in result.rows]
    shared = rows[0]["shared_budget"] if rows else None
    if shared:
        title = f"C up to {shared:,}"
        columns[title] = [_cell(row.gap("interventions", up_to=shared)) for row in result.rows]
    return columns


def _difference_columns(found: Sequence[RowDifference]) -> Columns:
    if not found:
        return {}
    ps = [one.difference.p for one in found]
    adjusted = holm([1.0 if p is None else p for p in ps])
    return {
        "": [one.row.row.label for one in found],
        "reference": [one.reference.row.label for one in found],
        "difference": [f"{one.difference.value:+.3f}" for one in found],
        "95 %": [_signed_interval(one.difference.ci95) for one in found],
        "p": [MISSING if p is None else f"{p:.2g}" for p in ps],
        "p (Holm)": [f"{p:.2g}" for p in adjusted],
        "of": ["trainings" if one.of_trainings else "these policies" for one in found],
        "verdict": [_verdict(one.difference.value, p) for one, p in zip(found, adjusted, strict=True)],
    }


def _signed_interval(ends: tuple[float, float] | None) -> str:
    return MISSING if ends is None else f"[{ends[0]:+.3f}, {ends[1]:+.3f}]"


def _verdict(difference: float, p: float) -> str:
    if p >= ALPHA:
        return "not separated"
    return "better" if difference > 0 else "worse"


def _budget_columns(result: ExperimentResult) -> Columns:
    rows = [row for row in result.rows if row.finished]
    if not rows:
        return {}
    columns: Columns = {"": [row.row.label for row in rows]}
    return columns | {f"{n:,}": [_at(row.success_at(n)) for row in rows] for n in tables.budgets(result)}


def _at(found: AtBudget) -> str:
    return NOT_APPLICABLE if found.reason else "~" * bool(found.between and found.summary) + _cell(found.summary)


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


def _claim_columns(claims: list[dict[str, Any]]) -> Columns:
    if not claims:
        return {}
    digits = [2 if claim["paper"] < 1 else 0 for claim in claims]
    return {
        "": [claim["claim"] for claim in claims],
        "paper": [_number(claim["paper"], n) for claim, n in zip(claims, digits, strict=True)],
        "here": [_ours(claim, n) for claim, n in zip(claims, digits, strict=True)],
    }


def _ours(claim: dict[str, Any], digits: int) -> str:
    if claim["not_applicable"]:
        return f"{NOT_APPLICABLE}: {claim['not_applicable']}"
    return "~" * claim["interpolated"] + _number(claim["ours"], digits)


def _sequential_columns(rows: list[dict[str, Any]]) -> Columns:
    if not rows:
        return {}
    columns: Columns = {"": [row["row"] for row in rows], "split": [row["split"] for row in rows]}
    columns["orderings"] = [row["orderings"] for row in rows]
    measures = [key.removesuffix("_mean") for key in rows[0] if key.endswith("_mean")]
    for measure in measures:
        columns[measure.replace("_", " ")] = [
            _plus_minus(row[f"{measure}_mean"], row[f"{measure}_std"]) for row in rows
        ]
    columns["chains"] = [str(row["n"]) for row in rows]
    columns["found complete"] = [str(row["found_complete"]) for row in rows]
    columns["never grasped"] = [str(row["never_grasped"]) for row in rows]
    columns["seeds"] = [str(row["seeds"]) for row in rows]
    return columns


def _segment_columns(result: ExperimentResult) -> Columns:
    rates = {(row["row"], row["segment"]): row["success"] for row in tables.segment_rows(result)}
    if not rates:
        return {}
    rows = [row for row in result.rows if row.seeds]
    columns: Columns = {"": [row.row.label for row in rows]}
    for segment in sorted({segment for _, segment in rates}):
        columns[str(segment + 1)] = [_number(rates.get((row.row.name, segment)), 2) for row in rows]
    return columns


def _quarter_columns(result: ExperimentResult) -> Columns:
    rates: dict[tuple[str, bool], dict[int, Rate]] = {}
    for row in tables.task_rows(result):
        quarters = rates.setdefault((row["row"], row["is_reset_task"]), {})
        quarters[row["quarter"]] = quarters.get(row["quarter"], Rate(0, 0)) + Rate(row["successes"], row["n"])
    if not rates:
        return {}
    labels = {row.row.name: row.row.label for row in result.rows}
    columns: Columns = {"": [labels[name] + ", reset tasks" * is_reset for name, is_reset in rates]}
    for quarter in sorted({quarter for quarters in rates.values() for quarter in quarters}):
        found = [quarters.get(quarter) for quarters in rates.values()]
        columns[str(quarter)] = [_number(rate.value if rate else None, 2) for rate in found]
    return columns


def _unfinished(result: ExperimentResult) -> list[str]:
    lines = []
    for row in result.rows:
        for seed in row.seeds:
            if not seed.finished:
                lines.append(
                    f"- {seed.spec.name}: {seed.run.last['interaction_steps']:,} of {seed.spec.steps:,} steps"
                    f" ({seed.status or 'no note of its start'})"
                )
        missing = row.wanted - len(row.seeds)
        if missing:
            lines.append(f"- {_group(result, row)}: {missing} of {row.wanted} seeds not begun")
    if lines:
        lines = [
            "",
            "## Not finished",
            "",
            "Unfinished runs are drawn only where a row has no finished one.",
            "",
            *lines,
        ]
    if result.changed:
        lines += ["", "## Left out: made by another command or version, or damaged", ""]
        lines += [f"- {text}" for text in result.changed]
    if result.commits:
        lines += ["", f"## Made at another commit than {this_commit() or 'this one'}", ""]
        lines += ["The versions are the same, so they count.", "", *(f"- {text}" for text in result.commits)]
    return lines


def _group(result: ExperimentResult, row: RowResult) -> str:
    return row.seeds[0].spec.group if row.seeds else row.row.name


def _section(title: str, columns: Columns) -> list[str]:
    return ["", f"## {title}", "", *_table(columns)] if columns else []


def _table(columns: Columns) -> list[str]:
    titles = list(columns)
    lines = [titles, ["---"] * len(titles), *(list(cells) for cells in zip(*columns.values(), strict=True))]
    return [f"| {' | '.join(line)} |" for line in lines]


def _cell(summary: Summary | None) -> str:
    return str(summary) if summary else MISSING


def _plus_minus(mean: float | None, std: float | None) -> str:
    return MISSING if mean is None else f"{mean:.3f}" if std is None else f"{mean:.3f} ± {std:.3f}"


def _interval(summary: Summary | None) -> str:
    return f"[{summary.ci95[0]:.3f}, {summary.ci95[1]:.3f}]" if summary and summary.ci95 else MISSING


def _number(value: float | None, digits: int) -> str:
    return MISSING if value is None else f"{value:,.{digits}f}"
