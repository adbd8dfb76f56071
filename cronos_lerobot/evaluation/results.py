"""Numbers of an evaluation, from the outcomes of its chains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from lerobot_env_cronos.benchmark.orderings import Ordering, is_training_cycle
from lerobot_env_cronos.scene.scenes import Scene, Task
from rich.table import Table

from cronos_lerobot.evaluation.rates import SuccessRate, cluster_interval, effective_trials

Record = dict[str, Any]
"""Outcome of a chain, see `store.chain_records`."""


def independent_results(records: Sequence[Record], tasks: Sequence[Task]) -> dict[str, Any]:
    """Success of all tasks together and of each, with n and a 95 % Wilson interval."""
    by_task = {
        task.instruction: SuccessRate.of(r for r in records if r["number"] == i) for i, task in enumerate(tasks)
    }
    overall = SuccessRate.of(records)
    return overall.to_dict() | {"per_task": {text: rate.to_dict() for text, rate in by_task.items()}}


def sequential_results(records: Sequence[Record], orderings: Sequence[Ordering], scene: Scene) -> dict[str, Any]:
    """Success by position and the average chain length: of all orderings, and apart for those seen in training.

    Args:
        records: of the chains of whole orderings.
        orderings: of the scene; those without a record are left out.
        scene: in whose training cycle streams run its tasks without end; an ordering is `seen` if it is a piece of
            that (`is_training_cycle`).
    """
    numbers = sorted({r["number"] for r in records})
    seen = [i for i in numbers if is_training_cycle(orderings[i], scene)]
    unseen = [i for i in numbers if i not in seen]
    num_tasks = len(orderings[0])
    kinds = {
        name: _summary([r for r in records if r["number"] in some], num_tasks) if some else None
        for name, some in (("seen", seen), ("unseen", unseen))
    }
    per_ordering = []
    for i in numbers:
        lengths = np.array([r["length"] for r in records if r["number"] == i])
        per_ordering.append(
            {
                "ordering": i,
                "tasks": [task.instruction for task in orderings[i]],
                "seen": i in seen,
                "n": len(lengths),
                "positions": [float((lengths > k).mean()) for k in range(num_tasks)],
                "average_chain_length": float(lengths.mean()),
            }
        )
    return _summary(records, num_tasks) | kinds | {"per_ordering": per_ordering}


def _summary(records: Sequence[Record], num_tasks: int) -> dict[str, Any]:
    """Success at each position and the chain length of some orderings' chains.

    A task counts as a failure where an earlier one of its chain failed, so every position has all chains. The
    chains of a configuration go together in all orderings, so intervals are by configuration (`cluster_interval`).
    `std` is the sample standard deviation over the orderings, each of them first averaged over its configurations;
    null for a single ordering. The interval of the chain length, which is the sum of the positions' rates, is the
    sum of theirs: positions of one chain go together, and this assumes that they do so completely.
    """
    lengths, numbers, configurations = (
        np.array([r[name] for r in records]) for name in ("length", "number", "configuration")
    )
    orderings = np.unique(numbers)
    positions = []
    for k in range(num_tasks):
        success = lengths > k
        spread = _std(np.array([success[numbers == i].mean() for i in orderings]))
        by_cluster = {
            "ci95": list(cluster_interval(success, configurations)),
            "effective_n": effective_trials(success, configurations),
        }
        positions.append(SuccessRate.of(records, k).to_dict() | by_cluster | {"std": spread})
    return {
        "n": len(records),
        "orderings": len(orderings),
        "configurations": len(np.unique(configurations)),
        "positions": positions,
        "average_chain_length": {
            "mean": float(lengths.mean()),
            "std": _std(np.array([lengths[numbers == i].mean() for i in orderings])),
            "ci95": np.sum([position["ci95"] for position in positions], axis=0).tolist(),
        },
    }


def _std(values: np.ndarray) -> float | None:
    return float(values.std(ddof=1)) if len(values) > 1 else None


def make_tables(results: dict[str, Any]) -> list[Table]:
    """One table for each suite, a column for each split."""
    tables = []
    if independent := results.get("independent"):
        table = _table("Independent: success of single tasks, 80 steps", independent, "task")
        for text in next(iter(independent.values()))["per_task"]:
            table.add_row(text, *(_rate(split["per_task"][text]) for split in independent.values()))
        table.add_section()
        table.add_row("all tasks", *(_rate(split) for split in independent.values()), style="bold")
        table.add_section()
        _add_apart(table, list(independent.values()))
        tables.append(table)
    if sequential := results.get("sequential"):
        options = f"advance={results['advance']}, end_effector_reset={str(results['end_effector_reset']).lower()}"
        table = _table(f"Sequential: chains without a reset ({options})", sequential, "position")
        for title, kind in CHAIN_KINDS.items():
            parts = [split[kind] if kind else split for split in sequential.values()]
            if any(parts):
                _add_chains(table, title, parts)
        found = [split["positions"] for split in sequential.values()]
        _add_apart(table, [{name: sum(p[name] for p in ps) for name in APART} for ps in found])
        tables.append(table)
    return tables


CHAIN_KINDS = {"all orderings": None, "seen in training": "seen", "unseen": "unseen"}
APART = {"found_complete": "found complete", "never_grasped": "never grasped"}
"""Successes for which nothing was picked up."""


def _add_chains(table: Table, title: str, parts: Sequence[dict[str, Any] | None]) -> None:
    """SEQ 0, 1, ... and the chain length of some orderings, a column for each split; None has no chains."""

    def row(name: str, cell: Callable[[dict[str, Any]], str], style: str | None = None) -> None:
        table.add_row(name, *("" if part is None else cell(part) for part in parts), style=style)

    row(title, lambda part: f"n={part['n']}", "bold")
    num_tasks = next(len(part["positions"]) for part in parts if part)
    for k in range(num_tasks):
        row(f"SEQ {k}", lambda part, k=k: _rate(part["positions"][k]))
    row("chain length", lambda part: _number(part["average_chain_length"]["mean"], part["average_chain_length"]))
    table.add_section()


def _add_apart(table: Table, counts: Sequence[dict[str, int]]) -> None:
    """Of all successes, those that were found complete and those without a grasp."""
    for name, text in APART.items():
        table.add_row(f"{text} [count]", *(str(count[name]) for count in counts))


def _table(title: str, splits: dict[str, Any], first: str) -> Table:
    spread = " ± std over orderings" if first == "position" else ""
    caption = f"mean{spread} [95 % interval]"
    if first == "position":
        caption += "; intervals by configuration, as its chains go together"
    table = Table(title=title, caption=caption, title_justify="left", caption_justify="left")
    table.add_column(first)
    for name, split in splits.items():
        table.add_column(f"{name} (n={split['n']})", justify="right", no_wrap=True)
    return table


def _rate(rate: dict[str, Any]) -> str:
    return _number(rate["success"], rate)


def _number(mean: float, spread: dict[str, Any]) -> str:
    low, high = spread["ci95"]
    std = spread.get("std")
    return f"{mean:.3f}" + (f" ± {std:.3f}" if std is not None else "") + f" [{low:.3f}, {high:.3f}]"
