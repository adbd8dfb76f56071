"""The figures of an experiment."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cronos_lerobot.experiments.definitions import INTERACTION_STEPS, INTERVENTIONS
from cronos_lerobot.experiments.results import ExperimentResult, RowResult, paper_results, sequential
from cronos_lerobot.report.figures import (
    COLORS,
    INK,
    SPLIT_LABELS,
    draw_curve,
    segment_curve,
    style_axes,
    style_of,
    style_segment_axis,
)
from cronos_lerobot.report.series import Curve, mean_curve, segment_rates

AXIS_LABELS = {INTERACTION_STEPS: "interaction steps, all streams", INTERVENTIONS: "interventions, all streams"}
MUCH_LONGER = 5
"""Rows whose numbers of interventions differ by so much do not share a linear axis."""
Panel = tuple[str, str, str | None]
"""Split, axis and task (None: all together) of one set of axes."""


def row_curve(row: RowResult, split: str, axis: str, task: str | None = None) -> Curve | None:
    """Mean and standard deviation over a row's seeds, or one seed with its 95 % interval; None without points."""
    curves = [curve for seed in row.drawn if (curve := seed.curve(split, task))]
    if len(curves) == 1:
        points = curves[0]
        ends = np.array([point.ci95 for point in points])
        x, y = np.array([p.x(axis) for p in points]), np.array([p.success for p in points])
        return Curve(x, y, ends[:, 0], ends[:, 1], is_band_over_seeds=False)
    return mean_curve([([p.x(axis) for p in c], [p.success for p in c]) for c in curves]) if curves else None


def row_label(row: RowResult, number: int | None = None) -> str:
    """The legend's entry: settings and seeds, all that are drawn or `number` of them."""
    number = len(row.drawn) if number is None else number
    seeds = f"{number} seed{'s' * (number != 1)}"
    return f"{row.row.label} ({seeds}{'' if row.finished else ', unfinished'})"


def curves_figure(result: ExperimentResult) -> Figure | None:
    """Success over the run, a panel for each split, axis and, where the paper has it so, task."""
    experiment = result.experiment
    panels: list[list[Panel]]
    if experiment.by_task:
        lines = [(split, axis) for split in experiment.splits for axis in experiment.axes]
        panels = [[(split, axis, task) for task in result.tasks] for split, axis in lines]
    elif len(experiment.axes) == 1:
        panels = [[(split, experiment.axes[0], None) for split in experiment.splits]]
    else:
        panels = [[(split, axis, None) for axis in experiment.axes] for split in experiment.splits]
    return _grid(result, panels) if panels[0] else None


def _grid(result: ExperimentResult, panels: list[list[Panel]]) -> Figure | None:
    height, width = len(panels), len(panels[0])
    size = (max(6.4, min(5.2 * width, 3.4 * width + 2)), 3.1 * height + 0.9)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(height, width, squeeze=False, sharey=True)
    for line, line_axes in zip(panels, axes, strict=True):
        for (split, axis, task), ax in zip(line, line_axes, strict=True):
            for i, row in enumerate(result.rows):
                curve = row_curve(row, split, axis, task)
                number = sum(bool(seed.curve(split, task)) for seed in row.drawn)
                draw_curve(ax, curve, i, row_label(row, number), marker="o", width=1.5, marker_size=3)
            style_axes(ax, AXIS_LABELS[axis])
            if axis == INTERVENTIONS:
                _spread_interventions(ax)
            ax.set_ylim(0, 1.02)
            ax.set_title(task or SPLIT_LABELS[split], fontsize=9, color=INK, loc="left")
        split, _, task = line[0]
        line_axes[0].set_ylabel(f"success, {SPLIT_LABELS[split]}" if task else "success")
    if not any(ax.lines for ax in axes.flat):
        return None
    legend_below(figure, list(axes.flat))
    return figure


def _spread_interventions(ax: Axes) -> None:
    """Make room for the rows with few interventions: logarithmic beyond half of the shortest one's."""
    ends = [end for line in ax.lines if (end := float(np.max(np.asarray(line.get_xdata()), initial=0.0))) > 0]
    if not ends or max(ends) < MUCH_LONGER * min(ends):
        return
    linear_to = min(ends) / 2
    ax.set_xscale("symlog", linthresh=linear_to, linscale=0.5)
    ticks = [step * 10**power for power in range(7) for step in (1, 2, 5)]
    shown = [0, *(tick for tick in ticks if linear_to / 2 <= tick <= max(ends))]
    ax.set_xticks(shown, [f"{tick:,}" for tick in shown])
    ax.set_xticks([], minor=True)
    ax.set_xlabel(f"{ax.get_xlabel()} (log scale)")


def legend_below(figure: Figure, axes: list[Axes]) -> None:
    """One legend for all axes, below them, each entry once."""
    entries: dict[str, Artist] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=2, fontsize=8, frameon=False
    )


def bars_figure(result: ExperimentResult) -> Figure | None:
    """Success at the end of every row beside the paper's, mean and standard deviation over the seeds."""
    paper = paper_results()["final_success"].get(result.experiment.name)
    rows = [(row, summary) for row in result.rows if (summary := row.success("train"))]
    if not rows or not paper:
        return None
    figure = Figure(figsize=(10, 0.55 * len(rows) + 1.2), layout="constrained")
    ax = figure.subplots()
    y = np.arange(len(rows))
    ours = [summary.mean for _, summary in rows]
    ax.barh(y - 0.2, ours, 0.36, xerr=[s.std or 0 for _, s in rows], color=COLORS[0], label="here", ecolor=INK)
    known = [paper[row.row.name] for row, _ in rows]
    ax.barh(
        y + 0.2,
        [m for m, _ in known],
        0.36,
        xerr=[s for _, s in known],
        color="#bbbbbb",
        label="paper",
        ecolor=INK,
    )
    ax.set_yticks(y, [row.row.label for row, _ in rows], fontsize=9)
    ax.invert_yaxis()
    style_axes(ax, "success at the end, training configurations")
    ax.set_xlim(0, 1)
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    return figure


def segments_figure(result: ExperimentResult) -> Figure | None:
    """Success while training by segment since the last scene reset, in the last quarter of the runs."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    ax = figure.subplots()
    for i, row in enumerate(result.rows):
        if rates := segment_rates(row.group):
            draw_curve(ax, segment_curve(rates), i, row_label(row), marker="o")
    style_segment_axis(ax)
    ax.set(ylabel="success while training", ylim=(0, 1.02))
    if not ax.lines:
        return None
    legend_below(figure, [ax])
    return figure


def sequential_figure(result: ExperimentResult) -> Figure | None:
    """SEQ 0-3: bars of mean and standard deviation over the seeds, one panel for each split."""
    splits = [s for e in result.experiment.evaluations if e.suite == "sequential" for s in e.splits]
    found = {
        split: [(i, row, s) for i, row in enumerate(result.rows) if (s := sequential(row, split))]
        for split in splits
    }
    found = {split: rows for split, rows in found.items() if rows}
    if not found:
        return None
    figure = Figure(figsize=(5 * len(found), 3.8), layout="constrained")
    axes = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
    for ax, (split, rows) in zip(axes, found.items(), strict=True):
        _sequential_panel(ax, rows)
        ax.set_title(SPLIT_LABELS[split], fontsize=9, color=INK, loc="left")
    axes[0].set_ylabel("success")
    legend_below(figure, list(axes))
    return figure


def _sequential_panel(ax: Axes, rows: list) -> None:
    width = 0.8 / len(rows)
    for place, (i, row, found) in enumerate(rows):
        x = np.arange(len(found["positions"]))
        means = [position.mean for position in found["positions"]]
        spread = [position.std or 0.0 for position in found["positions"]]
        color, _, hatch = style_of(i)
        ax.bar(
            x + (place - (len(rows) - 1) / 2) * width,
            means,
            0.92 * width,
            yerr=spread,
            color=color,
            hatch=hatch,
            edgecolor="white",
            linewidth=0,
            ecolor=INK,
            label=row_label(row, found["seeds"]),
        )
    style_axes(ax, "task in the sequence")
    ax.set_xticks(x, [f"SEQ {position}" for position in x])
    ax.set_ylim(0, 1.02)
