"""`cronos-report compare`: what two sides did on the same episodes, as text and as JSON values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cronos_lerobot.evaluation.outcomes import WORTH_SAYING, Outcomes
from cronos_lerobot.report.compared_sides import Side, is_same, paired_episodes, run_and_checkpoint, short_names
from cronos_lerobot.report.paired import ALPHA, Difference, Pairs, compare_policies, compare_trainings, holm

FORMAT = 1
"""Of the JSON values."""


@dataclass(frozen=True)
class PairedRow:
    """One number of both sides, on the same episodes."""

    what: str
    """`all tasks`, an instruction, `chain length`, or `SEQ k`."""
    pairs: int
    configurations: int
    a: float
    b: float
    only_a: int | None
    """Of one policy each: the pairs in which only that of A succeeded."""
    only_b: int | None
    policies: Difference
    """Of these very policies."""
    trainings: Difference | None
    """Of trainings like these; None if there is one of each. A side of one is taken as it is."""
    sampled: str = ""
    """The sides that have several trainings, of which `trainings` speaks: `A`, `B` or `AB`."""
    units: str = "configurations"
    """What `configurations` counts: where all episodes are of one, its repetitions."""
    p_holm: float | None = None
    """p of a single task or position, adjusted for as many tests as there are of them."""

    @property
    def most_general(self) -> Difference:
        """Of trainings, if there are several."""
        return self.trainings or self.policies

    @property
    def of_what(self) -> str:
        """What `most_general` speaks of."""
        if not self.trainings:
            return "these policies"
        if self.sampled == "AB":
            return "trainings like these"
        one = "A" if self.sampled == "B" else "B"
        return f"trainings like those of {self.sampled} against this one policy of {one}"

    @property
    def more_episodes(self) -> int | None:
        """Episodes of each policy, beyond those that were run, with which such a difference would be found."""
        needed = self.policies.needed
        if needed is None:
            return None
        return max(0, round((needed - self.configurations) * self.pairs / self.configurations))


@dataclass(frozen=True)
class PairedSuite:
    """All numbers of a suite and split; the first is of all tasks, or the chain length."""

    suite: str
    split: str
    a: list[str]
    """Policies."""
    b: list[str]
    seeds: list[int]
    """Of the action sampling."""
    left_out: int
    """Episodes of either side that the other does not have."""
    differs: list[str]
    """What differs between the sides beside the policies, or within one, a phrase for each."""
    passed_over: list[str]
    """Evaluations of either side that were not compared, a phrase for each."""
    rows: list[PairedRow]


def compare_sides(a: Side, b: Side, power: float) -> list[PairedSuite]:
    """Compare two sides on every suite and split that both have.

    Raises:
        ValueError: there is none, or their episodes cannot be paired.
    """
    common = [pair for pair in a.suites if pair in b.suites]
    if not common:
        there, here = ([" ".join(pair) for pair in side.suites] for side in (a, b))
        raise ValueError(f"no suite and split is in both: A has {', '.join(there)}, B has {', '.join(here)}")
    return [_suite(a, b, *pair, power) for pair in common]


def check_apart(a: Side, b: Side) -> None:
    """Check that no policy is on both sides.

    Raises:
        ValueError: one is, evaluated alike.
    """
    for pair in [pair for pair in a.suites if pair in b.suites]:
        theirs = b.trainings(*pair)
        for outcomes in a.trainings(*pair):
            if any(is_same(outcomes, other) for other in theirs):
                raise ValueError(
                    f"A and B both have {outcomes.policy}, evaluated alike: there is nothing to compare"
                )


def _suite(side_a: Side, side_b: Side, suite: str, split: str, power: float) -> PairedSuite:
    a, b = side_a.trainings(suite, split), side_b.trainings(suite, split)
    passed_over = {"A": side_a.passed_over(suite, split), "B": side_b.passed_over(suite, split)}
    episodes = paired_episodes((a, b), suite, split)
    numbers = np.array([episode.number for episode in episodes])
    lengths = [np.array([[o.lengths[e] for e in episodes] for o in side]) for side in (a, b)]
    pairs = Pairs.of(lengths[0], lengths[1], episodes)
    if suite == "independent":
        labels = next((o.labels[suite] for o in (*a, *b) if suite in o.labels), {})
        parts = {labels.get(int(n), f"task {n}"): _some(pairs, numbers == n) for n in np.unique(numbers)}
        first = "all tasks"
    else:
        parts = {f"SEQ {k}": _beyond(pairs, k) for k in range(max(o.chain_tasks for o in (*a, *b)))}
        first = "chain length"
        pairs = replace(pairs, are_chains=True)
    rows = [_row(what, part, power) for what, part in parts.items()]
    adjusted = holm([1.0 if row.most_general.p is None else row.most_general.p for row in rows])
    rows = [replace(row, p_holm=p) for row, p in zip(rows, adjusted, strict=True)]
    everyone = {e for side in (a, b) for o in side for e in o.lengths}
    return PairedSuite(
        suite,
        split,
        short_names(a),
        short_names(b),
        sorted({episode.seed for episode in episodes}),
        len(everyone) - len(episodes),
        list(_differs(a, b)),
        [f"{side}: {words}" for side, words in passed_over.items() if words],
        [_row(first, pairs, power), *rows],
    )


def _some(pairs: Pairs, mask: np.ndarray) -> Pairs:
    return replace(pairs, a=pairs.a[:, mask], b=pairs.b[:, mask], configurations=pairs.configurations[mask])


def _beyond(pairs: Pairs, position: int) -> Pairs:
    a, b = ((lengths > position).astype(int) for lengths in (pairs.a, pairs.b))
    return replace(pairs, a=a, b=b)


def _row(what: str, pairs: Pairs, power: float) -> PairedRow:
    only_a = only_b = None
    if pairs.is_binary:
        only_a, only_b = int((pairs.a > pairs.b).sum()), int((pairs.b > pairs.a).sum())
    return PairedRow(
        what,
        len(pairs.configurations),
        int(pairs.clusters.max()) + 1,
        float(pairs.a.mean()),
        float(pairs.b.mean()),
        only_a,
        only_b,
        compare_policies(pairs, power),
        compare_trainings(pairs, power),
        "A" * (len(pairs.a) > 1) + "B" * (len(pairs.b) > 1),
        pairs.units,
    )


def _differs(a: Sequence[Outcomes], b: Sequence[Outcomes]) -> Iterator[str]:
    for name in WORTH_SAYING:
        values = [sorted({str(_value(o.setting.get(name))) for o in side}) for side in (a, b)]
        if values[0] != values[1]:
            yield f"{name}: {', '.join(values[0])} in A, {', '.join(values[1])} in B"
    for name, side in (("A", a), ("B", b)):
        steps = sorted({checkpoint for o in side if (checkpoint := run_and_checkpoint(o)[1]).isdigit()}, key=int)
        if len(steps) > 1:
            yield f"checkpoints of {name}: {', '.join(steps)}"


def _value(setting: Any) -> Any:
    """Of the packages those that move something."""
    if not isinstance(setting, dict):
        return setting
    return " ".join(f"{name} {setting.get(name)}" for name in ("lerobot_env_cronos", "mujoco", "torch"))


def to_json(a: Side, b: Side, suites: Sequence[PairedSuite], power: float) -> dict[str, Any]:
    """All of it as JSON values; a difference is B minus A."""
    return {
        "format": FORMAT,
        "a": [str(folder) for folder in a.folders],
        "b": [str(folder) for folder in b.folders],
        "alpha": ALPHA,
        "power": power,
        "left_out": a.notes + b.notes,
        "comparisons": [
            asdict(suite) | {"rows": [asdict(row) | {"more_episodes": row.more_episodes} for row in suite.rows]}
            for suite in suites
        ],
    }


def to_text(suites: Sequence[PairedSuite], power: float) -> str:
    """Tables for a terminal, and a sentence on what they decide."""
    return "\n\n".join(_suite_text(suite, power) for suite in suites)


def _suite_text(suite: PairedSuite, power: float) -> str:
    first = suite.rows[0]
    seeds = ", ".join(map(str, suite.seeds))
    kind = "episodes" if suite.suite == "independent" else "chains"
    lines = [
        f"{suite.suite} {suite.split}: {first.pairs} pairs of {kind} from {first.configurations} {first.units},"
        f" sampling seed {seeds}"
    ]
    lines += [f"  {name}: {', '.join(policies)}" for name, policies in (("A", suite.a), ("B", suite.b))]
    if suite.left_out:
        lines.append(f"  left out: {suite.left_out} that not all of them ran")
    lines += [f"  not alike: {phrase}" for phrase in suite.differs]
    lines += [f"  passed over: {phrase}" for phrase in suite.passed_over]
    table = [("", "A", "B", "B - A [95 % interval]", "p", "p (Holm)")]
    for row in suite.rows:
        shown = row.policies if row is first else row.most_general
        cells = (row.what, f"{row.a:.3f}", f"{row.b:.3f}", *_cells(shown))
        table.append((*cells, "" if row.p_holm is None else f"{row.p_holm:.2g}"))
        if row.trainings and row is first:
            which = "these" if row.sampled == "AB" else f"those of {row.sampled}"
            table.append((f"  trainings like {which}", "", "", *_cells(row.trainings), ""))
    widths = [max(len(line[i]) for line in table) for i in range(len(table[0]))]
    lines += ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in table]
    return "\n".join([*lines, *_sentences(first, power)])


def _cells(difference: Difference) -> tuple[str, str]:
    ends = difference.ci95
    interval = "" if ends is None else f" [{ends[0]:+.3f}, {ends[1]:+.3f}]"
    return f"{difference.value:+.3f}{interval}", "" if difference.p is None else f"{difference.p:.2g}"


def _sentences(row: PairedRow, power: float) -> Iterator[str]:
    """What the first row decides, and what a decision would take."""
    found = row.most_general
    of_what = row.of_what
    if found.is_separated:
        yield f"{'B' if found.value > 0 else 'A'} is better, of {of_what} (p = {found.p:.2g} < {ALPHA})."
    else:
        p = "" if found.p is None else f" (p = {found.p:.2g})"
        yield f"Not separated, of {of_what}{p}: this is no sign that they do alike."
        if found.detectable is not None:
            yield f"  A difference of about {found.detectable:.3f} would have been found with power {power}."
        if row.trainings and found.needed is not None:
            which = "of each side" if row.sampled == "AB" else f"of {row.sampled}"
            yield f"  One of {abs(found.value):.3f} takes at least {found.needed} trainings {which}."
        elif not row.trainings and row.more_episodes is not None:
            yield (
                f"  One of {abs(found.value):.3f} takes about {row.more_episodes} more episodes of each policy,"
                f" from {found.needed} {row.units} in all."
            )
    if row.trainings and row.sampled != "AB":
        yield "  Of other trainings of the single policy this says nothing."
    if not row.trainings:
        yield "  One training each: this says nothing of how they were trained."
    yield f"  Method: {row.policies.method}" + (f"; {row.trainings.method}." if row.trainings else ".")
