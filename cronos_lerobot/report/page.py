"""Writes a report: one self-contained HTML page, with its figures and tables as files beside it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
from matplotlib.figure import Figure

from cronos_lerobot.report import clips, figures, suite_views, tables
from cronos_lerobot.report.comparisons import Comparison, compare_evaluations, compare_training, titled
from cronos_lerobot.report.lerobot_evaluations import EvaluationRun
from cronos_lerobot.report.png import to_png
from cronos_lerobot.report.runs import Group, TrainingRun, group_runs
from cronos_lerobot.report.suites import SuiteRun

PAGE = "index.html"
DPI = 150
SEQUENTIAL = "sequential.png"

FIGURES: tuple[tuple[str, str, str, Callable[[list[Group]], Figure | None]], ...] = (
    (
        "evaluation",
        "Evaluation during training",
        "Every task from benchmark configurations, on environments of the evaluation's own. Left against the"
        " experience gathered, right against the interventions it took (scene resets and the like; the arm going"
        " home is free).",
        figures.evaluation_figure,
    ),
    (
        "training",
        "Success while training",
        "Share of the segments between two policy updates whose task was complete at any step.",
        figures.training_figure,
    ),
    (
        "segments",
        "How success decays between scene resets",
        "Training segments by their number since the stream's last scene reset, in the last quarter of the run.",
        figures.segments_figure,
    ),
    (
        "segment_history",
        "The same, over the run",
        "Bright is success. Rows further up are longer without a reset; time runs to the right.",
        figures.segment_history_figure,
    ),
    ("agent", "Agent's diagnostics", "One point for each policy update.", figures.agent_figure),
)


@dataclass(frozen=True)
class Report:
    """What a report is drawn from."""

    training: list[TrainingRun]
    evaluations: list[EvaluationRun]
    """Those of `lerobot-eval` that are neither before nor after."""
    before: list[EvaluationRun]
    after: list[EvaluationRun]
    videos: list[Path]
    title: str
    suites: list[SuiteRun] = field(default_factory=list)
    """Those of `cronos-eval`."""
    left_out: list[str] = field(default_factory=list)
    """What could not be read or is not shown, a sentence for each."""

    @property
    def comparisons(self) -> list[Comparison]:
        """`lerobot-eval` before and after first, then the trainings' own evaluations."""
        return compare_evaluations(self.before, self.after) + compare_training(group_runs(self.training))


def write_report(report: Report, output: Path) -> Path:
    """Write the page, figures and tables into `output`; returns the page's path."""
    output.mkdir(parents=True, exist_ok=True)
    groups = group_runs(report.training)
    all_evaluations = report.before + report.after + report.evaluations
    rows = {
        "gains": tables.gain_rows(report.comparisons),
        "seeds": tables.seed_rows(groups),
        "independent": suite_views.independent_rows(report.suites),
        "sequential": suite_views.sequential_rows(report.suites),
        "lerobot_eval": tables.lerobot_eval_rows(all_evaluations),
        "evaluations": tables.evaluation_rows(groups),
        "updates": tables.update_rows(groups),
        "segments": tables.segment_rows(groups),
        "interventions": tables.intervention_rows(groups),
        "resets": tables.reset_rows(groups),
        "speed": tables.speed_rows(groups),
    }
    # What another report left there is not of this one.
    for file in (*(f"{name}.csv" for name in rows), *(f"{name}.png" for name, *_ in FIGURES), SEQUENTIAL):
        (output / file).unlink(missing_ok=True)
    for name, table in rows.items():
        if table:
            tables.write_csv(output / f"{name}.csv", table)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("cronos_lerobot.report", "."), autoescape=True, trim_blocks=True
    )
    environment.filters |= {
        "cell": _cell,
        "titled": titled,
        "percent": lambda x: f"{100 * x:.1f}",
        "merged": tables.merge_statistics,
        "columns": tables.column_names,
    }
    page = environment.get_template("page.html.j2").render(
        title=report.title,
        time=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        comparisons=report.comparisons,
        figures=_draw_figures(groups, output),
        suite_figures=_draw_suites(report.suites, output),
        tables={name: table for name, table in rows.items() if table},
        clip_rows=_clip_rows(report, output),
        manifests=[(run.name, json.dumps(run.starts, indent=2)) for run in report.training if run.starts],
        runs=[(group, run) for group in groups for run in group.runs],
        left_out=report.left_out,
        headline=_headline(report.comparisons),
    )
    (output / PAGE).write_text(page)
    return output / PAGE


def _headline(comparisons: list[Comparison]) -> list[Comparison]:
    """The comparisons that open the page: those of `lerobot-eval` if there are any."""
    measured = [comparison for comparison in comparisons if comparison.label == "lerobot-eval"]
    return measured or comparisons[:4]


def _draw_figures(groups: list[Group], output: Path) -> list[dict[str, str]]:
    drawn = []
    for name, title, caption, draw in FIGURES if groups else ():
        figure = draw(groups)
        if figure is None:
            continue
        drawn.append({"title": title, "caption": caption, "url": _write_png(figure, output / f"{name}.png")})
    return drawn


def _draw_suites(suites: list[SuiteRun], output: Path) -> list[str]:
    figure = suite_views.sequential_figure(suites)
    return [] if figure is None else [_write_png(figure, output / SEQUENTIAL)]


def _write_png(figure: Figure, path: Path) -> str:
    """Write a figure; returns it as a data URL."""
    png = to_png(figure, DPI)
    path.write_bytes(png)
    return clips.data_url(png, "image/png")


def _clip_rows(report: Report, output: Path) -> list[list[dict[str, Any]]]:
    """Rows of videos, each with a data URL, or with the path of the file if it is too large."""
    singles = clips.file_clips(report.videos) + clips.evaluation_clips(report.evaluations)
    singles += suite_views.suite_clips(report.suites)
    pairs = clips.comparison_clips(report.before, report.after)
    rows = [*((clip,) for clip in singles), *pairs]
    embedder = clips.Embedder()
    return [[_embed(clip, embedder, output) for clip in row] for row in rows]


def _embed(clip: clips.Clip, embedder: clips.Embedder, output: Path) -> dict[str, Any]:
    url = embedder.video(clip.path)
    link = clip.path.resolve().relative_to(output.resolve(), walk_up=True).as_posix()
    return {"title": clip.title, "caption": clip.caption, "url": url, "link": quote(link)}


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)
