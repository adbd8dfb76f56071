"""Numbers of an evaluation, from the outcomes of its chains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from lerobot_env_cronos.benchmark.orderings import Ordering
from lerobot_env_cronos.scene.scenes import Task
from rich.table import Table

from cronos_lerobot.evaluation.rates import SuccessRate

Record = dict[str, Any]
"""Outcome of a chain, see `store.chain_records`."""


def independent_results(records: Sequence[Record], tasks: Sequence[Task]) -> dict[str, Any]:
    """Success of all tasks together and of each, with n and a 95 % Wilson interval."""
    by_task = {
        task.instruction: SuccessRate.of(r for r in records if r["number"] == i) for i, task in enumerate(tasks)
    }
    overall = SuccessRate.of(records)
    return overall.to_dict() | {"per_task": {text: rate.to_dict() for text, rate in by_task.items()}}


def sequential_results(records: Sequence[Record], orderings: Sequence[Ordering]) -> dict[str, Any]:
    """Success at each position and the average chain length.

    A task counts as a failure where an earlier one of its chain failed, so every position has all chains. `std` is
    the sample standard deviation over the orderings, each of them first averaged over its configurations; null for
    a single ordering. The interval of the chain length, which is the sum of the positions' rates, is the sum of
    their Wilson intervals: positions of one chain go together, and this assumes that they do so completely.

    Args:
        records: of the chains of whole orderings.
        orderings: of the scene; those without a record are left out.
    """
    numbers = sorted({r["number"] for r in records})
    num_tasks = len(orderings[0])
    # (orderings, chains, positions)
    success = [
        np.array([[r["length"] > k for k in range(num_tasks)] for r in records if r["number"] == i])
        for i in numbers
    ]
    rates = np.array([outcomes.mean(axis=0) for outcomes in success])
    positions = []
    for k in range(num_tasks):
        positions.append(SuccessRate.of(records, k).to_dict() | {"std": _std(rates[:, k])})
    lengths = np.array([r["length"] for r in records])
    return {
        "n": len(records),
        "positions": positions,
        "average_chain_length": {
            "mean": float(lengths.mean()),
            "std": _std(rates.sum(axis=1)),
            "ci95": np.sum([position["ci95"] for position in positions], axis=0).tolist(),
        },
        "per_ordering": [
            {
                "ordering": i,
                "tasks": [task.instruction for task in orderings[i]],
                "n": len(outcomes),
                "positions": rate.tolist(),
                "average_chain_length": float(rate.sum()),
            }
            for i, outcomes, rate in zip(numbers, success, rates, strict=True)
        ],
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
        tables.append(table)
    if sequential := results.get("sequential"):
        options = f"advance={results['advance']}, end_effector_reset={str(results['end_effector_reset']).lower()}"
        table = _table(f"Sequential: chains without a reset ({options})", sequential, "position")
        for k in range(len(next(iter(sequential.values()))["positions"])):
            table.add_row(f"SEQ {k}", *(_rate(split["positions"][k]) for split in sequential.values()))
        table.add_section()
        lengths = [split["average_chain_length"] for split in sequential.values()]
        table.add_row("chain length", *(_number(x["mean"], x) for x in lengths), style="bold")
        tables.append(table)
    return tables


def _table(title: str, splits: dict[str, Any], first: str) -> Table:
    spread = " ± std over orderings" if first == "position" else ""
    caption = f"mean{spread} [95 % interval]"
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
