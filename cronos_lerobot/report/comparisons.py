"""What trainings came to: success before and after."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cronos_lerobot.report.lerobot_evaluations import EvaluationRun
from cronos_lerobot.report.runs import Group, TrainingRun, evaluation_rates
from cronos_lerobot.report.statistics import Gain, Rate, SeedRate, sum_rates


@dataclass(frozen=True)
class Comparison:
    """What a training came to: success before and after, by task."""

    label: str
    suite: str
    tasks: dict[str, Gain]

    @property
    def overall(self) -> Gain:
        """All tasks together."""
        gains = self.tasks.values()
        return Gain(sum_rates(gain.before for gain in gains), sum_rates(gain.after for gain in gains))


def titled(comparisons: Iterable[Comparison]) -> list[tuple[str, Comparison]]:
    """Each with its suite, and what was compared where that is several."""
    shown = list(comparisons)
    several = len({comparison.label for comparison in shown}) > 1
    return [(f"{one.label}: {one.suite}" if several else one.suite, one) for one in shown]


def compare_training(groups: list[Group]) -> list[Comparison]:
    """First and last periodic evaluation of every group, its seeds together, where they were made alike.

    Of seeds that are not as far as others those that are (`at_their_end`).
    """
    comparisons = []
    for group in groups:
        runs = [run for run in at_their_end(group.runs) if len(run.alike) > 1 and run.begins_alike]
        if not runs:
            continue
        first, last = (
            [evaluation_rates(run.evaluations[place]) for run in measured]
            for place, measured in ((0, _different_starts(runs)), (-1, runs))
        )
        tasks = [task for task in first[0] if all(task in rates for rates in (*first, *last))]
        gains = {
            task: Gain(SeedRate.of(r[task] for r in first), SeedRate.of(r[task] for r in last)) for task in tasks
        }
        suite = f"periodic evaluation, {runs[0].evaluations[-1]['split']}"
        comparisons.append(Comparison(group.label, suite, gains))
    return comparisons


def at_their_end(runs: Sequence[TrainingRun], notes: list[str] | None = None) -> list[TrainingRun]:
    """The runs whose last evaluation comes as late as that of the longest; the others are not at their end.

    A run that has spent its reset budget is at its end wherever that is.

    Args:
        runs: of one group.
        notes: takes a sentence for each run that is left out.
    """
    ends = [run.evaluations[-1]["interaction_steps"] if run.evaluations else 0 for run in runs]
    kept = []
    for run, end in zip(runs, ends, strict=True):
        if end == max(ends) or _has_spent_its_budget(run):
            kept.append(run)
        elif notes is not None:
            notes.append(
                f"the own evaluations of {run.folder}: the last is after {end:,} steps, another's after "
                f"{max(ends):,}"
            )
    return kept


def _has_spent_its_budget(run: TrainingRun) -> bool:
    budget = (run.config.get("protocol") or {}).get("reset_budget")
    return budget is not None and bool(run.evaluations) and run.evaluations[-1]["interventions"] >= budget


def _different_starts(runs: list[TrainingRun]) -> list[TrainingRun]:
    """The first of the runs, if all began with the same policy; else all of them.

    Seeds that begin with a saved policy measure it with the same episodes and random numbers: one evaluation, and
    not one for each. Those that begin from scratch, or with the clones of several machines, are compared each with
    its own.
    """
    policies = {
        run.base or (run.config.get("policy") or {}).get("pretrained_path") or str(run.folder) for run in runs
    }
    return runs[:1] if len(policies) == 1 else runs


def compare_evaluations(before: list[EvaluationRun], after: list[EvaluationRun]) -> list[Comparison]:
    """Evaluations of `lerobot-eval` of the same suite, before and after."""
    comparisons = []
    for suite in dict.fromkeys(run.suite for run in after):
        old = _pool([run.tasks for run in before if run.suite == suite])
        new = _pool([run.tasks for run in after if run.suite == suite])
        gains = {task: Gain(old[task], rate) for task, rate in new.items() if task in old}
        if gains:
            comparisons.append(Comparison("lerobot-eval", suite, gains))
    return comparisons


def _pool(tables: list[dict[str, Rate]]) -> dict[str, Rate]:
    """Each task of all folders: one is of one training, so that several vary as trainings do."""
    rates: dict[str, list[Rate]] = {}
    for table in tables:
        for task, rate in table.items():
            rates.setdefault(task, []).append(rate)
    return {task: SeedRate.of(found) for task, found in rates.items()}
