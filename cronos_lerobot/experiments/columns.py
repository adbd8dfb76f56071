"""What the pages of an experiment show in their tables: text, column by column."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cronos_lerobot.experiments import tables
from cronos_lerobot.experiments.differences import Gain, RowDifference
from cronos_lerobot.experiments.orders import NOT_APPLICABLE, Order
from cronos_lerobot.experiments.results import APART, AtBudget, ExperimentResult, RowResult
from cronos_lerobot.protocol.metrics import Summary
from cronos_lerobot.report.paired import ALPHA, holm
from cronos_lerobot.report.series import segment_rates, segment_spans
from cronos_lerobot.report.statistics import Rate

MISSING = "–"
WORDS = {"higher": "above", "lower": "below", "alike": "like"}
"""For what the paper says of a row beside another."""

Columns = dict[str, list[str]]


def main_columns(result: ExperimentResult) -> Columns:
    """Settings, success at the end, interventions, D and C of every row."""
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
        suffix = "" if result.experiment.splits == ("train",) else f", {split.replace('_', '-')}"
        summaries = [row.success(split) for row in result.rows]
        columns[f"success{suffix}"] = [_cell(summary) for summary in summaries]
        columns[f"95 %{suffix}"] = [_interval(summary) for summary in summaries]
        if any(row[f"seeds_{split}"] not in (0, row["seeds"]) for row in rows):
            columns[f"seeds{suffix}" if suffix else "evaluated"] = [
                f"{row[f'seeds_{split}']}/{row['seeds']}" for row in rows
            ]
        columns[f"n{suffix}"] = [str(row[f"n_{split}"] or MISSING) for row in rows]
        for name in APART:
            columns[f"{name.replace('_', ' ')}{suffix}"] = [_number(row[f"{name}_{split}"], 0) for row in rows]
    columns["seeds"] = [f"{row['seeds']}/{row['seeds_wanted']}" for row in rows]
    if any(row["paper_mean"] is not None for row in rows):
        columns["paper"] = [f"{row['paper_mean']:.3f} ± {row['paper_std']:.3f}" for row in rows]
    # The curve and its areas are of the training configurations, whatever the experiment is about.
    trained = "" if "train" in result.experiment.splits else ", train"
    columns[f"base{trained}"] = [_number(row["base_success_mean"], 3) for row in rows]
    columns["interventions"] = [_number(row["interventions_mean"], 0) for row in rows]
    if any(row.takeovers[0] for row in result.rows):
        columns["takeovers"] = [_takeovers(row) for row in result.rows]
    columns[f"D / steps{trained}"] = [_cell(row.gap("interaction_steps")) for row in result.rows]
    columns[f"C / interventions{trained}"] = [_cell(row.gap("interventions")) for row in result.rows]
    shared = rows[0]["shared_budget"] if rows else None
    if shared:
        title = f"C up to {shared:,}"
        columns[title] = [_cell(row.gap("interventions", up_to=shared)) for row in result.rows]
    return columns


def _takeovers(row: RowResult) -> str:
    """How many of the interventions, and what each counts (spec: a table with takeovers names the price)."""
    count, price = row.takeovers
    return f"{count:,.0f} at {price} each" if count else MISSING


def gain_columns(found: Sequence[Gain]) -> Columns:
    """Success before and after, the gain with its interval, its p and a word."""
    if not found:
        return {}
    return {
        "": [one.row.row.label for one in found],
        "before": [_number(one.before, 3) for one in found],
        "at the end": [_number(one.after, 3) for one in found],
        "seeds": [str(one.seeds) for one in found],
    } | _decided("gain", found)


def difference_columns(found: Sequence[RowDifference]) -> Columns:
    """Each difference with its interval, its p and a word."""
    if not found:
        return {}
    rows = {"": [one.row.row.label for one in found], "reference": [one.reference.row.label for one in found]}
    return rows | _decided("difference", found)


def _decided(title: str, found: Sequence[RowDifference | Gain]) -> Columns:
    ps = [one.difference.p for one in found]
    # Where nothing varies, as between trainings that all succeed at everything, there is no p.
    known = iter(holm([p for p in ps if p is not None]))
    adjusted = [None if p is None else next(known) for p in ps]
    return {
        title: [f"{one.difference.value:+.3f}" for one in found],
        "95 %": [_signed_interval(one.difference.ci95) for one in found],
        "p": [MISSING if p is None else f"{p:.2g}" for p in ps],
        "p (Holm)": [MISSING if p is None else f"{p:.2g}" for p in adjusted],
        "of": [_of(one) for one in found],
        "verdict": [_verdict(one.difference.value, p) for one, p in zip(found, adjusted, strict=True)],
    }


def _signed_interval(ends: tuple[float, float] | None) -> str:
    return MISSING if ends is None else f"[{ends[0]:+.3f}, {ends[1]:+.3f}]"


def _verdict(difference: float, p: float | None) -> str:
    if p is None:
        return MISSING
    if p >= ALPHA:
        return "not separated"
    return "better" if difference > 0 else "worse"


def budget_columns(result: ExperimentResult) -> Columns:
    """Success of the finished rows after so many interventions."""
    rows = [row for row in result.rows if row.finished]
    if not rows:
        return {}
    columns: Columns = {"": [row.row.label for row in rows]}
    return columns | {f"{n:,}": [_at(row.success_at(n)) for row in rows] for n in tables.budgets(result)}


def _at(found: AtBudget) -> str:
    return NOT_APPLICABLE if found.reason else "~" * bool(found.between and found.summary) + _cell(found.summary)


def claim_columns(claims: list[dict[str, Any]]) -> Columns:
    """Numbers in the paper's text beside ours."""
    if not claims:
        return {}
    digits = [2 if claim["paper"] < 1 else 0 for claim in claims]
    return {
        "": [claim["claim"] for claim in claims],
        "paper": [_number(claim["paper"], n) for claim, n in zip(claims, digits, strict=True)],
        "here": [_ours(claim, n) for claim, n in zip(claims, digits, strict=True)],
    }


def order_columns(orders: Sequence[Order]) -> Columns:
    """What the paper says of two rows, the difference here, and whether it holds."""
    found = [one.found for one in orders]
    return {
        "": [f"{one.row} is {WORDS[one.says]} {one.reference}" for one in orders],
        "paper": [one.where for one in orders],
        "suite": [f"{one.suite}, {one.split.replace('_', '-')}" for one in orders],
        "difference": [f"{one.found.difference.value:+.3f}{one.unit}" if one.found else MISSING for one in orders],
        "95 %": [_signed_interval(one.difference.ci95) if one else MISSING for one in found],
        "of": [_of(one) if one else MISSING for one in found],
        "holds": [one.holds + f": {one.reason}" * bool(one.reason) for one in orders],
    }


def _of(found: RowDifference | Gain) -> str:
    return "trainings" if found.of_trainings else "these policies"


def _ours(claim: dict[str, Any], digits: int) -> str:
    if claim["not_applicable"]:
        return f"{NOT_APPLICABLE}: {claim['not_applicable']}"
    return "~" * claim["interpolated"] + _number(claim["ours"], digits)


def sequential_columns(result: ExperimentResult, rows: list[dict[str, Any]]) -> Columns:
    """SEQ 0-3 and chain length, by split and orderings."""
    labels = {row.row.name: row.row.label for row in result.rows}
    if not rows:
        return {}
    columns: Columns = {"": [labels[row["row"]] for row in rows], "split": [row["split"] for row in rows]}
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


def segment_columns(result: ExperimentResult) -> Columns:
    """Success while training, by segment since the last scene reset."""
    rows = [row for row in result.rows if row.seeds]
    spans = [segment_spans(segment_rates(row.group)) for row in rows]
    if not any(spans):
        return {}
    columns: Columns = {"": [row.row.label for row in rows]}
    for first, last in sorted({span for some in spans for span in some}):
        rates = [some.get((first, last)) for some in spans]
        title = str(first) if first == last else f"{first} to {last}"
        columns[title] = [_number(rate.value if rate else None, 2) for rate in rates]
    return columns


def quarter_columns(result: ExperimentResult) -> Columns:
    """Success while training, by quarter of the run, reset tasks apart."""
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


def _cell(summary: Summary | None) -> str:
    return str(summary) if summary else MISSING


def _plus_minus(mean: float | None, std: float | None) -> str:
    return MISSING if mean is None else f"{mean:.3f}" if std is None else f"{mean:.3f} ± {std:.3f}"


def _interval(summary: Summary | None) -> str:
    return f"[{summary.ci95[0]:.3f}, {summary.ci95[1]:.3f}]" if summary and summary.ci95 else MISSING


def _number(value: float | None, digits: int) -> str:
    return MISSING if value is None else f"{value:,.{digits}f}"
