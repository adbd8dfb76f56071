"""What runs have gained or lost between two of their own evaluations, on the same episodes.

The same trainings stand on both sides, so their differences are compared with 0, by training and configuration, as
`cronos-report compare` does with two sides.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from cronos_lerobot.report.compared_sides import paired_episodes, periodic_evaluation
from cronos_lerobot.report.paired import Pairs, compare_policies, compare_trainings
from cronos_lerobot.report.runs import TrainingRun, read_training_run
from cronos_lerobot.scripts.errors import error_line


def evaluation_at(run: TrainingRun, steps: int) -> int:
    """The place of a run's evaluation after so many interaction steps.

    Raises:
        ValueError: it has none.
    """
    there = [int(evaluation["interaction_steps"]) for evaluation in run.evaluations]
    if steps not in there:
        raise ValueError(f"{run.folder} was not evaluated after {steps:,} steps, but after {there}")
    return there.index(steps)


def compare_moments(runs: list[TrainingRun], before: int, after: int) -> str:
    """Success after so many steps of each, by run, and the difference, as a line.

    Raises:
        ValueError: a run was not evaluated then, or their episodes are not the same.
    """
    sides = [[periodic_evaluation(run, evaluation_at(run, steps)) for run in runs] for steps in (before, after)]
    episodes = paired_episodes(sides, "independent", "train")
    lengths = [np.array([[one.lengths[e] for e in episodes] for one in side]) for side in sides]
    gains = Pairs.of(np.zeros((1, len(episodes)), int), lengths[1] - lengths[0], episodes)
    found = compare_trainings(gains, power=0.8) or compare_policies(Pairs.of(*lengths, episodes), power=0.8)
    rates = [" ".join(f"{rate:.3f}" for rate in side.mean(axis=1)) for side in lengths]
    interval = "" if found.ci95 is None else f" [{found.ci95[0]:+.3f}, {found.ci95[1]:+.3f}]"
    of = "trainings like these" if len(runs) > 1 else "this policy"
    p = "" if found.p is None else f", p = {found.p:.2g}"
    return f"{rates[0]} -> {rates[1]}: {found.value:+.3f}{interval}{p}, of {of}"


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, help="rows of cronos-reproduce, or one seed of a row")
    parser.add_argument("--steps", nargs=2, type=int, required=True, metavar="N", help="before and after")
    args = parser.parse_args()
    for folder in args.folders:
        places = sorted([*folder.glob("seed*/train"), *folder.glob("train")])
        if not places:
            parser.error(f"{folder} has neither seed*/train nor train")
        name = folder.name if len(places) > 1 else f"{places[0].parents[1].name}/{places[0].parent.name}"
        with error_line():
            print(f"{name}: {compare_moments([read_training_run(place) for place in places], *args.steps)}")


if __name__ == "__main__":
    main()
