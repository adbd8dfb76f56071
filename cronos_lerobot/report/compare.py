"""`cronos-report compare`: what two sides did on the same episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cronos_lerobot.report.load import CRONOS_EVAL, TRAIN, load
from cronos_lerobot.report.paired import (
    ALPHA,
    POWER,
    Difference,
    Pairs,
    compare_policies,
    compare_trainings,
    holm,
    pair,
)
from cronos_lerobot.report.tables import is_at_end

AGREE = ("scene", "environment", "benchmark")
"""Settings that two evaluations of the same episodes share."""
AGREE_IN_CHAINS = ("advance", "end_effector_reset")
"""Settings that chains of tasks share as well."""
WORTH_SAYING = ("temperature", "obs_type", "renderer", "versions")
"""Settings that may differ, and are reported."""
FORMAT = 2
"""Of the JSON values."""


@dataclass(frozen=True)
class Row:
    """One number of both sides: of all episodes, of a task, or of a position in a chain."""

    what: str
    a: float
    b: float
    policies: Difference
    """Of these very policies."""
    trainings: Difference | None
    """Of trainings like these; None with fewer than three."""
    p_holm: float | None = None
    """p of a single task or position, adjusted for as many tests."""

    @property
    def most_general(self) -> Difference:
        """Of trainings, if there are enough."""
        return self.trainings or self.policies


@dataclass(frozen=True)
class Comparison:
    """Two sides on one suite and split. The first row is of all tasks, or the chain length."""

    suite: str
    split: str
    a: list[str]
    """Policies."""
    b: list[str]
    pairs: int
    clusters: int
    unit: str
    """What a cluster is."""
    left_out: int
    """Episodes that not all policies have."""
    differs: list[str]
    """Settings in which the sides differ, a phrase for each."""
    rows: list[Row]


def read_side(folder: Path) -> tuple[pd.DataFrame, list[str]]:
    """Read the evaluations of one side: by cronos-eval, and the last periodic one of each run of cronos-train.

    Returns:
        see `load.load_evaluations`, and what is left out, a sentence for each.

    Raises:
        FileNotFoundError: the folder is missing or holds nothing.
        ValueError: nothing can be compared, or the runs are not seeds of one experiment.
    """
    loaded = load([folder])
    found = loaded.evaluations
    found = found[found["source"].isin([CRONOS_EVAL, TRAIN])]
    if found.empty:
        raise ValueError(f"{folder} holds no evaluation of cronos-eval and no run that was evaluated")
    rows = [str(label) for label in found[found["source"] == TRAIN]["row"].unique()]
    if len(rows) > 1:
        raise ValueError(f"{folder} holds runs of {len(rows)} experiments, not seeds of one: {'; '.join(rows)}")
    notes = list(loaded.left_out)
    is_own = found["source"] == TRAIN
    last = found[is_own].groupby("folder").tail(1)
    whole = is_at_end(last)
    for _, early in last[~whole].iterrows():
        notes.append(
            f"{early['folder']}: its last evaluation is after {early['steps']:,} steps, earlier than others"
        )
    return pd.concat([found[~is_own], last[whole]]), notes


def compare_sides(a: pd.DataFrame, b: pd.DataFrame) -> list[Comparison]:
    """Compare two sides on every suite and split that both have.

    Raises:
        ValueError: they share none, their episodes cannot be paired, or one policy is on both sides.
    """
    keys = [list(dict.fromkeys(zip(side["suite"], side["split"], strict=True))) for side in (a, b)]
    common = [key for key in keys[0] if key in keys[1]]
    if not common:
        raise ValueError(f"no suite and split is in both: A has {keys[0]}, B has {keys[1]}")
    return [_compare(_policies(a, *key), _policies(b, *key), *key) for key in common]


def _policies(side: pd.DataFrame, suite: str, split: str) -> pd.DataFrame:
    """One evaluation for each policy: by cronos-eval, unless more runs have one of their own."""
    some = side[(side["suite"] == suite) & (side["split"] == split)]
    evaluated, own = (some[some["source"] == source] for source in (CRONOS_EVAL, TRAIN))
    chosen = own if evaluated["fingerprint"].nunique() < len(own) else evaluated
    merged = chosen.groupby("fingerprint", sort=False).agg(
        dict.fromkeys(("policy", "setting", "parts", "steps", "trained_in"), "first") | {"episodes": list}
    )
    runs = merged["trained_in"][merged["trained_in"] != ""]
    if len(twice := runs[runs.duplicated()]):
        raise ValueError(f"{twice.iloc[0]} has evaluations of several checkpoints: name the folder of one")
    return merged.assign(episodes=merged["episodes"].map(np.concatenate)).reset_index()


def _compare(a: pd.DataFrame, b: pd.DataFrame, suite: str, split: str) -> Comparison:
    everyone = pd.concat([a, b])
    are_chains = suite != "independent"
    for name in (*AGREE, *(AGREE_IN_CHAINS if are_chains else ())):
        values = dict.fromkeys(str(setting[name]) for setting in everyone["setting"])
        if len(values) > 1:
            raise ValueError(
                f"{suite} {split}: evaluations of another {name} cannot be paired: {', '.join(values)}"
            )
    if same := set(a["fingerprint"]) & set(b["fingerprint"]):
        name = a.set_index("fingerprint").loc[same.pop(), "policy"]
        if not list(_differs(a, b)):
            raise ValueError(f"A and B both have {name}, evaluated alike: there is nothing to compare")
    pairs, numbers = pair(list(a["episodes"]), list(b["episodes"]), are_chains=are_chains)
    distinct = {tuple(episode[:3]) for episodes in everyone["episodes"] for episode in episodes}
    return Comparison(
        suite,
        split,
        list(a["policy"]),
        list(b["policy"]),
        len(numbers),
        pairs.k,
        pairs.unit,
        len(distinct) - len(numbers),
        list(_differs(a, b)),
        list(_rows(pairs, numbers, suite, [part["part"] for part in a["parts"].iloc[0]])),
    )


def _rows(pairs: Pairs, numbers: np.ndarray, suite: str, names: list[str]) -> Iterator[Row]:
    first = {"independent": "all tasks", "sequential": "chain length", "stream": "tasks done"}[suite]
    parts: dict[str, Pairs] = {}
    if suite == "independent":
        parts = {names[i]: pairs.part(numbers == i) for i in np.unique(numbers)}
    elif suite == "sequential":
        positions = [name for name in dict.fromkeys(names) if name.startswith("SEQ")]
        parts = {name: pairs.reached(k) for k, name in enumerate(positions)}
    yield _row(first, pairs)
    rows = [_row(what, part) for what, part in parts.items()]
    adjusted = holm([row.most_general.p for row in rows])
    for row, p in zip(rows, adjusted, strict=True):
        yield Row(row.what, row.a, row.b, row.policies, row.trainings, p)


def _row(what: str, pairs: Pairs) -> Row:
    means = float(pairs.a.mean()), float(pairs.b.mean())
    return Row(what, *means, compare_policies(pairs), compare_trainings(pairs))


def _differs(a: pd.DataFrame, b: pd.DataFrame) -> Iterator[str]:
    for name in WORTH_SAYING:
        values = [sorted({str(setting[name]) for setting in side["setting"]}) for side in (a, b)]
        if values[0] != values[1]:
            yield f"{name}: {', '.join(values[0])} in A, {', '.join(values[1])} in B"


def to_json(comparisons: list[Comparison], notes: list[str]) -> dict[str, Any]:
    """All of it as JSON values; a difference is B minus A."""
    head = {"format": FORMAT, "alpha": ALPHA, "power": POWER, "left_out": notes}
    return head | {"comparisons": [asdict(comparison) for comparison in comparisons]}


def to_text(comparisons: list[Comparison]) -> str:
    """Tables for a terminal, and a sentence on what they decide."""
    return "\n\n".join("\n".join(_lines(one)) for one in comparisons)


def _lines(one: Comparison) -> Iterator[str]:
    kind = "episodes" if one.suite == "independent" else "chains"
    yield f"{one.suite} {one.split}: {one.pairs} pairs of {kind} from {one.clusters} {one.unit}s"
    yield f"  A: {', '.join(one.a)}"
    yield f"  B: {', '.join(one.b)}"
    if one.left_out:
        yield f"  left out: {one.left_out} {kind} that not all policies have"
    yield from (f"  differs: {phrase}" for phrase in one.differs)
    table = pd.DataFrame(
        {
            "": [row.what for row in one.rows],
            "A": [f"{row.a:.3f}" for row in one.rows],
            "B": [f"{row.b:.3f}" for row in one.rows],
            "B - A [95 % interval]": [_signed(row.most_general) for row in one.rows],
            "p": [f"{row.most_general.p:.2g}" for row in one.rows],
            "p (Holm)": ["" if row.p_holm is None else f"{row.p_holm:.2g}" for row in one.rows],
        }
    )
    yield table.to_string(index=False)
    yield from _decision(one)


def _signed(found: Difference) -> str:
    ends = "" if found.ci95 is None else f" [{found.ci95[0]:+.3f}, {found.ci95[1]:+.3f}]"
    return f"{found.value:+.3f}{ends}"


def _decision(one: Comparison) -> Iterator[str]:
    first = one.rows[0]
    found = first.most_general
    which = "trainings like these" if first.trainings else "these policies"
    if found.p < ALPHA:
        yield f"{'B' if found.value > 0 else 'A'} is better, of {which} (p = {found.p:.2g} < {ALPHA})."
    else:
        yield f"No significant difference of {which} (p = {found.p:.2g}): inconclusive, not evidence of equality."
        if found.detectable is not None:
            yield f"A difference of about {found.detectable:.3f} would have been found with power {POWER}."
    if not first.trainings:
        yield "Fewer than three trainings on each side: this says nothing about other trainings."
    elif 1 in (len(one.a), len(one.b)):
        yield "The side of one policy is taken as it is: this says nothing about other trainings of it."
    yield f"Method: {found.method}."
