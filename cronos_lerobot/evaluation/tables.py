"""The tables that `cronos-eval` prints: one for each suite, a column for each split."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rich.table import Table

from cronos_lerobot.evaluation.suites import INDEPENDENT, SEQUENTIAL, STREAM, SUITES, Start

Results = Mapping[str, Any]
"""One results.json."""
APART = {"found_complete": "found complete", "never_grasped": "never grasped"}
"""Successes for which nothing was picked up."""
CHAIN_KINDS = {"all orderings": None, "seen in training": "seen", "unseen": "unseen"}


def make_tables(results: Iterable[Results]) -> list[Table]:
    """Return a table for each suite among the results of some suites and splits."""
    by_suite: dict[str, list[Results]] = {suite: [] for suite in SUITES}
    for one in results:
        by_suite[one["suite"]].append(one)
    makers = {INDEPENDENT: _independent, SEQUENTIAL: _sequential, STREAM: _stream}
    return [makers[suite](splits) for suite, splits in by_suite.items() if splits]


def _independent(splits: Sequence[Results]) -> Table:
    table = _table("Independent: success of single tasks, 80 steps", "task", splits)
    for text in splits[0]["per_task"]:
        _row(table, text, [split["per_task"][text] for split in splits], _rate)
    table.add_section()
    _row(table, "all tasks", splits, _rate, "bold")
    table.add_section()
    for name, text in APART.items():
        _row(table, f"{text} [count]", splits, lambda split, name=name: str(split[name]))
    return table


def _sequential(splits: Sequence[Results]) -> Table:
    how = f"advance={splits[0]['advance']}, {_arm(splits[0])}"
    table = _table(f"Sequential: chains without a reset ({how})", "position", splits, " ± std over orderings")
    for title, kind in CHAIN_KINDS.items():
        parts = [split[kind] if kind else split for split in splits]
        if not any(parts):
            continue
        _row(table, title, parts, lambda part: f"n={part['n']}", "bold")
        for k in range(next(len(part["positions"]) for part in parts if part)):
            _row(table, f"SEQ {k}", parts, lambda part, k=k: _rate(part["positions"][k]))
        _row(table, "chain length", parts, lambda part: _number(part["average_chain_length"], "mean"))
        table.add_section()
    for name, text in APART.items():
        _row(
            table,
            f"{text} [count]",
            splits,
            lambda split, name=name: str(sum(p[name] for p in split["positions"])),
        )
    return table


def _stream(splits: Sequence[Results]) -> Table:
    title = f"Stream: {splits[0]['segments']} tasks in a row, nobody resets ({_arm(splits[0])})"
    table = _table(title, "segment", splits)
    for k in range(splits[0]["segments"]):
        _row(table, str(k + 1), [split["by_segment"][k] for split in splits], _rate)
    _row(table, "all segments", splits, _rate, "bold")
    _row(table, "not found complete", [split["done"] for split in splits], _rate, "bold")
    _row(table, "found complete", splits, lambda split: f"{split['share_found_complete']:.1%}")
    table.add_section()
    table.add_row("[bold]success by start (share of the segments)")
    for start in (start for start in reversed(Start) if start is not Start.COMPLETE):
        parts = [split["by_start"].get(start.value) for split in splits]
        if any(parts):
            _row(table, _words(start), parts, lambda part: f"{_rate(part)} ({part['share']:.0%})")
    table.add_section()
    _row(table, "streams stuck at the end", splits, lambda split: f"{split['stuck']['share']:.1%}", "bold")
    for start in Start:
        counts = [split["stuck"]["causes"].get(start.value, 0) for split in splits]
        if any(counts):
            table.add_row(f"  most begin {_words(start)} [count]", *map(str, counts))
    return table


def _words(start: str) -> str:
    return start.replace("_", " ")


def _arm(results: Results) -> str:
    return f"end_effector_reset={str(results['end_effector_reset']).lower()}"


def _table(title: str, first: str, splits: Sequence[Results], spread: str = "") -> Table:
    caption = f"mean{spread} [95 % interval]; intervals are clustered by configuration"
    table = Table(title=title, caption=caption, title_justify="left", caption_justify="left")
    table.add_column(first)
    for split in splits:
        table.add_column(f"{split['split']} (n={split['n']})", justify="right", no_wrap=True)
    return table


def _row(
    table: Table, name: str, parts: Sequence[Any], cell: Callable[[Any], str], style: str | None = None
) -> None:
    """A row with a cell for each split; None has none."""
    table.add_row(name, *("" if part is None else cell(part) for part in parts), style=style)


def _rate(rate: Mapping[str, Any]) -> str:
    return _number(rate, "success")


def _number(spread: Mapping[str, Any], name: str) -> str:
    low, high = spread["ci95"]
    std = spread.get("std")
    return f"{spread[name]:.3f}" + (f" ± {std:.3f}" if std is not None else "") + f" [{low:.3f}, {high:.3f}]"
