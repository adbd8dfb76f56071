"""The figures of an experiment, from the evaluations of its runs."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cronos_lerobot.experiments.definitions import Experiment
from cronos_lerobot.experiments.tables import curves
from cronos_lerobot.report.figures import COLORS, INK, SPLIT_LABELS, draw_curve, mean_curve, style_axes

AXES = {"steps": "interaction steps, all streams", "interventions": "interventions, all streams"}


def curves_figure(experiment: Experiment, found: pd.DataFrame) -> Figure:
    """Success over interaction steps and interventions, a line of panels for each split."""
    splits = ["train", "held_out"] if experiment.held_out_curve else ["train"]
    figure = Figure(figsize=(10, 3.6 * len(splits)), layout="constrained")
    axes = figure.subplots(len(splits), 2, squeeze=False, sharey=True)
    for split, line in zip(splits, axes, strict=True):
        for axis, ax in zip(AXES, line, strict=True):
            draw_rows(ax, experiment, found, split, axis)
        line[0].set_ylabel(f"success, {SPLIT_LABELS[split]}")
    _legend(figure, axes[0, 0])
    return figure


def by_task_figure(experiment: Experiment, found: pd.DataFrame) -> Figure:
    """Success over interaction steps and interventions, a column of panels for each task (Figures 11 to 14)."""
    parts = [{part["part"] for part in some} for some in found[found["suite"] == "independent"]["parts"]]
    tasks = sorted(set.union(*parts))
    lines = [(split, axis) for split in ("train", *(["held_out"] * experiment.held_out_curve)) for axis in AXES]
    figure = Figure(figsize=(3.2 * len(tasks), 2.9 * len(lines)), layout="constrained")
    axes = figure.subplots(len(lines), len(tasks), squeeze=False, sharey=True)
    for (split, axis), line in zip(lines, axes, strict=True):
        for task, ax in zip(tasks, line, strict=True):
            draw_rows(ax, experiment, found, split, axis, task)
            ax.set_title(task, fontsize=8, color=INK, loc="left")
        line[0].set_ylabel(f"success, {SPLIT_LABELS[split]}")
    _legend(figure, axes[0, 0])
    return figure


def bars_figure(experiment: Experiment, found: pd.DataFrame) -> Figure:
    """Success at the end of every row beside the paper's: mean and standard deviation over the seeds."""
    figure = Figure(figsize=(10, 0.55 * len(experiment.rows) + 1.2), layout="constrained")
    ax = figure.subplots()
    y = np.arange(len(experiment.rows))
    ends = [[one["success"].iloc[-1] for one in curves(found, row, "train")] for row in experiment.rows]
    ours = [(np.mean(end), np.std(end, ddof=1) if len(end) > 1 else 0) if end else (np.nan, 0) for end in ends]
    for shift, color, label, numbers in (
        (-0.2, COLORS[0], "here", ours),
        (0.2, "#bbbbbb", "paper", experiment.paper),
    ):
        means, spreads = zip(*numbers, strict=True)
        ax.barh(y + shift, means, 0.36, xerr=spreads, color=color, label=label, ecolor=INK)
    ax.set_yticks(y, [row.label for row in experiment.rows], fontsize=9)
    ax.invert_yaxis()
    style_axes(ax, "success at the end, training configurations")
    ax.set_xlim(0, 1)
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    return figure


def draw_rows(
    ax: Axes, experiment: Experiment, found: pd.DataFrame, split: str, axis: str, task: str | None = None
) -> None:
    """Draw the mean of each row's seeds, and their standard deviation as a band; `task` None is all tasks."""
    for i, row in enumerate(experiment.rows):
        known = [one for one in curves(found, row, split) if one[axis].notna().all()]
        if known:
            mean = mean_curve([(one[axis], _success(one, task)) for one in known])
            draw_curve(ax, mean, i, row.label, len(known))
    style_axes(ax, AXES[axis])
    if axis == "interventions":
        ax.set_xscale("symlog", linthresh=100)


def _success(one: pd.DataFrame, task: str | None) -> list[float]:
    if task is None:
        return list(one["success"])
    return [part["success"] for parts in one["parts"] for part in parts if part["part"] == task]


def _legend(figure: Figure, ax: Axes) -> None:
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
