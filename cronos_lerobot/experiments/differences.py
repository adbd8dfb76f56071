"""Which rows of an experiment differ: two of them compared on the same episodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

from cronos_lerobot.evaluation.outcomes import Outcomes
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
    """Of trainings like these where both rows have several seeds, else of these policies."""
    of_trainings: bool
    seeds: tuple[int, int]
    """Runs of the row and of the reference whose last evaluation tells how each episode ended."""
    episodes: int
    """Of each run's last evaluation, paired."""
    p_holm: float
    """p adjusted for as many comparisons as were made together."""


def differences_to_first(result: ExperimentResult) -> list[RowDifference]:
    """Every finished row against the first finished one that begins with the same base policy."""
    groups: dict[object, list[RowResult]] = {}
    for row in _finished(result):
        groups.setdefault(row.row.begins_with(result.experiment.scene), []).append(row)
    return compare_rows([(rows[0], row) for rows in groups.values() for row in rows[1:]])


def all_differences(result: ExperimentResult) -> list[RowDifference]:
    """Every two finished rows, the later against the earlier one."""
    return compare_rows(list(combinations(_finished(result), 2)))


def compare_rows(pairs: Sequence[tuple[RowResult, RowResult]]) -> list[RowDifference]:
    """Compare pairs of a reference and a row, those left out whose runs were evaluated on other episodes."""
    found = [(row, reference, paired) for reference, row in pairs if (paired := _compare(reference, row))]
    adjusted = holm([1.0 if paired[0].p is None else paired[0].p for _, _, paired in found])
    return [
        RowDifference(row, reference, *paired, p)
        for (row, reference, paired), p in zip(found, adjusted, strict=True)
    ]


def _finished(result: ExperimentResult) -> Iterable[RowResult]:
    return [row for row in result.rows if _outcomes(row)]


def _compare(reference: RowResult, row: RowResult) -> tuple[Difference, bool, tuple[int, int], int] | None:
    sides = _outcomes(row), _outcomes(reference)
    if len({frozenset(outcomes.lengths) for outcomes in (*sides[0], *sides[1])}) > 1:
        return None
    first = compare_sides(Side((), [], sides[1]), Side((), [], sides[0]), POWER)[0].rows[0]
    seeds = len(sides[0]), len(sides[1])
    # With one seed nothing is known of how much its trainings differ.
    several = min(seeds) > 1 and first.trainings is not None
    difference = first.trainings if several and first.trainings else first.policies
    return difference, several, seeds, first.pairs


def _outcomes(row: RowResult) -> list[Outcomes]:
    found = []
    for seed in row.finished:
        # A run may have none, or have been evaluated when episodes were not kept.
        with suppress(ValueError):
            found.append(last_evaluation(seed.run))
    return found
