"""Which rows of an experiment differ: two of them compared on the same episodes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cronos_lerobot.evaluation.outcomes import Outcomes, read_outcomes, what_differs
from cronos_lerobot.experiments.results import ExperimentResult, RowResult
from cronos_lerobot.report.compared_sides import Side, last_evaluation, paired_episodes, periodic_evaluation
from cronos_lerobot.report.paired import Difference, Pairs, compare_policies, compare_trainings
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
    seeds: tuple[int, int]
    """Runs of the row and of the reference that were compared."""
    episodes: int
    """Of each run's last evaluation, paired."""

    @property
    def of_trainings(self) -> bool:
        """Whether it speaks of trainings; with one seed nothing is known of how much they differ."""
        return min(self.seeds) > 1


@dataclass(frozen=True)
class Gain:
    """Success at the ends of a row's runs minus that of the base policies that they began with."""

    row: RowResult
    before: float
    after: float
    difference: Difference
    """Of trainings like these from these bases where there are several seeds, else of these policies."""
    seeds: int
    episodes: int
    """Of each evaluation, paired."""

    @property
    def of_trainings(self) -> bool:
        """Whether it speaks of trainings."""
        return self.seeds > 1


def gains(result: ExperimentResult) -> list[Gain]:
    """The gain of every row with finished runs whose own evaluations, from step 0 on, are of the same episodes."""
    return [gain for row in result.rows if (gain := _gain(row))]


def _gain(row: RowResult) -> Gain | None:
    runs = []
    for seed in row.finished:
        if seed.run.evaluations and seed.run.evaluations[0]["interaction_steps"] == 0:
            with suppress(ValueError):
                runs.append((periodic_evaluation(seed.run, 0), last_evaluation(seed.run)))
    if not runs:
        return None
    sides = list(zip(*runs, strict=True))
    try:
        episodes = paired_episodes(sides, "independent", "train")
    except ValueError:
        # Another version's, or of another benchmark.
        return None
    before, after = (np.array([[o.lengths[e] for e in episodes] for o in side]) for side in sides)
    if len(runs) == 1:
        difference = compare_policies(Pairs.of(before, after, episodes), POWER)
    else:
        # Each run against its own base: what differs from seed to seed is the gain.
        gained = Pairs.of(np.zeros((1, len(episodes)), int), after - before, episodes)
        difference = compare_trainings(gained, POWER)
        assert difference is not None, "there are several trainings"
    return Gain(row, float(before.mean()), float(after.mean()), difference, len(runs), len(episodes))


def compare_rows(result: ExperimentResult) -> list[RowDifference]:
    """Every two finished rows that were evaluated on the same episodes, the later against the earlier one."""
    finished = [row for row in result.rows if row.finished]
    found = (compare(row, reference) for reference, row in combinations(finished, 2))
    return [one for one in found if one]


def compare(
    row: RowResult, reference: RowResult, suite: str = "independent", split: str = "train"
) -> RowDifference | None:
    """A row against another at the end of their runs; None unless all of them ran the same episodes.

    Of seeds that both have, if there are any: the runs of a seed are made side by side and begin with one clone.
    """
    found = [_outcomes(one, suite, split) for one in (reference, row)]
    shared = found[0].keys() & found[1].keys()
    sides = [[some[seed] for seed in some if seed in shared or not shared] for some in found]
    runs = [one for side in sides for one in side]
    if not all(sides) or len({frozenset(one.lengths) for one in runs}) > 1:
        return None
    if any(any(what_differs(runs[0], one, suite)) for one in runs):
        return None
    return _compare(reference, sides[0], row, sides[1])


def to_first(result: ExperimentResult, found: Sequence[RowDifference]) -> list[RowDifference]:
    """Those of `found` whose reference is the first row, of those compared, with the row's own base policy."""
    bases = {row.row.name: row.row.begins_with(result.experiment.scene) for row in result.rows}
    alike = [one for one in found if bases[one.row.row.name] == bases[one.reference.row.name]]
    firsts = {bases[one.reference.row.name]: one.reference.row.name for one in reversed(alike)}
    return [one for one in alike if one.reference.row.name == firsts[bases[one.row.row.name]]]


def _compare(reference: RowResult, before: list[Outcomes], row: RowResult, after: list[Outcomes]) -> RowDifference:
    first = compare_sides(Side((), [], before), Side((), [], after), POWER)[0].rows[0]
    seeds = len(after), len(before)
    difference = first.most_general if min(seeds) > 1 else first.policies
    return RowDifference(row, reference, difference, seeds, first.pairs)


def _outcomes(row: RowResult, suite: str, split: str) -> dict[int, Outcomes]:
    """How each episode ended, by seed, of the finished runs that tell: their own evaluation, or cronos-eval's."""
    found: dict[int, Outcomes] = {}
    for seed in row.finished:
        own = (suite, split) == ("independent", "train")
        # Only what the report has read: what another version made is left out there, too.
        if not own and seed.end not in seed.evaluations.get((suite, split), {}):
            continue
        # A run may have been evaluated when episodes were not kept.
        with suppress(ValueError):
            folder = seed.spec.evaluation_folder(suite, split, seed.spec.steps)
            found[seed.spec.seed] = last_evaluation(seed.run) if own else read_outcomes(folder)
    return found
