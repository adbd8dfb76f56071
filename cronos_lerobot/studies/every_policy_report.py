"""What the runs of `every_policy` came to: a line of a file for each, a table and a figure of all."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cronos_lerobot.protocol.metrics import Summary, summarise
from cronos_lerobot.report.figures import COLORS, INK, style_axes
from cronos_lerobot.report.runs import TrainingRun
from cronos_lerobot.report.tables import write_csv

AGENTS = {"ppo": COLORS[0], "imitation": COLORS[1], "steering": COLORS[2]}
INTERVALS = {80: ("80", "o"), 320: ("320 + EER", "s")}
"""Name and marker of each T; EER are end-effector resets."""


@dataclass(frozen=True)
class Ended:
    """A run that is over, as a line of `gains.csv`."""

    policy: str
    agent: str
    interval: int
    """T [control steps]."""
    seed: int
    steps: int
    """Interaction steps."""
    interventions: int
    before: float
    """Success of the base policy, on the same episodes."""
    after: float
    n: int
    """Episodes of an evaluation."""


@dataclass(frozen=True)
class Gain:
    """What an agent made of a base policy: runs that differ in their seed."""

    runs: tuple[Ended, ...]

    @property
    def before(self) -> float:
        """Mean over the runs, which begin with one policy wherever one machine has cloned it."""
        return float(np.mean([run.before for run in self.runs]))

    @property
    def gain(self) -> Summary:
        """After minus before, over the seeds; the base's success is taken as it was measured."""
        summary = summarise([run.after - run.before for run in self.runs])
        assert summary is not None
        return summary


def make_end(run: TrainingRun, policy: str, agent: str, interval: int, seed: int, steps: int) -> Ended | None:
    """What a run came to, from its first to its last evaluation; None before it is over."""
    if not run.evaluations or run.evaluations[-1]["interaction_steps"] < steps:
        return None
    first, last = run.evaluations[0], run.evaluations[-1]
    success = first["success"], last["success"]
    return Ended(policy, agent, interval, seed, steps, last["interventions"], *success, last["n"])


def write_gains(runs: Iterable[Ended], path: Path) -> None:
    """Write a line for each run."""
    write_csv(path, [asdict(run) for run in runs])


def read_gains(path: Path) -> list[Ended]:
    """Read what `write_gains` wrote."""
    with path.open() as file:
        return [
            Ended(
                row["policy"],
                row["agent"],
                *(int(row[name]) for name in ("interval", "seed", "steps", "interventions")),
                before=float(row["before"]),
                after=float(row["after"]),
                n=int(row["n"]),
            )
            for row in csv.DictReader(file)
        ]


def merge(runs: Iterable[Ended], others: Iterable[Ended], policies: Sequence[str]) -> list[Ended]:
    """Join runs with those of other machines, which count where the same run is not among the first.

    They come in the order of `policies`, then by agent, T and seed.
    """
    found = {(*_group(run), run.seed): run for run in (*others, *runs)}
    agents = list(AGENTS)
    return sorted(
        found.values(),
        key=lambda run: (policies.index(run.policy), agents.index(run.agent), run.interval, run.steps, run.seed),
    )


def _group(run: Ended) -> tuple[str, str, int, int]:
    return run.policy, run.agent, run.interval, run.steps


def gains(runs: Iterable[Ended]) -> list[Gain]:
    """Runs that differ in their seed, together."""
    groups: dict[tuple[str, str, int, int], list[Ended]] = {}
    for run in runs:
        groups.setdefault(_group(run), []).append(run)
    return [Gain(tuple(group)) for group in groups.values()]


def make_table(runs: Iterable[Ended]) -> str:
    """A table in Markdown, a line for each policy, agent and interval; intervals above zero are bold."""
    lines = [
        "| policy | agent | T | steps | interventions | before | after, by seed | gain [95 %] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for gain in gains(runs):
        run = gain.runs[0]
        after = " ".join(f"{one.after:.3f}".lstrip("0") for one in gain.runs)
        interventions = round(np.mean([one.interventions for one in gain.runs]))
        lines.append(
            f"| {run.policy} | {run.agent} | {INTERVALS[run.interval][0]} | {run.steps:,} | {interventions:,} "
            f"| {gain.before:.3f} | {after} | {_gain_cell(gain.gain)} |"
        )
    return "\n".join(lines)


def _gain_cell(gain: Summary) -> str:
    if (interval := gain.varied_ci95) is None:
        return f"{gain.mean:+.3f}"
    text = "{:+.3f} [{:+.3f}, {:+.3f}]".format(gain.mean, *interval)
    return f"**{text}**" if interval[0] > 0 else text


@dataclass(frozen=True)
class Cost:
    """What the steps of a run cost, on the machine that it had."""

    steps_per_s: float
    """Interaction steps."""
    physics: float
    """Time of a step over that of its physics: what a faster or a busier machine changes least."""


def make_cost(run: TrainingRun) -> Cost | None:
    """What updates cost, but for the first, which starts things; None before there is a second."""
    steps = np.diff([update["interaction_steps"] for update in run.updates])
    if len(steps) == 0:
        return None
    seconds = steps / [update["steps_per_s"] for update in run.updates[1:]]
    physics = seconds @ [update["time_share"]["physics"] for update in run.updates[1:]]
    return Cost(float(steps.sum() / seconds.sum()), float(seconds.sum() / physics))


def make_cost_table(costs: Mapping[tuple[str, str], Sequence[Cost]]) -> str:
    """A table in Markdown of the least and the greatest cost of the runs of each policy and agent."""
    lines = ["| policy | agent | steps/s | a step, in times of its physics |", "|---|---|---|---|"]
    for (policy, agent), found in costs.items():
        speed, physics = [cost.steps_per_s for cost in found], [cost.physics for cost in found]
        lines.append(f"| {policy} | {agent} | {_span(speed, '.0f')} | {_span(physics, '.1f')} |")
    return "\n".join(lines)


def _span(values: Sequence[float], form: str) -> str:
    return " to ".join(dict.fromkeys(f"{value:{form}}" for value in (min(values), max(values))))


def draw_gains(runs: Sequence[Ended]) -> Figure:
    """Success before and after: a line for each policy, agent and T, dots for the seeds.

    Marks are means; their interval is the gain's, drawn from the base policy's success.
    """
    lines = gains(runs)
    figure = Figure(figsize=(8, 0.34 * len(lines) + 1.2), layout="constrained")
    ax = figure.subplots()
    firsts = [line.runs[0] for line in lines]
    policies = list(dict.fromkeys(run.policy for run in firsts))
    heights = [i + 0.7 * policies.index(run.policy) for i, run in enumerate(firsts)]
    for run, line, y in zip(firsts, lines, heights, strict=True):
        gain, color = line.gain, AGENTS[run.agent]
        ax.plot([line.before] * 2, [y - 0.4, y + 0.4], color="#8a8a8a", linewidth=2)
        ax.plot([line.before, line.before + gain.mean], [y, y], color=color, linewidth=1, alpha=0.4)
        ax.plot([one.after for one in line.runs], [y] * len(line.runs), ".", color=color, alpha=0.6, markersize=5)
        interval = gain.varied_ci95
        bars = None if interval is None else [[gain.mean - interval[0]], [interval[1] - gain.mean]]
        marker = INTERVALS[run.interval][1]
        ax.errorbar(line.before + gain.mean, y, xerr=bars, fmt=marker, color=color, markersize=6, capsize=3)
    ax.set_yticks(heights, [f"{run.policy}, {run.agent}, T = {INTERVALS[run.interval][0]}" for run in firsts])
    ax.invert_yaxis()
    style_axes(ax, "success before (grey) and after, with the gain's 95 % interval")
    ax.xaxis.set_major_formatter("{x:.2f}")
    ax.tick_params(axis="y", labelcolor=INK)
    return figure
