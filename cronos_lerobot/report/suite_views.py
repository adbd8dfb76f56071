"""Tables, figure and videos of `cronos-eval`'s results."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from cronos_lerobot.report.clips import Clip
from cronos_lerobot.report.figures import INK, SPLIT_LABELS, style_axes, style_of
from cronos_lerobot.report.suites import SuiteRun
from cronos_lerobot.report.tables import APART

ORDERINGS = ("all", "seen", "unseen")
"""In training, whose heuristic streams run the training cycle without end."""


def independent_rows(runs: Iterable[SuiteRun]) -> list[dict[str, Any]]:
    """Success of single tasks: a row for all of them together and one for each."""
    rows = []
    for run in runs:
        for split, found in run.splits("independent").items():
            for task, rate in {"all tasks": found, **found["per_task"]}.items():
                low, high = rate["ci95"]
                numbers = {"success": rate["success"], "n": rate["n"], "ci95_low": low, "ci95_high": high}
                numbers |= {name: rate.get(name) for name in APART}
                rows.append({"policy": run.name, "split": split, "task": task} | numbers)
    return rows


def sequential_rows(runs: Iterable[SuiteRun]) -> list[dict[str, Any]]:
    """Success at each position of a chain, and the average chain length; `std` is over the orderings.

    A row for all orderings, and one each for those seen in training and the others.
    """
    return [
        {"policy": run.name, "split": split, "orderings": orderings} | _chain_cells(part)
        for run in runs
        for split, found in run.splits("sequential").items()
        for orderings in ORDERINGS
        if (part := found if orderings == "all" else found.get(orderings))
    ]


def _chain_cells(found: dict[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {"chains": found["n"]}
    for k, position in enumerate(found["positions"]):
        row |= {f"SEQ {k}": position["success"], f"SEQ {k} std": position["std"]}
        low, high = position["ci95"]
        row |= {f"SEQ {k} ci95_low": low, f"SEQ {k} ci95_high": high}
    length = found["average_chain_length"]
    low, high = length["ci95"]
    row |= {"chain length": length["mean"], "chain length std": length["std"]}
    row |= {"chain length ci95_low": low, "chain length ci95_high": high}
    return row | {name: sum(position.get(name, 0) for position in found["positions"]) for name in APART}


def sequential_figure(runs: Iterable[SuiteRun]) -> Figure | None:
    """Success by position with 95 % intervals, a panel for each split."""
    drawn = [run for run in runs if run.splits("sequential")]
    splits = list(dict.fromkeys(split for run in drawn for split in run.splits("sequential")))
    if not splits:
        return None
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    axes = figure.subplots(1, len(splits), squeeze=False, sharey=True)[0]
    for ax, split in zip(axes, splits, strict=True):
        _draw_positions(ax, drawn, split)
        ax.set_title(SPLIT_LABELS.get(split, split), fontsize=9, color=INK, loc="left")
    axes[0].set_ylabel("success")
    if len(drawn) > 1:
        # A panel does not have the bars of a policy that was not evaluated on its split.
        bars = [Patch(label=run.name, **_look(i)) for i, run in enumerate(drawn)]
        figure.legend(handles=bars, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure


def _draw_positions(ax: Axes, runs: list[SuiteRun], split: str) -> None:
    width, number = 0.8 / len(runs), 0
    for i, run in enumerate(runs):
        positions = run.splits("sequential").get(split, {}).get("positions", [])
        number = max(number, len(positions))
        x = np.arange(len(positions)) + (i - (len(runs) - 1) / 2) * width
        y = np.array([position["success"] for position in positions])
        ends = np.array([position["ci95"] for position in positions]).reshape(-1, 2)
        ax.bar(x, y, 0.92 * width, yerr=np.abs(ends - y[:, None]).T, ecolor=INK, **_look(i))
    style_axes(ax, "task in the sequence")
    ax.set_xticks(range(number), [f"SEQ {k}" for k in range(number)])
    ax.set_ylim(0, 1.02)


def _look(i: int) -> dict[str, Any]:
    color, _, hatch = style_of(i)
    return {"facecolor": color, "hatch": hatch, "edgecolor": "white"}


def suite_clips(runs: Iterable[SuiteRun]) -> list[Clip]:
    """The videos of all evaluations."""
    clips = []
    for run in runs:
        for path, video in run.videos:
            if path.is_file():
                what = "ordering" if video["suite"] == "sequential" else "task"
                title = f"{video['suite']}, {video['split'].replace('_', '-')}: {video['kind']}"
                caption = f"{run.name}, {what} {video['number']}, configuration {video['configuration']}:"
                clips.append(Clip(title, f"{caption} {video['length']} done", path))
    return clips
