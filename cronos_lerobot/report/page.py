"""Writes a report: one self-contained HTML page, with its figures and tables as files beside it."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from cronos_lerobot.film.sheets import to_png
from cronos_lerobot.report import figures, tables
from cronos_lerobot.report.load import CRONOS_EVAL, TRAIN, Loaded, Video

PAGE = "index.html"
DPI = 150
MAX_VIDEO_BYTES = 3_000_000
"""A larger video stays a file beside the page."""
MAX_TOTAL_BYTES = 30_000_000
"""Of all embedded videos."""
CAPTIONS = {
    "evaluation": (
        "Evaluation during training",
        "Success of single tasks against the experience gathered (left) and against the interventions it took"
        " (right): scene resets and the like. The arm going home is free.",
    ),
    "training": (
        "Success while training",
        "Share of the segments between two policy updates whose task was complete at any step.",
    ),
    "segments": (
        "How success decays between scene resets",
        "Training segments by their number since the stream's last scene reset, in the last quarter of the run.",
    ),
    "sequential": ("Sequential suite", "Share of chains whose first k tasks all succeeded, with 95 % intervals."),
    "stream": ("Stream suite", "Success by segment of a stream that is never reset, with 95 % intervals."),
}
"""Title and caption of each figure."""
SHOWN = ("gains", "seeds", "independent", "stream", "interventions")
NAMES = (*SHOWN, "sequential", "evaluations", "updates", "segments")
"""Of the tables: those that the page shows, and all that have a CSV file."""


@dataclass
class Report:
    """What a report shows."""

    loaded: Loaded
    before: Loaded = field(default_factory=Loaded)
    """Of the policy that a training began with."""
    after: Loaded = field(default_factory=Loaded)
    """Of the policy that came out."""
    videos: Sequence[Path] = ()
    """More to show."""
    title: str = "CRONOS report"

    @property
    def folders(self) -> tuple[Loaded, Loaded, Loaded]:
        """What was read."""
        return self.loaded, self.before, self.after

    @property
    def left_out(self) -> list[str]:
        """A sentence for each thing that could not be read or is not shown."""
        return list(dict.fromkeys(text for one in self.folders for text in one.left_out))

    @cached_property
    def gains(self) -> pd.DataFrame:
        """Success before and after, by task."""
        return tables.gain_table(*(one.evaluations for one in self.folders))


def make_tables(report: Report) -> dict[str, pd.DataFrame]:
    """All tables of a report by name, without the empty ones."""
    loaded = report.loaded
    own = loaded.evaluations

    def of(suite: str, **options: bool) -> pd.DataFrame:
        some = own[(own["source"] == CRONOS_EVAL) & (own["suite"] == suite)]
        return tables.part_table(some, ["policy", "split"], **options)

    trained = own[own["source"] == TRAIN]
    made = {
        "gains": report.gains,
        "seeds": tables.seed_table(own),
        "independent": of("independent"),
        "sequential": of("sequential", with_all=False),
        "stream": of("stream"),
        "evaluations": tables.part_table(trained, ["row", "run", "seed", "steps", "interventions", "split"]),
        "updates": loaded.updates,
        "segments": loaded.segments,
        "interventions": loaded.interventions,
    }
    return {name: table for name, table in made.items() if len(table)}


def draw_figures(loaded: Loaded) -> dict[str, Figure]:
    """All figures of a report by name, without the empty ones."""
    drawn = {
        "evaluation": figures.evaluation_figure(loaded.evaluations),
        "training": figures.training_figure(loaded.updates),
        "segments": figures.segments_figure(loaded.segments),
    }
    drawn |= {suite: figures.part_figure(loaded.evaluations, suite) for suite in ("sequential", "stream")}
    return {name: figure for name, figure in drawn.items() if figure is not None}


def write_report(report: Report, output: Path) -> Path:
    """Write the page, figures and tables into `output`; returns the page's path."""
    output.mkdir(parents=True, exist_ok=True)
    # What another report left there is not of this one.
    for file in (*(f"{name}.csv" for name in NAMES), *(f"{name}.png" for name in CAPTIONS)):
        (output / file).unlink(missing_ok=True)
    made = make_tables(report)
    for name, table in made.items():
        table.to_csv(output / f"{name}.csv", index=False)
    drawn = {name: to_png(figure, DPI) for name, figure in draw_figures(report.loaded).items()}
    for name, png in drawn.items():
        (output / f"{name}.png").write_bytes(png)
    shown = {name: to_html(tables.merged(made[name])) for name in SHOWN if name in made}
    if "sequential" in made:
        shown["sequential"] = to_html(tables.chain_table(made["sequential"]))
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("cronos_lerobot.report", "."), autoescape=True, trim_blocks=True
    )
    page = environment.get_template("page.html.j2").render(
        title=report.title,
        time=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        cards=_cards(made.get("gains")),
        figures=[(*CAPTIONS[name], data_url(png, "image/png")) for name, png in drawn.items()],
        tables=shown,
        videos=list(_embedded(report, output)),
        manifests=[(run.name, json.dumps(run.starts, indent=2)) for run in report.loaded.runs],
        left_out=report.left_out,
    )
    (output / PAGE).write_text(page)
    return output / PAGE


def _cards(gains: pd.DataFrame | None) -> list[dict[str, Any]]:
    """The gains of all tasks that open the page: those of --after if there are any."""
    if gains is None:
        return []
    overall = gains[gains["task"] == tables.ALL]
    measured = overall[overall["runs"] == "--after"]
    return (measured if len(measured) else overall[:4]).to_dict("records")


def to_html(table: pd.DataFrame) -> Markup:
    """A table as HTML. All its text is escaped."""
    shown = table.convert_dtypes().astype(object).map(_cell)
    shown.columns = [str(name).replace("_", " ") for name in shown]
    return Markup(shown.to_html(index=False, border=0, escape=True))


def _cell(value: Any) -> str:
    if pd.isna(value):
        return ""
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def _embedded(report: Report, output: Path) -> list[dict[str, str | None]]:
    """The videos of a page: as data URLs, or as links if they are too large."""
    named = [Video(path, path.stem.replace("_", " "), "") for path in report.videos]
    shown, left = [], MAX_TOTAL_BYTES
    for video in (*named, *(video for one in report.folders for video in one.videos)):
        size, url = video.path.stat().st_size, None
        if size <= min(MAX_VIDEO_BYTES, left):
            left -= size
            url = data_url(video.path.read_bytes(), "video/mp4")
        link = video.path.resolve().relative_to(output.resolve(), walk_up=True).as_posix()
        shown.append({"title": video.title, "caption": video.caption, "url": url, "link": quote(link)})
    return shown


def data_url(content: bytes, mime_type: str) -> str:
    """`content` inside a URL."""
    return f"data:{mime_type};base64,{base64.b64encode(content).decode()}"
