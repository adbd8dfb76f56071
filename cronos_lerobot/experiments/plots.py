"""The figures of an experiment, from the evaluations of its runs."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cronos_lerobot.experiments.definitions import Experiment
from cronos_lerobot.experiments.tables import curves
from cronos_lerobot.report.figures import COLORS, INK, SPLIT_LABELS, draw_curve, mean_curve, style_axes
from cronos_lerobot.statistics import summarise

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


def ends_figure(experiment: Experiment, found: pd.DataFrame) -> Figure:
    """Success at the end of every row: a dot for each seed, their mean and its 95 % interval; the paper's mean."""
    figure = Figure(figsize=(8, 0.62 * len(experiment.rows) + 1.1), layout="constrained")
    ax, labels = figure.subplots(), []
    for y, row in enumerate(experiment.rows):
        for shift, color, (split, title) in zip((-0.16, 0.16), COLORS, SPLIT_LABELS.items(), strict=False):
            ends = [one["success"].iloc[-1] for one in curves(found, row, split)]
            if ends:
                summary, place = summarise(ends, (0, 1)), y + shift
                if summary.ci95:
                    ax.plot(summary.ci95, [place, place], color=color, lw=2)
                ax.plot(ends, [place] * len(ends), "o", color=color, ms=4, alpha=0.5, mew=0)
                ax.plot(summary.mean, place, "D", color=color, ms=6, label=title)
        spent = [one["interventions"].iloc[-1] for one in curves(found, row, "train")]
        labels.append(f"{row.label}\n{np.mean(spent):,.0f} interventions" if spent else row.label)
        if experiment.paper:
            ax.plot(experiment.paper[y][0], y, "|", color="#888888", ms=18, mew=2, label="the paper, training")
    bases = [one["success"].iloc[0] for row in experiment.rows for one in curves(found, row, "train")]
    ax.axvline(float(np.mean(bases)), color=INK, ls=":", lw=1, label="base, training")
    ax.set_yticks(range(len(labels)), labels, fontsize=8)
    style_axes(ax, "success at the end")
    ax.margins(x=0.04)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    handles, names = ax.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
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
