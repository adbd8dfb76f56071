"""The figures of a report, each a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from cronos_lerobot.report.runs import Group, agent_metrics
from cronos_lerobot.report.series import (
    SINGLE,
    Curve,
    evaluation_curve,
    segment_history,
    segment_rates,
    segment_spans,
    update_curve,
)
from cronos_lerobot.report.statistics import Rate

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555")
"""Okabe and Ito's palette: told apart by the colour-blind too."""
Line = str | tuple[int, tuple[float, ...]]
"""By matplotlib's name, or an offset and lengths of dashes and gaps [line widths]."""
LINES_AND_HATCHES: tuple[tuple[Line, str], ...] = (
    ("-", ""),
    ("--", "////"),
    (":", "...."),
    ("-.", "xxxx"),
    ((0, (8, 1.5, 1, 1.5, 1, 1.5)), "\\\\\\\\"),
    ((0, (9, 4)), "||||"),
    ((0, (6, 1.5, 2, 1.5)), "----"),
    ((0, (1, 4)), "oooo"),
)
"""Of lines and bars, for each time that the colours begin anew."""
SPLIT_LABELS = {"train": "training configurations", "held_out": "held-out configurations"}
INK, GRID = "#333333", "#e4e4e4"
AGENT_PANELS = (
    ("KL divergence per update [nats]", "approx_kl"),
    ("entropy [nats; steering: per dimension]", "entropy"),
    ("explained variance of the value", "explained_variance"),
    ("clip fraction", "clip_fraction"),
    ("learning rate of the policy", "policy_lr"),
    ("loss", "loss"),
    ("gradient norm", "grad_norm"),
    ("successful segments remembered", "segments"),
    ("failed segments remembered", "failed_segments"),
    ("frames remembered", "frames"),
    ("effective share of the weighted frames", "effective_share"),
    ("decisions remembered", "decisions"),
    ("loss of the critics", "critic_loss"),
    ("gradient norm of the critics", "critic_grad_norm"),
    ("value of remembered decisions", "value"),
    ("loss of the actor", "actor_loss"),
    ("gradient norm of the actor", "actor_grad_norm"),
    ("alpha, the price of the entropy", "alpha"),
    ("size of the chosen noise (1: the bound)", "choice_abs"),
)
"""Title and name of what agents say of an update: PPO's, imitation's, steering's."""


def evaluation_figure(groups: list[Group]) -> Figure | None:
    """Evaluation success against interaction steps and against interventions."""
    if not any(run.evaluations for group in groups for run in group.runs):
        return None
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for ax, axis in zip(axes, ("interaction_steps", "interventions"), strict=True):
        for i, group in enumerate(groups):
            draw_curve(ax, evaluation_curve(group, axis), i, _label(group), marker="o")
        style_axes(ax, f"{axis.replace('_', ' ')}, all streams")
        ax.set_ylim(0, 1.02)
    axes[0].set_ylabel("evaluation success")
    _legend(figure, [axes[0]], groups)
    return figure


def training_figure(groups: list[Group]) -> Figure | None:
    """Success of the streams' segments, by policy update."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    ax = figure.subplots()
    for i, group in enumerate(groups):
        draw_curve(ax, update_curve(group, lambda update: update["rollout"]["success"]), i, _label(group))
    style_axes(ax, "interaction steps, all streams")
    ax.set(ylabel="success of training segments", ylim=(0, 1.02))
    _legend(figure, [ax], groups)
    return figure if ax.lines else None


def segments_figure(groups: list[Group]) -> Figure | None:
    """Success by segment since the last scene reset, at the end of the runs."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    ax = figure.subplots()
    for i, group in enumerate(groups):
        if rates := segment_rates(group):
            draw_curve(ax, segment_curve(rates), i, _label(group), marker="o")
    style_segment_axis(ax)
    ax.set(ylabel="success of training segments", ylim=(0, 1.02))
    _legend(figure, [ax], groups)
    return figure if ax.lines else None


def segment_curve(rates: Mapping[int, Rate]) -> Curve:
    """Success by segment, a point for each of `segment_spans`."""
    spans = segment_spans(rates)
    ends = np.array([rate.interval for rate in spans.values()])
    x, y = np.array([np.mean(span) for span in spans]), np.array([rate.value for rate in spans.values()])
    return Curve(x, y, ends[:, 0], ends[:, 1], is_band_over_seeds=False)


def style_segment_axis(ax: Axes) -> None:
    """The axis of a `segment_curve`: by doublings where spans double."""
    style_axes(ax, "segment since the last scene reset (1 is the first after it)")
    if ax.lines and ax.dataLim.xmax > SINGLE:
        ax.set_xscale("log", base=2)
        ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    else:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))


def segment_history_figure(groups: list[Group]) -> Figure | None:
    """Success by segment since the last scene reset, over the run: one heat map for each group."""
    groups = [group for group in groups if segment_rates(group, 1.0)]
    if not groups:
        return None
    rows = -(-len(groups) // 2)
    columns = min(2, len(groups))
    figure = Figure(figsize=(10, 3.2 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[len(groups) :]:
        unused.remove()
    axes = axes[: len(groups)]
    mesh: Any = None
    for ax, group in zip(axes, groups, strict=True):
        edges, rates = segment_history(group)
        mesh = ax.pcolormesh(edges, np.arange(len(rates) + 1) + 0.5, rates, vmin=0, vmax=1, cmap="viridis")
        style_axes(ax, "interaction steps, all streams", grid=False)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_ylabel("segment since the reset")
        ax.set_title(_label(group), fontsize=9, color=INK, loc="left")
    figure.colorbar(mesh, ax=axes, label="success", shrink=0.9)
    return figure


def agent_figure(groups: list[Group]) -> Figure | None:
    """The agents' diagnostics, one panel for each that some run has, by policy update."""
    wanted = [*((title, _metric(name)) for title, name in AGENT_PANELS), ("reward per segment", _reward)]
    panels = [(title, [update_curve(group, value) for group in groups]) for title, value in wanted]
    panels = [(title, curves) for title, curves in panels if any(curves)]
    if not panels:
        return None
    rows = -(-len(panels) // 3)
    figure = Figure(figsize=(10, 2.3 * rows), layout="constrained")
    axes = list(figure.subplots(rows, 3, squeeze=False).flat)
    for unused in axes[len(panels) :]:
        unused.remove()
    for ax, (title, curves) in zip(axes, panels, strict=False):
        for i, (group, curve) in enumerate(zip(groups, curves, strict=True)):
            draw_curve(ax, curve, i, _label(group), width=1.2)
        style_axes(ax, "")
        ax.set_title(title, fontsize=9, color=INK, loc="left")
    # Agents differ in their metrics: no panel need have a curve of every group.
    _legend(figure, axes, groups)
    return figure


def _metric(name: str) -> Callable[[dict[str, Any]], float | None]:
    return lambda update: agent_metrics(update).get(name)


def _reward(update: dict[str, Any]) -> float | None:
    return update["rollout"].get("reward_per_segment")


def _label(group: Group) -> str:
    # A $ would begin a formula.
    label = group.label.replace("$", r"\$")
    return label if len(group.runs) == 1 else f"{label} ({len(group.runs)} seeds)"


def style_of(i: int) -> tuple[str, Line, str]:
    """The colour, the line and the hatch that tell row number `i` of a figure from the others."""
    return (COLORS[i % len(COLORS)], *LINES_AND_HATCHES[i // len(COLORS) % len(LINES_AND_HATCHES)])


def draw_curve(
    ax: Axes,
    curve: Curve | None,
    i: int,
    label: str,
    *,
    marker: str = "",
    width: float = 1.6,
    marker_size: float = 4,
) -> None:
    """Draw a line and its band in the style number `i`; nothing if there is no curve."""
    if curve is None:
        return
    color, line, _ = style_of(i)
    ax.plot(curve.x, curve.y, linestyle=line, color=color, lw=width, marker=marker, ms=marker_size, label=label)
    ax.fill_between(curve.x, curve.low, curve.high, color=color, alpha=0.18, lw=0)


def style_axes(ax: Axes, xlabel: str, *, grid: bool = True) -> None:
    """Give axes the look of all figures."""
    ax.set_xlabel(xlabel)
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8, colors=INK)
    ax.xaxis.set_major_formatter(FuncFormatter(_thousands))
    if grid:
        ax.grid(color=GRID, lw=0.8)
        ax.set_axisbelow(True)


def _thousands(x: float, _: Any) -> str:
    if abs(x) >= 1e6:
        return f"{x / 1e6:g}M"
    return f"{x / 1e3:g}k" if abs(x) >= 1e4 else f"{x:g}"


def _legend(figure: Figure, axes: Sequence[Axes], groups: list[Group]) -> None:
    """A legend below the panels, where it covers nothing, if there is anything to tell apart."""
    found = {(str(line.get_label()), line.get_color()): line for ax in axes for line in ax.lines}
    keys = [(_label(group), COLORS[i % len(COLORS)]) for i, group in enumerate(groups)]
    labels, handles = [key[0] for key in keys if key in found], [found[key] for key in keys if key in found]
    if not handles or (len(groups) < 2 and len(groups[0].runs) < 2):
        return
    columns = 2 if len(labels) > 3 else max(1, len(labels))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.22 * -(-len(labels) // columns))
