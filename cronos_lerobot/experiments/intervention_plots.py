"""Success against interventions on a logarithmic axis: what a reset is worth, for each base policy."""

from __future__ import annotations

import math
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
MOST_MARKS = 9
"""Of one base policy in a panel of steps, where nobody could tell more of them apart."""
FEW_ROWS = 6
"""Of a list: its panel is lower than the name of the axis is long with fewer."""


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
    """Over the seeds, with the 95 % interval of the mean, of two seeds without; of one that of its evaluation."""

    def x(self, axis: str) -> float:
        """Its place on `axis`, interaction_steps or interventions."""
        return self.interventions if axis == INTERVENTIONS else self.steps


def interventions_figure(result: ExperimentResult) -> Figure | None:
    """A line of panels for each kind of base policy: success against interventions, and against steps.

    Faint lines are runs from their beginning, means over the seeds; marks are their ends, with intervals, side by
    side where they would cover each other. Many rows have a list of their ends in place of the panel of steps.
    """
    drawn = {row.row.name: end for row in result.rows if (end := find_end(row))}
    by_base: dict[str, list[RowResult]] = {}
    for row in result.rows:
        if row.row.name in drawn:
            by_base.setdefault(_panel(row), []).append(row)
    if not by_base:
        return None
    most = max(map(len, by_base.values()))
    styles = row_styles(result)
    has_list = most > MOST_MARKS
    figure = (_with_list if has_list else _with_steps)(by_base, styles, drawn)
    panels = figure.axes[::2]
    for ax, (base, rows) in zip(panels, by_base.items(), strict=True):
        _join_ends(ax, rows, result, styles)
        ax.set_title(f"{base} base policy", fontsize=9, color=INK, loc="left")
        ax.set_ylabel("success" if has_list and len(rows) < FEW_ROWS else "success, training configurations")
    _logarithmic(panels, [end.interventions for end in drawn.values()])
    for ax in panels:
        ax.label_outer()
    return figure


def _with_steps(by_base: dict[str, list[RowResult]], styles: dict[str, Style], drawn: dict[str, End]) -> Figure:
    size = (10, 3.4 * len(by_base) + 0.11 * len(styles) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(by_base), 2, squeeze=False, sharey=True, sharex="col")
    for rows, line in zip(by_base.values(), axes, strict=True):
        for ax, axis in zip(line, (INTERVENTIONS, INTERACTION_STEPS), strict=True):
            _draw_rows(ax, rows, styles, drawn, axis)
    axes[0, 1].set_xlim(left=0, right=1.15 * max(end.steps for end in drawn.values()))
    for ax in axes[:, 1]:
        ax.label_outer()
    legend_below(figure, list(axes.flat))
    return figure


def _with_list(by_base: dict[str, list[RowResult]], styles: dict[str, Style], drawn: dict[str, End]) -> Figure:
    heights = [0.21 * len(rows) + 0.7 for rows in by_base.values()]
    figure = Figure(figsize=(11, sum(heights) + 0.5), layout="constrained")
    grid = {"height_ratios": heights, "width_ratios": (5, 4)}
    axes = figure.subplots(len(by_base), 2, squeeze=False, sharex="col", gridspec_kw=grid)
    for rows, (left, right) in zip(by_base.values(), axes, strict=True):
        _draw_rows(left, rows, styles, drawn, INTERVENTIONS, with_intervals=False)
        for place, row in enumerate(rows):
            style, success = styles[row.row.name], drawn[row.row.name].success
            look = {"color": style.color, "marker": style.marker, "ms": 5.5, "lw": 0, "elinewidth": 1.4}
            right.errorbar([success.mean], [place], xerr=_error(success), **look)
        begins = [curve[0].success for row in rows for seed in row.drawn if (curve := seed.curve(SPLIT))]
        right.axvline(float(np.mean(begins)), color=INK, lw=1.0, ls=":", zorder=1)
        style_axes(right, "success at the end; dotted, before training")
        labels = [f"{styles[row.row.name].label} ({_seeds(row)})" for row in rows]
        right.set_yticks(range(len(rows)), labels, fontsize=7.5)
        right.set_ylim(len(rows) - 0.4, -0.6)
    for ax in axes[:-1, 1]:
        ax.set_xlabel("")
    return figure


def _draw_rows(
    ax: Axes,
    rows: list[RowResult],
    styles: dict[str, Style],
    drawn: dict[str, End],
    axis: str,
    *,
    with_intervals: bool = True,
) -> None:
    places = [drawn[row.row.name].x(axis) for row in rows]
    for row, x, shift in zip(rows, places, side_by_side(places), strict=True):
        place = (x, shift if with_intervals else 0.0)
        _draw_row(ax, row, styles[row.row.name], drawn[row.row.name], axis, place, with_intervals)
    style_axes(ax, AXIS_LABELS[axis])
    ax.set_ylim(-0.03, 1.03)


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
            # Where colours and markers would begin anew together, the markers go on by one.
            shift = number // math.lcm(len(colors), len(MARKERS))
            styles[label] = Style(label, colors[number % len(colors)], MARKERS[(number + shift) % len(MARKERS)])
    return {row.row.name: styles[replace(row.row, base=NARROW).label] for row in result.rows}


def find_end(row: RowResult) -> End | None:
    """The last evaluations of a row's finished runs, or of all while there is none; None without any."""
    points = [curve[-1] for seed in row.drawn if (curve := seed.curve(SPLIT))]
    success = summarise_points(points)
    if success is None:
        return None
    if len(points) == 2:
        # Student's interval of two reaches over the whole axis, and would hide the others' behind it.
        success = replace(success, ci95=None)
    mean = [float(np.mean([point.x(axis) for point in points])) for axis in (INTERVENTIONS, INTERACTION_STEPS)]
    return End(*mean, success)


def _panel(row: RowResult) -> str:
    """Its base policy, such as `narrow`, or `wide resets`."""
    return row.row.base.replace("_", " ")


def _error(success: Summary) -> list[list[float]]:
    low, high = success.ci95 or (success.mean, success.mean)
    return [[success.mean - low], [high - success.mean]]


def _draw_row(
    ax: Axes,
    row: RowResult,
    style: Style,
    end: End,
    axis: str,
    place: tuple[float, float],
    with_interval: bool,
) -> None:
    """A row's curve, and its end at a place on the axis, so many points to the right of it."""
    if curve := row_curve(row, SPLIT, axis):
        ax.plot(curve.x, curve.y, color=style.color, lw=1.0, alpha=0.4, zorder=2)
    figure = ax.get_figure(root=True)
    assert figure is not None
    x, shift = place
    ax.errorbar(
        [x], [end.success.mean], yerr=_error(end.success) if with_interval else None, color=style.color,
        marker=style.marker, ms=5.5, lw=0, elinewidth=1.4, label=f"{style.label} ({_seeds(row)})", zorder=4,
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
