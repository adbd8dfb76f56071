"""What policies do in streams that nobody resets, side by side: by segment, by how the bodies lay, and their cost.

    python -m cronos_lerobot.studies.stream_evaluation --policy.path=<checkpoint> --output=outputs/streams/1.csv
    python -m cronos_lerobot.studies.streams_compared --output=outputs/streams \\
        --streams "before=outputs/streams/base.csv" "T = 80=outputs/streams/1.csv,outputs/streams/2.csv" \\
        --runs "T = 80=<run of seed 1>,<run of seed 2>"

A name has the files of one or more seeds. It draws `streams.png` and writes the numbers behind it as `streams.csv`
and as tables in Markdown, `streams.md`: success by how the bodies lay, by part of the stream (the first segment,
the others of its first half, its second half), and the difference of every two names. Runs are folders of
`cronos-train`; of these the figure shows where the interventions went.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cronos_lerobot.report.figures import COLORS, INK, style_axes
from cronos_lerobot.report.png import to_png
from cronos_lerobot.report.runs import TrainingRun, read_training_run
from cronos_lerobot.report.statistics import Rate, SeedRate, newcombe_interval, sum_rates
from cronos_lerobot.report.tables import Row, write_csv
from cronos_lerobot.studies.stream_evaluation import Start

STARTS = {
    Start.FREE: ("free", "#cfe1f2"),
    Start.RECEPTACLE_OCCUPIED: ("receptacle occupied", "#93c4de"),
    Start.ON_OTHER_RECEPTACLE: ("on the other receptacle", "#4a97c9"),
    Start.LOST: ("lost", "#08306b"),
    Start.COMPLETE: ("found complete", "#d9d9d9"),
}
"""Words and colour of how a segment's bodies lay, from the easiest on."""
NAMED = "NAME=PATH[,PATH...]"


@dataclass(frozen=True)
class Streams:
    """What policies of one kind did, one for each seed, by `stream_evaluation`."""

    name: str
    seeds: tuple[dict[tuple[str, str], Rate], ...]
    """By table (segment, start) and name."""

    def rate(self, table: str, name: str) -> SeedRate | None:
        """Success of some segments, of the seeds that had any; None without any."""
        found = [seed[table, name] for seed in self.seeds if (table, name) in seed]
        return SeedRate.of(found) if found else None

    def share(self, start: Start) -> float:
        """Share of all segments that began so."""
        k, n = (
            sum(seed[key].n for seed in self.seeds if key in seed)
            for key in (("start", start.name.lower()), ("segment", "all"))
        )
        return k / n

    def done(self) -> SeedRate:
        """Success of the segments that were not found complete."""
        whole = [(seed["segment", "all"], seed.get(("start", "complete"), Rate(0, 0))) for seed in self.seeds]
        return SeedRate.of(Rate(all_.successes - found.successes, all_.n - found.n) for all_, found in whole)

    def parts(self) -> dict[str, Rate]:
        """Success by part of the stream, of all of it, and of what was not found complete."""
        rates = self.by_segment()
        half = len(rates) // 2
        parts = {
            "first segment": rates[:1],
            "others of the first half": rates[1:half],
            "second half": rates[half:],
        }
        found = {name: sum_rates(part) for name, part in (parts | {"all": rates}).items() if part}
        return found | {"all but those found complete": self.done()}

    def by_segment(self) -> list[SeedRate]:
        """Success of the first, second, ... segment since the placement."""
        length = sum(table == "segment" for table, _ in self.seeds[0]) - 1
        return [rate for i in range(length) if (rate := self.rate("segment", str(i)))]


def read_streams(name: str, paths: Sequence[Path]) -> Streams:
    """Read what `stream_evaluation --output` wrote.

    Raises:
        ValueError: a file is none of its, or they have streams of different lengths.
    """
    seeds = tuple(map(_read, paths))
    if len({sum(table == "segment" for table, _ in seed) for seed in seeds}) > 1:
        raise ValueError(f"{name}: streams of different lengths: {', '.join(map(str, paths))}")
    return Streams(name, seeds)


def _read(path: Path) -> dict[tuple[str, str], Rate]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    rates = {
        (row["table"], row["name"]): Rate(int(row["successes"]), int(row["n"]))
        for row in rows
        if {"table", "name", "successes", "n"} <= set(row)
    }
    if ("segment", "all") not in rates:
        raise ValueError(f"{path} is no file of python -m cronos_lerobot.studies.stream_evaluation --output")
    return rates


def table_rows(streams: Sequence[Streams]) -> list[Row]:
    """A line for each kind of policy and each segment or start, for a CSV file."""
    rows = []
    for one in streams:
        segments = [("segment", str(i)) for i in range(len(one.by_segment()))]
        for table, name in [*segments, ("segment", "all"), *(("start", start.name.lower()) for start in Start)]:
            if rate := one.rate(table, name):
                low, high = rate.interval
                rows.append(
                    {"policy": one.name, "table": table, "name": name, "successes": rate.successes, "n": rate.n}
                    | {"success": rate.value, "ci95_low": low, "ci95_high": high, "seeds": len(rate.seeds)}
                )
    return rows


def make_table(streams: Sequence[Streams]) -> str:
    """A table in Markdown, a line for each kind of policy: success of all, and by start with its share of them."""
    head = ["policy", "seeds", "segments", "all", *(words for words, _ in STARTS.values())]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for one in streams:
        everything = one.rate("segment", "all")
        assert everything is not None
        cells = [one.name, str(len(one.seeds)), f"{everything.n:,}", _cell(everything)]
        for start in STARTS:
            rate = one.rate("start", start.name.lower())
            share = f"{one.share(start):.0%} of them"
            cells.append(share if rate is None or start == Start.COMPLETE else f"{rate.value:.2f} ({share})")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def make_parts(streams: Sequence[Streams]) -> str:
    """A table in Markdown: success of each kind of policy by part of the stream."""
    return _parts_table([[one.name, *map(_cell, one.parts().values())] for one in streams], ["policy"], streams)


def make_differences(streams: Sequence[Streams]) -> str:
    """A table in Markdown: success of each kind of policy minus that of each one before, by part of the stream.

    Intervals are `newcombe_interval`'s, not pair by pair: seeds of two kinds have nothing in common but their
    number. A kind with one seed is taken as that one policy.
    """
    lines = []
    for before, after in combinations(streams, 2):
        pairs = zip(before.parts().values(), after.parts().values(), strict=True)
        lines.append([after.name, before.name, *(_difference(*pair) for pair in pairs)])
    return _parts_table(lines, ["policy", "minus"], streams)


def _parts_table(lines: list[list[str]], first: list[str], streams: Sequence[Streams]) -> str:
    head = [*first, *streams[0].parts()]
    return "\n".join([f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *lines)])


def _difference(before: Rate, after: Rate) -> str:
    low, high = newcombe_interval(before, after)
    return f"{after.value - before.value:+.3f} [{low:+.3f}, {high:+.3f}]"


def _cell(rate: Rate) -> str:
    return "{:.3f} [{:.3f}, {:.3f}]".format(rate.value, *rate.interval)


def draw_streams(streams: Sequence[Streams], runs: Mapping[str, Sequence[TrainingRun]]) -> Figure:
    """Success by segment, how segments began, success by how they began, and where the interventions went."""
    figure = Figure(figsize=(10, 7.2), layout="constrained")
    axes = figure.subplots(2, 2)
    _draw_segments(axes[0, 0], streams)
    _draw_shares(axes[0, 1], streams)
    _draw_starts(axes[1, 0], streams)
    if runs:
        _draw_spending(axes[1, 1], streams, runs)
    else:
        axes[1, 1].remove()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _draw_segments(ax: Axes, streams: Sequence[Streams]) -> None:
    for one, color in zip(streams, COLORS, strict=False):
        rates = one.by_segment()
        x, y = np.arange(1, len(rates) + 1), np.array([rate.value for rate in rates])
        seeds = f" ({len(one.seeds)} seeds)" if len(one.seeds) > 1 else ""
        ax.plot(x, y, "o-", ms=3.5, lw=1.5, color=color, label=one.name + seeds)
        for i in range(len(one.seeds)):
            ax.plot(x, [rate.seeds[i].value for rate in rates], lw=0.7, alpha=0.35, color=color)
    style_axes(ax, "segment since the placement, no reset")
    ax.set(ylim=(0, 1.02), ylabel="success")
    ax.set_title("how long streams go on", fontsize=9, color=INK, loc="left")


def _draw_shares(ax: Axes, streams: Sequence[Streams]) -> None:
    left = np.zeros(len(streams))
    places = np.arange(len(streams))
    for start, (words, color) in STARTS.items():
        shares = np.array([one.share(start) for one in streams])
        ax.barh(places, shares, left=left, color=color, label=words, height=0.7)
        left += shares
    style_axes(ax, "share of the segments", grid=False)
    ax.set_yticks(places, [one.name for one in streams])
    ax.set(ylim=(len(streams) - 0.4, -0.6), xlim=(0, 1))
    ax.set_title("how the bodies lay when the task was given", fontsize=9, color=INK, loc="left")
    ax.legend(
        fontsize=7,
        frameon=False,
        ncols=5,
        loc="upper center",
        bbox_to_anchor=(0.42, -0.16),
        columnspacing=1,
        handlelength=1,
    )


def _draw_starts(ax: Axes, streams: Sequence[Streams]) -> None:
    starts = [start for start in STARTS if start != Start.COMPLETE]
    for k, (one, color) in enumerate(zip(streams, COLORS, strict=False)):
        shift = 0.16 * (k - (len(streams) - 1) / 2)
        for i, start in enumerate(starts):
            if rate := one.rate("start", start.name.lower()):
                ax.plot([i + shift] * len(rate.seeds), [seed.value for seed in rate.seeds], "_", color=color, ms=9)
                ax.plot(i + shift, rate.value, "o", color=color, ms=5)
    style_axes(ax, "")
    ax.set_xticks(range(len(starts)), [fill(STARTS[start][0], 13) for start in starts])
    ax.set(ylim=(0, 1.02), ylabel="success")
    ax.set_title("success by how the bodies lay (dashes: seeds)", fontsize=9, color=INK, loc="left")


def _draw_spending(ax: Axes, streams: Sequence[Streams], runs: Mapping[str, Sequence[TrainingRun]]) -> None:
    for one, color in zip(streams, COLORS, strict=False):
        for run in runs.get(one.name, ()):
            steps = [update["interaction_steps"] for update in run.updates]
            ax.plot(steps, [update["interventions"] for update in run.updates], color=color, lw=1.5)
    style_axes(ax, "interaction steps, all streams")
    ax.set_yscale("log")
    ax.set_ylabel("interventions")
    ax.set_title("where the interventions went", fontsize=9, color=INK, loc="left")


def _named(argument: str) -> tuple[str, list[Path]]:
    """`NAME=PATH,PATH`; names may have a `=` in them, as in T = 80."""
    name, _, paths = argument.rpartition("=")
    if not name or not paths:
        raise argparse.ArgumentTypeError(f"{argument!r} is not {NAMED}")
    return name, [Path(path) for path in paths.split(",")]


def _parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m cronos_lerobot.studies.streams_compared",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--streams", required=True, nargs="+", type=_named, metavar=NAMED, help="CSV files of stream_evaluation"
    )
    parser.add_argument(
        "--runs", default=[], nargs="+", type=_named, metavar=NAMED,
        help="run folders of cronos-train, by a name of --streams",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, required=True, help="folder to write into")
    args = parser.parse_args()
    names = [name for name, _ in args.streams]
    if unknown := [name for name, _ in args.runs if name not in names]:
        parser.error(f"--runs: no streams are named {', '.join(unknown)}; there are {', '.join(names)}")
    if len(set(names)) < len(names):
        parser.error(f"--streams: names have to differ, got {', '.join(names)}")
    if len(names) > len(COLORS):
        parser.error(f"--streams: at most {len(COLORS)} names can be told apart, not {len(names)}")
    return args


def main() -> None:
    """Draw the figure, and write its numbers."""
    args = _parse_args()
    try:
        streams = [read_streams(name, paths) for name, paths in args.streams]
        if len(lengths := {len(one.by_segment()) for one in streams}) > 1:
            raise ValueError(f"--streams: streams of different lengths: {', '.join(map(str, sorted(lengths)))}")
        runs = {name: [read_training_run(folder) for folder in folders] for name, folders in args.runs}
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "streams.png").write_bytes(to_png(draw_streams(streams, runs), 150))
    write_csv(args.output / "streams.csv", table_rows(streams))
    tables = "\n\n".join(make(streams) for make in (make_table, make_parts, make_differences))
    (args.output / "streams.md").write_text(tables + "\n")
    print(tables)


if __name__ == "__main__":
    main()
