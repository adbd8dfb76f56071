"""Which of the paper's sentences about two rows hold here: a paired difference behind each word."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from cronos_lerobot.experiments.differences import RowDifference, compare
from cronos_lerobot.experiments.results import ExperimentResult, RowResult, paper_results
from cronos_lerobot.report.paired import ALPHA

MARGIN = 0.05
"""Rows are alike if the whole interval of their difference is within this of zero."""
CEILING = 0.95
"""Where the base policies of both rows do as much on the training configurations, nothing is left to learn."""
YES, NO, UNDECIDED, NOT_SEPARATED, NOT_RUN = "yes", "no", "undecided", "not separated", "not run"
NOT_APPLICABLE = "not applicable"


@dataclass(frozen=True)
class Order:
    """What the paper says of two rows at the end of their runs, and what is found here."""

    row: str
    reference: str
    says: str
    """Of the row, beside the reference: higher, lower or alike."""
    where: str
    """Section of the paper."""
    suite: str = "independent"
    split: str = "train"
    found: RowDifference | None = None
    """None where one of the two has no finished run, or no such evaluation."""
    reason: str = ""
    """Why the difference says nothing of the sentence."""

    @property
    def unit(self) -> str:
        """Of the difference: chains are compared by their length, all else by success rates."""
        return " tasks" if self.suite == "sequential" else ""

    @property
    def holds(self) -> str:
        """`yes` and `no` where p < .05; of rows alike, where their interval is within `MARGIN`, or beyond it.

        Rows that are said to do alike and differ, nobody knows whether by more than the margin, are `undecided`.
        Those whose base policies leave nothing to learn are `not applicable`, whatever is found.
        """
        if self.reason:
            return NOT_APPLICABLE
        if self.found is None:
            return NOT_RUN
        value, p, ends = self.found.difference.value, self.found.difference.p, self.found.difference.ci95
        separated = p is not None and p < ALPHA
        if self.says == "alike":
            low, high = ends or (-math.inf, math.inf)
            if max(-low, high) <= MARGIN:
                return YES
            if max(low, -high) > MARGIN:
                return NO
            return UNDECIDED if separated else NOT_SEPARATED
        if not separated:
            return NOT_SEPARATED
        return YES if (value > 0) == (self.says == "higher") else NO


def paper_orders(result: ExperimentResult) -> list[Order]:
    """The paper's sentences about rows of an experiment that are among `result`'s."""
    rows = {row.row.name: row for row in result.rows}
    orders = [Order(**said) for said in paper_results()["orders"].get(result.experiment.name, ())]
    return [
        replace(
            one,
            found=compare(rows[one.row], rows[one.reference], one.suite, one.split),
            reason=_nothing_to_learn(rows[one.row], rows[one.reference]),
        )
        for one in orders
        if one.row in rows and one.reference in rows
    ]


def _nothing_to_learn(*rows: RowResult) -> str:
    starts = [[curve[0].success for seed in row.finished if (curve := seed.curve("train"))] for row in rows]
    if not all(starts):
        return ""
    least = min(float(np.mean(of_row)) for of_row in starts)
    return f"the base policy does {least:.3f} from the start" if least >= CEILING else ""
