"""Success against interventions on a logarithmic axis: what a reset is worth, for each base policy."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from cronos_lerobot.experiments.definitions import INTERACTION_STEPS, INTERVENTIONS, NARROW
from cronos_lerobot.experiments.plots import AXIS_LABELS, legend_below, row_curve
from cronos_lerobot.experiments.results import ExperimentResult, RowResult, summarise_points
from cronos_lerobot.protocol.metrics import Summary
from cronos_lerobot.report.figures import COLORS, INK, style_axes

SPLIT = "train"
GREYS = ("#000000", "#8a8a8a", "#5c5c5c", "#b0b0b0", "#303030")
MARKERS = ("o", "s", "^", "v", "D")
PLUG_COLORS = tuple(color for color in COLORS if color != "#555555")
"""Rows of the paper's aids are grey and told apart by markers, all others have colours."""
SAME_PLACE, MARK_POINTS = 1.2, 7.0
"""Marks whose places differ by less than this factor stand side by side, so far from each other [points]."""
ROOM_FOR_A_MARK = 0.015
"""Of the axis of steps, at its end, where the marks of most rows stand side by side."""


@dataclass(frozen=True)
class Style:
    """How a row is drawn, the same in all panels."""

    label: str
    color: str
    marker: str


@dataclass(frozen=True)
class End:
    """Where a row has come to."""

    interventions: float
    """Mean over the seeds."""
    steps: float
    success: Summary
    """Over the seeds, with the 95 % interval of the mean; of one seed that of its evaluation."""

    def x(self, axis: str) -> float:
        """Its place on `axis`, interaction_steps or interventions."""
        return self.interventions if axis == INTERVENTIONS else self.steps


def interventions_figure(result: ExperimentResult) -> Figure | None:
    """A line of panels for each kind of base policy: success against interventions, and against steps.

    Faint lines are runs from their beginning, means over the seeds; marks are their ends, with intervals, side by
    side where they would cover each other.
    """
    bases = list(dict.fromkeys(_panel(row) for row in result.rows if row.drawn))
    if not bases:
        return None
    styles = row_styles(result)
    figure = Figure(figsize=(10, 3.4 * len(bases) + 0.11 * len(result.rows) + 0.4), layout="constrained")
    axes = figure.subplots(len(bases), 2, squeeze=False, sharey=True, sharex="col")
    drawn = {row.row.name: end for row in result.rows if (end := find_end(row))}
    for base, line in zip(bases, axes, strict=True):
        rows = [row for row in result.rows if _panel(row) == base and row.row.name in drawn]
        for ax, axis in zip(line, (INTERVENTIONS, INTERACTION_STEPS), strict=True):
            places = [drawn[row.row.name].x(axis) for row in rows]
            for row, x, shift in zip(rows, places, side_by_side(places), strict=True):
                _draw_row(ax, row, styles[row.row.name], drawn[row.row.name], axis, (x, shift))
            style_axes(ax, AXIS_LABELS[axis])
            ax.set_ylim(-0.03, 1.03)
        _join_ends(line[0], rows, result, styles)
        line[0].set_title(f"{base} base policy", fontsize=9, color=INK, loc="left")
        line[0].set_ylabel("success, training configurations")
    _logarithmic(axes[:, 0], [end.interventions for end in drawn.values()])
    most = max(Counter(_panel(row) for row in result.rows if row.row.name in drawn).values())
    room = max(0.15, ROOM_FOR_A_MARK * most)
    axes[0, 1].set_xlim(left=0, right=(1 + room) * max(end.steps for end in drawn.values()))
    for ax in axes.flat:
        ax.label_outer()
    legend_below(figure, list(axes.flat))
    return figure


def side_by_side(places: list[float]) -> list[float]:
    """How far to the right each mark is drawn of its place on the axis [points], so that none covers another."""
    shifts = [0.0] * len(places)
    order = sorted(range(len(places)), key=lambda i: places[i])
    while order:
        together = [i for i in order if places[i] <= SAME_PLACE * places[order[0]]]
        for k, i in enumerate(together):
            shifts[i] = MARK_POINTS * (k - (len(together) - 1) / 2)
        order = order[len(together) :]
    return shifts


def row_styles(result: ExperimentResult) -> dict[str, Style]:
    """The style of each row by its name; the same way of training from another base looks the same."""
    styles: dict[str, Style] = {}
    for row in result.rows:
        label = replace(row.row, base=NARROW).label
        if label not in styles:
            plugs = sum(style.color in PLUG_COLORS for style in styles.values())
            number = plugs if row.row.tag else len(styles) - plugs
            colors = PLUG_COLORS if row.row.tag else GREYS
            styles[label] = Style(label, colors[number % len(colors)], MARKERS[number % len(MARKERS)])
    return {row.row.name: styles[replace(row.row, base=NARROW).label] for row in result.rows}


def find_end(row: RowResult) -> End | None:
    """The last evaluations of a row's finished runs, or of all while there is none; None without any."""
    points = [curve[-1] for seed in row.drawn if (curve := seed.curve(SPLIT))]
    success = summarise_points(points)
    if success is None:
        return None
    mean = [float(np.mean([point.x(axis) for point in points])) for axis in (INTERVENTIONS, INTERACTION_STEPS)]
    return End(*mean, success)


def _panel(row: RowResult) -> str:
    """Its base policy, such as `narrow`, or `wide resets`."""
    return row.row.base.replace("_", " ")


def _draw_row(ax: Axes, row: RowResult, style: Style, end: End, axis: str, place: tuple[float, float]) -> None:
    """A row's curve, and its end at a place on the axis, so many points to the right of it."""
    if curve := row_curve(row, SPLIT, axis):
        ax.plot(curve.x, curve.y, color=style.color, lw=1.0, alpha=0.4, zorder=2)
    figure = ax.get_figure(root=True)
    assert figure is not None
    x, shift = place
    low, high = end.success.ci95 or (end.success.mean, end.success.mean)
    error = [[end.success.mean - low], [high - end.success.mean]]
    ax.errorbar(
        [x], [end.success.mean], yerr=error, color=style.color, marker=style.marker, ms=5.5, lw=0, elinewidth=1.4,
        label=f"{style.label} ({_seeds(row)})", zorder=4,
        transform=ax.transData + ScaledTranslation(shift / 72, 0, figure.dpi_scale_trans),
    )  # fmt: skip


def _seeds(row: RowResult) -> str:
    number = len(row.drawn)
    return f"{number} seed{'s' * (number != 1)}{'' if row.finished else ', unfinished'}"


def _join_ends(ax: Axes, rows: list[RowResult], result: ExperimentResult, styles: dict[str, Style]) -> None:
    """Join the ends of the rows that belong together, by their interventions."""
    for label, names in result.experiment.joined:
        found = [(end, styles[row.row.name]) for row in rows if row.row.name in names and (end := find_end(row))]
        found.sort(key=lambda one: one[0].interventions)
        if len(found) > 1:
            ends = [end for end, _ in found]
            ax.plot(
                [end.interventions for end in ends], [end.success.mean for end in ends],
                color=found[-1][1].color, lw=2.2, zorder=3, label=f"{label}, by budget",
            )  # fmt: skip


def _logarithmic(axes: Iterable[Axes], ends: list[float]) -> None:
    """Logarithmic axes that have 0 beside them, for runs without any intervention and for where all begin."""
    some = [end for end in ends if end > 0] or [1.0]
    first, last = 10.0 ** max(0, math.floor(math.log10(min(some)))), max(some)
    decades = [10**power for power in range(8)]
    steps = (1, 2, 5) if last < 1000 * first else (1,)
    shown = [0, *(step * decade for decade in decades for step in steps if first <= step * decade <= last)]
    for ax in axes:
        ax.set_xscale("symlog", linthresh=first, linscale=0.35)
        ax.set_xticks(shown, [f"{tick:,}" for tick in shown])
        ax.set_xticks([], minor=True)
        ax.set_xlim(-0.15 * first, 2 * last)
        ax.set_xlabel(f"{AXIS_LABELS[INTERVENTIONS]} (logarithmic beyond {first:,.0f})")
