"""Which rows of an experiment differ: every two of them compared on the same episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from cronos_lerobot.experiments.results import ExperimentResult, RowResult
from cronos_lerobot.report.compared_sides import Side, last_evaluation
from cronos_lerobot.report.paired import Difference, holm
from cronos_lerobot.report.paired_report import compare_sides

POWER = 0.8
"""With which a difference would be found that is given as detectable."""


@dataclass(frozen=True)
class RowDifference:
    """Success of one row minus that of a reference, at the end of their runs."""

    row: RowResult
    reference: RowResult
    difference: Difference
    """Of trainings like these where a row has several seeds, else of these policies."""
    episodes: int
    """Of each run's last evaluation, paired."""
    p_holm: float
    """p adjusted for as many comparisons as there are with this reference."""

    @property
    def of_trainings(self) -> bool:
        """Whether it speaks of trainings, not of two policies."""
        return len(self.row.finished) > 1 or len(self.reference.finished) > 1


def differences_to_first(result: ExperimentResult) -> list[RowDifference]:
    """Every finished row against the first one of the same kind of base policy, as the experiment lists them."""
    found = []
    for base in dict.fromkeys(row.row.base for row in result.rows):
        reference, *others = [row for row in result.rows if row.row.base == base]
        found += compare_rows([(reference, row) for row in others])
    return found


def all_differences(result: ExperimentResult) -> list[RowDifference]:
    """Every two finished rows, the later against the earlier one."""
    return compare_rows(list(combinations(result.rows, 2)))


def compare_rows(pairs: Sequence[tuple[RowResult, RowResult]]) -> list[RowDifference]:
    """Compare pairs of a reference and a row, where both have finished seeds whose episodes are on record."""
    found = [(row, reference, paired) for reference, row in pairs if (paired := _compare(reference, row))]
    adjusted = holm([1.0 if difference.p is None else difference.p for _, _, (difference, _) in found])
    return [
        RowDifference(row, reference, difference, episodes, p)
        for (row, reference, (difference, episodes)), p in zip(found, adjusted, strict=True)
    ]


def _compare(reference: RowResult, row: RowResult) -> tuple[Difference, int] | None:
    try:
        first = compare_sides(_side(reference), _side(row), POWER)[0].rows[0]
    except ValueError:
        return None
    return first.most_general, first.pairs


def _side(row: RowResult) -> Side:
    return Side((), [], [last_evaluation(seed.run) for seed in row.finished])
