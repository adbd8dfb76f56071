"""The tables of a report: what its page shows, and the CSV files beside it."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cronos_lerobot.protocol.metrics import Summary, performance_gap, success_at, summarise, summarise_rates
from cronos_lerobot.report.comparisons import Comparison, titled
from cronos_lerobot.report.lerobot_evaluations import EvaluationRun
from cronos_lerobot.report.runs import Group, TrainingRun, agent_metrics, evaluation_rates
from cronos_lerobot.report.statistics import Gain, Rate

Row = dict[str, Any]
ALL = "all tasks"
APART = ("found_complete", "never_grasped")
"""Of the successes, those for which nothing had to be done, and others without a grasp."""


def rate_columns(rate: Rate, prefix: str = "") -> Row:
    """Columns of a success rate: successes, n, rate and the ends of its 95 % interval."""
    low, high = rate.interval
    columns = {"successes": rate.successes, "n": rate.n, "success": rate.value, "ci95_low": low, "ci95_high": high}
    return {prefix + name: value for name, value in columns.items()}


def gain_rows(comparisons: Iterable[Comparison]) -> list[Row]:
    """Before, after and gain, one row for all tasks and one for each."""
    rows = []
    for comparison in comparisons:
        for task, gain in {ALL: comparison.overall, **comparison.tasks}.items():
            rows.append({"runs": comparison.label, "suite": comparison.suite, "task": task} | _gain_columns(gain))
    return rows


def _gain_columns(gain: Gain) -> Row:
    low, high = gain.interval
    ends = {"gain": gain.value, "gain_ci95_low": low, "gain_ci95_high": high}
    rates = rate_columns(gain.before, "before_") | rate_columns(gain.after, "after_")
    # Of lerobot-eval there are folders and no seeds.
    return rates | {"seeds": len(getattr(gain.after, "seeds", ())) or None} | ends


def seed_rows(groups: Iterable[Group]) -> list[Row]:
    """What the seeds of each group came to, up to the last step that all of them have reached.

    Success, interventions, and the areas D and C divided by the lengths of their axes, of evaluations made alike:
    without areas where those do not begin with the run.
    """
    rows = []
    for group in groups:
        runs = [run for run in group.runs if len(run.alike) > 1]
        curves = [run.alike for run in runs]
        if not curves:
            continue
        end = min(curve[-1]["interaction_steps"] for curve in curves)
        steps = [[e["interaction_steps"] for e in curve] for curve in curves]
        success = [[e["success"] for e in curve] for curve in curves]
        spent = [[e["interventions"] for e in curve] for curve in curves]
        at_end = [success_at(x, y, end) for x, y in zip(steps, spent, strict=True)]
        by_steps = [performance_gap(x, y, end).normalised for x, y in zip(steps, success, strict=True)]
        by_resets = [
            performance_gap(x, y, up_to).normalised for x, y, up_to in zip(spent, success, at_end, strict=True)
        ]
        row: Row = {"runs": group.label, "seeds": len(curves), "split": curves[0][-1]["split"]}
        row |= {"n": curves[0][-1]["n"], "interaction_steps": end}
        rates = [success_at(x, y, end) for x, y in zip(steps, success, strict=True)]
        row |= _summary_columns("success", summarise_rates(rates))
        last = [curve[-1] for curve in curves]
        are_there = all(e["interaction_steps"] == end for e in last)
        row |= {name: sum(e.get(name, 0) for e in last) if are_there else None for name in APART}
        row |= _summary_columns("interventions", summarise(at_end))
        are_whole = all(run.begins_alike for run in runs)
        row |= _summary_columns("D / steps", summarise_rates(by_steps) if are_whole else None)
        row |= _summary_columns("C / interventions", summarise_rates(by_resets) if are_whole else None)
        rows.append(row)
    return rows


def _summary_columns(name: str, summary: Summary | None) -> Row:
    if summary is None:
        return {name: None, f"{name} std": None, f"{name} ci95_low": None, f"{name} ci95_high": None}
    low, high = summary.ci95 or (None, None)
    return {name: summary.mean, f"{name} std": summary.std, f"{name} ci95_low": low, f"{name} ci95_high": high}


def lerobot_eval_rows(runs: Iterable[EvaluationRun]) -> list[Row]:
    """Success of every `lerobot-eval` folder, for all tasks and for each."""
    return [
        {"folder": run.name, "suite": run.suite, "task": task} | rate_columns(rate)
        for run in runs
        for task, rate in {ALL: run.overall, **run.tasks}.items()
    ]


def evaluation_rows(groups: Iterable[Group]) -> list[Row]:
    """The periodic evaluations of the training runs."""
    rows = []
    for group in groups:
        for run in group.runs:
            for evaluation in run.evaluations:
                counters = {name: evaluation[name] for name in ("interaction_steps", "interventions", "split")}
                counters["temperature"] = evaluation.get("temperature")
                rates = evaluation_rates(evaluation)
                overall = Rate(round(evaluation["success"] * evaluation["n"]), evaluation["n"])
                for task, rate in {ALL: overall, **rates}.items():
                    found = evaluation if task == ALL else evaluation["per_task"][task]
                    apart = {name: found.get(name) for name in APART}
                    rows.append(_identity(group, run) | counters | {"task": task} | rate_columns(rate) | apart)
    return rows


def update_rows(groups: Iterable[Group]) -> list[Row]:
    """Every policy update: training success, the agent's diagnostics, speed."""
    rows = []
    for group in groups:
        for run in group.runs:
            for update in run.updates:
                rollout = update["rollout"]
                row = _identity(group, run) | {
                    name: update[name] for name in ("interaction_steps", "interventions", "updates")
                }
                row |= {name: rollout[name] for name in ("success", "segments", "reward_per_segment", "diverged")}
                row |= {name: (rollout.get(name) or [None])[0] for name in APART}
                row |= {f"agent/{name}": value for name, value in agent_metrics(update).items()}
                row |= {"steps_per_s": update["steps_per_s"]}
                rows.append(row | {f"time/{name}": value for name, value in update["time_share"].items()})
    return rows


def segment_rows(groups: Iterable[Group]) -> list[Row]:
    """Training success by segment since the last scene reset (0 is the first), for every update."""
    rows = []
    for group in groups:
        for run in group.runs:
            for update in run.updates:
                for position, (successes, n) in update["rollout"]["success_by_segment"].items():
                    counters = {"interaction_steps": update["interaction_steps"], "segment": int(position)}
                    rows.append(_identity(group, run) | counters | rate_columns(Rate(successes, n)))
    return rows


def intervention_rows(groups: Iterable[Group]) -> list[Row]:
    """Interventions of every run, in all, of single streams, and by kind."""
    rows = []
    for group in groups:
        for run in group.runs:
            last = run.last
            counters = {name: last[name] for name in ("interaction_steps", "interventions")}
            # Records of older runs do not have them.
            streams = last.get("interventions_by_stream") or []
            extremes = {"fewest of a stream": min(streams), "most of a stream": max(streams)} if streams else {}
            by_kind = dict(last["interventions_by_kind"])
            if by_kind.get("takeover"):
                by_kind["takeover price"] = run.config["protocol"]["takeover_price"]
            rows.append(_identity(group, run) | counters | extremes | by_kind)
    return rows


def reset_rows(groups: Iterable[Group]) -> list[Row]:
    """How runs whose values asked for scene resets spent them: by segments since the stream's last one."""
    rows = []
    for group in groups:
        for run in group.runs:
            resets = [reset for update in run.updates for reset in update.get("critic", {}).get("resets", [])]
            for segments in sorted({reset["segments"] for reset in resets}):
                values = [reset["value"] for reset in resets if reset["segments"] == segments]
                row = {"segments": segments, "resets": len(values), "mean best value": sum(values) / len(values)}
                rows.append(_identity(group, run) | row)
    return rows


def speed_rows(groups: Iterable[Group]) -> list[Row]:
    """Steps per second of every run and where its time went, evaluations and checkpoints left out."""
    rows = []
    for group in groups:
        for run in group.runs:
            if not run.updates:
                continue
            steps = [
                now["interaction_steps"] - before
                for before, now in zip(
                    [0, *(update["interaction_steps"] for update in run.updates)], run.updates, strict=False
                )
            ]
            seconds = [n / update["steps_per_s"] for n, update in zip(steps, run.updates, strict=True)]
            shares: Row = {}
            for spent, update in zip(seconds, run.updates, strict=True):
                for name, share in update["time_share"].items():
                    shares[name] = shares.get(name, 0.0) + share * spent / sum(seconds)
            rate = {"steps_per_s": sum(steps) / sum(seconds), "minutes": sum(seconds) / 60}
            rows.append(_identity(group, run) | rate | {f"{name} share": share for name, share in shares.items()})
    return rows


def _identity(group: Group, run: TrainingRun) -> Row:
    return {"runs": group.label, "run": run.name, "seed": run.seed}


def merge_statistics(rows: list[Row]) -> list[Row]:
    """For reading: a number, its `std` and its `ci95_low` and `ci95_high` in one cell instead of four."""
    merged = []
    for row in rows:
        cells: Row = {}
        for name, value in row.items():
            if name.endswith((" std", " ci95_low", " ci95_high")):
                continue
            std, low, high = (row.get(f"{name} {part}") for part in ("std", "ci95_low", "ci95_high"))
            if isinstance(value, float) and (std, low) != (None, None):
                text = f"{value:.4g}" + (f" ± {std:.2g}" if std is not None else "")
                value = text + (f" [{low:.4g}, {high:.4g}]" if low is not None and high is not None else "")
            cells[name] = value
        merged.append(cells)
    return merged


def column_names(rows: list[Row]) -> list[str]:
    """The columns of rows that may have different ones, in the order in which they appear."""
    return list(dict.fromkeys(name for row in rows for name in row))


def write_csv(path: Path, rows: list[Row]) -> None:
    """Write rows that may have different columns; a missing value is an empty cell."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, column_names(rows), restval="")
        writer.writeheader()
        writer.writerows(rows)


def comparison_text(comparisons: Iterable[Comparison]) -> str:
    """The before/after table for a terminal, all tasks and each, with n, 95 % intervals and the gain."""
    header = ("", "before", "after", "gain")
    lines: list[tuple[str, ...]] = [header]
    for title, comparison in titled(comparisons):
        lines.append((title, "", "", ""))
        for task, gain in {ALL: comparison.overall, **comparison.tasks}.items():
            lines.append((f"  {task}", str(gain.before), str(gain.after), str(gain)))
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )
