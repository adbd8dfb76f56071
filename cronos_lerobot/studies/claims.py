"""The table of all experiments: how much was run of each, and which of the paper's claims hold here.

    python -m cronos_lerobot.studies.claims          # write it anew, in docs/results.md
    python -m cronos_lerobot.studies.claims --check  # only say whether it is what the files say

The files are those that `cronos-reproduce` wrote, each in a folder of docs/results; the table stands between two
marks.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cronos_lerobot.experiments.columns import MISSING, WORDS
from cronos_lerobot.studies import marked_tables
from cronos_lerobot.studies.marked_tables import MarkedTable

RESULTS = Path("docs/results")
CLAIMS = MarkedTable("claims", Path("docs/results.md"), "cronos_lerobot.studies.claims")


def read_experiments(folder: Path) -> list[dict[str, Any]]:
    """What `cronos-reproduce` found, of every experiment below a folder that says whether the paper's claims hold.

    Those of version 0 do not; neither do those that are none of the paper's.
    """
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*/*.json"))]
    return [one for one in found if isinstance(one, dict) and one.get("orders")]


def make_table(experiments: list[dict[str, Any]]) -> str:
    """A line for each claim, in Markdown; the experiment stands before its first."""
    lines = [
        "| experiment | rows finished | seeds | steps | hours | the paper says | suite | here [95 %] | holds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for one in experiments:
        cells = _experiment(one)
        for order in one["orders"]:
            lines.append(f"| {' | '.join((*cells, *_claim(order)))} |")
            cells = ("",) * len(cells)
    return "\n".join(lines)


def _experiment(one: dict[str, Any]) -> tuple[str, ...]:
    begun = [row["seeds"] for row in one["rows"] if row["seeds"]]
    seeds = MISSING if not begun else "–".join(map(str, sorted({min(begun), max(begun)})))
    kind = "pixels" if one["obs_type"].startswith("pixels") else "state"
    name = f"{one['experiment']}, {one['scene']}, {kind}"
    return name, f"{len(begun)} of {len(one['rows'])}", seeds, f"{one['steps']:,}", f"{one['hours']:.1f}"


def _claim(order: dict[str, Any]) -> tuple[str, ...]:
    said = f"{order['row']} {WORDS[order['says']]} {order['reference']} ({order['where']})"
    suite = f"{order['suite']}, {order['split'].replace('_', '-')}"
    if order.get("difference") is None:
        return said, suite, MISSING, order["holds"]
    found = f"{order['difference']:+.3f}{order['unit']}"
    if order["ci95_low"] is not None:
        found += f" [{order['ci95_low']:+.3f}, {order['ci95_high']:+.3f}]"
    return said, suite, found + ", these policies" * (not order["of_trainings"]), order["holds"]


def main() -> None:
    """Entry point."""
    marked_tables.main(CLAIMS, lambda: make_table(read_experiments(RESULTS)), __doc__)


if __name__ == "__main__":
    main()
