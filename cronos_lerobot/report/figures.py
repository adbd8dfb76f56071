"""The figures of a report, from the tables that `load` reads; None if there is nothing to draw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from cronos_lerobot.report.load import CRONOS_EVAL
from cronos_lerobot.report.tables import rates_by_part, training_curves
from cronos_lerobot.statistics import interpolate

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555")
"""Okabe and Ito's palette, which the colour-blind can tell apart."""
LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (8, 1.5, 1, 1.5, 1, 1.5)), (0, (9, 4)))
HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\", "||||")
"""Of lines and bars, for each time that the colours start again."""
SPLIT_LABELS = {"train": "training configurations", "held_out": "held-out configurations"}
INK, GRID = "#333333", "#e4e4e4"
SINGLE = 16
"""Segments since a scene reset that are drawn one by one; later ones are joined in spans that double."""


class Curve(NamedTuple):
    """A line with a band around it, all (points,)."""

    x: np.ndarray
    y: np.ndarray
    low: np.ndarray
    high: np.ndarray


def mean_curve(curves: Sequence[tuple[Any, Any]]) -> Curve:
    """Mean and standard deviation (ddof = 1) of (x, y) curves, over the range of x that all of them have.

    A curve that has several evaluations at one x is vertical there, as in `performance_gap`.
    """
    xs = [np.asarray(x, float) for x, _ in curves]
    places = np.unique(np.concatenate(xs))
    places = places[(places >= max(x.min() for x in xs)) & (places <= min(x.max() for x in xs))]
    ends = [[interpolate(x, y, places, is_first=is_first) for x, y in curves] for is_first in (True, False)]
    # (curves, 2 places): the first value at each place, then the last.
    values = np.stack(ends, axis=-1).reshape(len(curves), -1)
    spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])
    mean = values.mean(axis=0)
    return Curve(np.repeat(places, 2), mean, mean - spread, mean + spread)


def evaluation_curve(curves: Sequence[pd.DataFrame], axis: str) -> Curve:
    """Evaluation success of some runs against `axis`, `steps` or `interventions`; of one with its interval."""
    if len(curves) > 1:
        return mean_curve([(curve[axis], curve["success"]) for curve in curves])
    columns = (curves[0][name].to_numpy(float) for name in (axis, "success", "ci95_low", "ci95_high"))
    return Curve(*columns)


def evaluation_figure(evaluations: pd.DataFrame) -> Figure | None:
    """Success of the periodic evaluations against interaction steps and against interventions."""
    figure, axes = _subplots(3.8, columns=2, sharey=True)
    for ax, axis in zip(axes, ("steps", "interventions"), strict=True):
        for i, (label, curves) in enumerate(training_curves(evaluations).items()):
            draw_curve(ax, evaluation_curve(curves, axis), i, label, len(curves), marker="o")
        style_axes(ax, f"{'interaction ' * (axis == 'steps')}{axis}, all streams")
        ax.set_ylim(0, 1.02)
    axes[0].set_ylabel("evaluation success")
    return _finished(figure)


def training_figure(updates: pd.DataFrame) -> Figure | None:
    """Success of the streams' segments, by policy update."""
    figure, (ax,) = _subplots(3.2)
    for i, (label, some) in enumerate(updates.groupby("row", sort=False)):
        runs = [run.dropna(subset="success") for _, run in some.groupby("folder", sort=False)]
        curves = [(run["steps"], run["success"]) for run in runs if len(run)]
        if curves:
            draw_curve(ax, mean_curve(curves), i, str(label), some["folder"].nunique())
    style_axes(ax, "interaction steps, all streams")
    ax.set(ylabel="success of training segments", ylim=(0, 1.02))
    return _finished(figure)


def segments_figure(segments: pd.DataFrame) -> Figure | None:
    """Training success by segment since the last scene reset, at the end of the runs."""
    figure, (ax,) = _subplots(3.2)
    for i, (label, some) in enumerate(segments.groupby("row", sort=False)):
        if (curve := segment_curve(some)) is not None:
            draw_curve(ax, curve, i, str(label), some["folder"].nunique(), marker="o")
    style_axes(ax, "segment since the last scene reset (1 is the first after it)")
    if ax.lines and ax.dataLim.xmax > SINGLE:
        ax.set_xscale("log", base=2)
        ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    else:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set(ylabel="success of training segments", ylim=(0, 1.02))
    return _finished(figure)


def segment_curve(segments: pd.DataFrame) -> Curve | None:
    """Training success by segment since the last scene reset, from 1, at the end of some runs."""
    late = segments[(segments["kind"] == "segment") & segments["is_late"]]
    if late.empty:
        return None
    number = late["part"].astype(int) + 1
    first = 2 ** np.floor(np.log2(np.maximum(number - 1, 1))).astype(int)
    middle = np.where(number <= SINGLE, number, 1.5 * first + 0.5)
    rates = rates_by_part(late.assign(x=middle), ["x"]).sort_values("x")
    low, high = (rates[name].fillna(rates["success"]) for name in ("ci95_low", "ci95_high"))
    return Curve(*(column.to_numpy(float) for column in (rates["x"], rates["success"], low, high)))


def part_figure(evaluations: pd.DataFrame, suite: str) -> Figure | None:
    """Success by position of a chain or by segment of a stream, of cronos-eval: a panel for each split."""
    drawn = evaluations[(evaluations["source"] == CRONOS_EVAL) & (evaluations["suite"] == suite)]
    if drawn.empty:
        return None
    splits, policies = list(drawn["split"].unique()), list(drawn["policy"].unique())
    figure, axes = _subplots(3.8, columns=len(splits), sharey=True)
    for ax, split in zip(axes, splits, strict=True):
        for _, one in drawn[drawn["split"] == split].iterrows():
            _draw_parts(ax, one["parts"], policies.index(one["policy"]), len(policies), one["policy"])
        style_axes(ax, "task in the chain" if suite == "sequential" else "segment of the stream")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_ylim(0, 1.02)
        ax.set_title(SPLIT_LABELS.get(split, split), fontsize=9, color=INK, loc="left")
    axes[0].set_ylabel("success")
    return _finished(figure)


def _draw_parts(ax: Axes, parts: Sequence[dict[str, Any]], i: int, number: int, label: str) -> None:
    shown = [p for p in parts if p.get("orderings", "all") == "all" and p["part"] != "chain length"]
    y = np.array([part["success"] for part in shown])
    ends = np.array([(part["ci95_low"], part["ci95_high"]) for part in shown])
    width = 0.8 / number
    x = 1 + np.arange(len(y)) + (i - (number - 1) / 2) * width
    color, _, hatch = style_of(i)
    errors = np.abs(ends - y[:, None]).T
    bars = ax.bar(x, y, 0.92 * width, yerr=errors, label=_label(label), color=color, ecolor=INK)
    for bar in bars:
        bar.set(hatch=hatch, edgecolor="white")


def _subplots(height: float, columns: int = 1, **options: Any) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(10, height), layout="constrained")
    return figure, list(figure.subplots(1, columns, squeeze=False, **options).flat)


def _label(label: str, seeds: int = 1) -> str:
    # A $ would begin a formula.
    text = label.replace("$", r"\$")
    return text if seeds == 1 else f"{text} ({seeds} seeds)"


def style_of(i: int) -> tuple[str, Any, str]:
    """The colour, the line and the hatch of row number `i` of a figure."""
    turn = i // len(COLORS) % len(LINES)
    return COLORS[i % len(COLORS)], LINES[turn], HATCHES[turn]


def draw_curve(ax: Axes, curve: Curve, i: int, label: str, seeds: int, *, marker: str = "") -> None:
    """Draw the line of some seeds and its band in the style number `i`."""
    color, line, _ = style_of(i)
    text = _label(label, seeds)
    ax.plot(curve.x, curve.y, linestyle=line, color=color, lw=1.6, marker=marker, ms=4, label=text)
    ax.fill_between(curve.x, curve.low, curve.high, color=color, alpha=0.18, lw=0)


def style_axes(ax: Axes, xlabel: str) -> None:
    """Give axes the look of all figures."""
    ax.set_xlabel(xlabel)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8, colors=INK)
    ax.xaxis.set_major_formatter(FuncFormatter(_thousands))
    ax.grid(color=GRID, lw=0.8)
    ax.set_axisbelow(True)


def _thousands(x: float, _: Any) -> str:
    if abs(x) >= 1e6:
        return f"{x / 1e6:g}M"
    return f"{x / 1e3:g}k" if abs(x) >= 1e4 else f"{x:g}"


def _finished(figure: Figure) -> Figure | None:
    """The figure with a legend below its panels, or None if nothing is drawn."""
    entries: dict[str, Any] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if not entries:
        return None
    columns = 2 if len(entries) > 3 else len(entries)
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.22 * -(-len(entries) // columns))
    return figure
