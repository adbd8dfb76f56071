"""The table of the paper's experiments: how much was run of each, and which of the paper's claims hold here.

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
from cronos_lerobot.experiments.definitions import EXPERIMENTS, Experiment
from cronos_lerobot.experiments.orders import NOT_RUN
from cronos_lerobot.experiments.results import paper_results
from cronos_lerobot.experiments.scales import OBS_NAMES
from cronos_lerobot.studies import marked_tables
from cronos_lerobot.studies.marked_tables import MarkedTable

RESULTS = Path("docs/results")
CLAIMS = MarkedTable("claims", Path("docs/results.md"), "cronos_lerobot.studies.claims")


def read_experiments(folder: Path) -> list[dict[str, Any]]:
    """What `cronos-reproduce` found, of every experiment of the paper below a folder, in the paper's order.

    What was found of one experiment comes from the state before from pixels, and the longest runs first.
    Files of version 0 do not say whether the paper's claims hold, and are left out.
    """
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*/*.json"))]
    of_this_version = [one for one in found if isinstance(one, dict) and "orders" in one]
    of_this_version.sort(key=lambda one: (list(OBS_NAMES).index(one["obs_type"]), -one["steps"]))
    return [one for name in of_the_paper() for one in of_this_version if one["experiment"] == name]


def of_the_paper() -> dict[str, Experiment]:
    """The experiments that repeat a table or a figure of the paper."""
    return {name: experiment for name, experiment in EXPERIMENTS.items() if experiment.source}


def make_table(experiments: list[dict[str, Any]]) -> str:
    """A line for each claim, in Markdown; the experiment stands before its first.

    One for each experiment of the paper that is not among `experiments` says so.
    """
    lines = [
        "| experiment | rows | seeds | steps | hours | the paper says | suite | here [95 %] | holds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, experiment in of_the_paper().items():
        found = [one for one in experiments if one["experiment"] == name]
        for one in found:
            cells = _experiment(one)
            for claim in _claims(one["orders"]):
                lines.append(f"| {' | '.join((*cells, *claim))} |")
                cells = ("",) * len(cells)
        if not found:
            lines.append(f"| {' | '.join(_not_run(experiment))} |")
    return "\n".join(lines)


def _experiment(one: dict[str, Any]) -> tuple[str, ...]:
    begun = [row["seeds"] for row in one["rows"] if row["seeds"]]
    seeds = "–".join(map(str, sorted({min(begun), max(begun)}))) if begun else "0"
    name = f"{one['experiment']}, {one['scene']}, {OBS_NAMES[one['obs_type']]}"
    rows, seeds = f"{len(begun)} of {len(one['rows'])}", f"{seeds} of {len(one['seeds'])}"
    return name, rows, seeds, f"{one['steps']:,}", f"{one['hours']:.1f}"


def _not_run(experiment: Experiment) -> tuple[str, ...]:
    """How many sentences of the paper an experiment would tell of."""
    said = _sentences(len(paper_results()["orders"].get(experiment.name, ())))
    rows = f"0 of {len(experiment.rows)}"
    return f"{experiment.name}, {experiment.scene}", rows, *(MISSING,) * 3, said, *(MISSING,) * 2, NOT_RUN


def _claims(orders: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """A line each, or one for all if none of them has its two rows."""
    if all(order["holds"] == NOT_RUN for order in orders):
        return [(_sentences(len(orders)), MISSING, MISSING, NOT_RUN if orders else MISSING)]
    return [_claim(order) for order in orders]


def _sentences(number: int) -> str:
    return f"{number} sentence{'s' * (number > 1)}" if number else MISSING


def _claim(order: dict[str, Any]) -> tuple[str, ...]:
    said = f"{order['row']} {WORDS[order['says']]} {order['reference']} ({order['where']})"
    suite = f"{order['suite']}, {order['split'].replace('_', '-')}"
    # Files of before there was a reason have none.
    reason = order.get("not_applicable")
    holds = order["holds"] + (f": {reason}" if reason else "")
    if order.get("difference") is None:
        return said, suite, MISSING, holds
    found = f"{order['difference']:+.3f}{order['unit']}"
    if order["ci95_low"] is not None:
        found += f" [{order['ci95_low']:+.3f}, {order['ci95_high']:+.3f}]"
    return said, suite, found + ", these policies" * (not order["of_trainings"]), holds


def main() -> None:
    """Entry point."""
    marked_tables.main(CLAIMS, lambda: make_table(read_experiments(RESULTS)), __doc__)


if __name__ == "__main__":
    main()
