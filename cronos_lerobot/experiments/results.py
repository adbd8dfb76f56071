"""Reads what the runs of an experiment have come to, finished or not."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from cronos_lerobot.evaluation.policy_source import PINNED
from cronos_lerobot.evaluation.store import read_results
from cronos_lerobot.experiments.definitions import INTERVENTIONS, CheckpointEvaluation, Experiment, Row
from cronos_lerobot.experiments.jobs import Job, known_changes, other_commits, read_record, status
from cronos_lerobot.experiments.plan import base_evaluation_jobs, checkpoint_evaluations, train_job
from cronos_lerobot.experiments.runner import DONE, FAILED
from cronos_lerobot.experiments.same_run import is_of_another, went_on
from cronos_lerobot.experiments.specs import Options, RunSpec, base_folder, run_specs
from cronos_lerobot.protocol.metrics import Gap, Summary, performance_gap, success_at, summarise, summarise_rates
from cronos_lerobot.report.runs import Group, TrainingRun, read_training_run
from cronos_lerobot.training.logging import METRICS
from cronos_lerobot.training.resume import flatten

RESULTS = "results.json"
APART = ("found_complete", "never_grasped")


@dataclass(frozen=True)
class Point:
    """One evaluation on a curve."""

    interaction_steps: int
    interventions: int
    success: float
    n: int
    ci95: tuple[float, float]
    apart: dict[str, int] = field(default_factory=dict)
    """Of the successes, those `found_complete` and those `never_grasped`."""
    at_interventions: tuple[int, ...] = ()
    """Numbers of interventions that the evaluation was made for."""

    def x(self, axis: str) -> int:
        """The point's place on `axis`, interaction_steps or interventions."""
        return self.interventions if axis == INTERVENTIONS else self.interaction_steps


def summarise_points(points: Sequence[Point]) -> Summary | None:
    """Success over the seeds, a point for each; None of none.

    One alone has the interval of its evaluation, and so have several that are all alike.
    """
    summary = summarise([point.success for point in points])
    if summary is None:
        return None
    return replace(summary, ci95=summary.varied_ci95 or points[0].ci95).within(0.0, 1.0)


@dataclass(frozen=True)
class AtBudget:
    """Success after a number of interventions."""

    summary: Summary | None
    """Over the finished seeds; None if one of them did not get there."""
    between: tuple[int, int] | None = None
    """Interventions of the evaluations between which a seed is interpolated, the furthest apart; None if all are
    measured."""
    reason: str = ""
    """Why there is no number and never will be."""


@dataclass
class SeedResult:
    """One run of a row, and the evaluations of its checkpoints."""

    spec: RunSpec
    run: TrainingRun
    status: str | None
    """Of its job, see `jobs.status`."""
    evaluations: dict[tuple[str, str], dict[int, dict[str, Any]]] = field(default_factory=dict)
    """What cronos-eval found: by suite and split, then by checkpoint [interaction steps], the base policy at 0."""
    seconds: float = 0.0
    """That its training took, all starts together."""
    missing: list[str] = field(default_factory=list)
    """Names of the evaluations by cronos-eval that are not there yet."""

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return self.status == DONE

    @property
    def end(self) -> int:
        """Interaction steps at its last checkpoint, which a reset budget may have brought early."""
        return (
            self.run.last["interaction_steps"] if self.finished and self.spec.row.has_budget else self.spec.steps
        )

    def place(self, checkpoint: int) -> int:
        """Where an evaluation of a checkpoint stands on the axis of steps [interaction steps]."""
        return self.end if checkpoint == self.spec.steps else checkpoint

    def curve(self, split: str, task: str | None = None) -> list[Point]:
        """Success of a task, or of all together, over the run: its own evaluations, or else cronos-eval's."""
        own = [e for e in self.run.evaluations if e["split"] == split]
        if own:
            return [_point(e["interaction_steps"], e["interventions"], e, task) for e in own]
        counts = {0: 0} | {u["interaction_steps"]: u["interventions"] for u in (*self.run.updates, self.run.last)}
        found = self.evaluations.get(("independent", split), {})
        return [_point(n, counts[n], result, task) for n, result in sorted(found.items()) if n in counts]

    def final(self, split: str) -> Point | None:
        """The evaluation at the end of the run, which a reset budget may have brought early; None before it."""
        curve = self.curve(split)
        end = self.run.last["interaction_steps"] if self.finished else self.spec.steps
        return curve[-1] if curve and curve[-1].interaction_steps >= end else None


@dataclass
class RowResult:
    """All runs of a row that have begun."""

    row: Row
    seeds: list[SeedResult]
    wanted: int
    """How many seeds the experiment has."""
    unrecorded: dict[str, str] = field(default_factory=dict)
    """What has become of runs that were started and have no record yet, by their names; see `jobs.status`."""
    left_out: int = 0
    """Runs that are there and not the experiment's; see `ExperimentResult.changed`."""

    @property
    def finished(self) -> list[SeedResult]:
        """The runs that came to their end."""
        return [seed for seed in self.seeds if seed.finished]

    @property
    def drawn(self) -> list[SeedResult]:
        """The runs that stand for the row: the finished ones, or all while there is none."""
        return self.finished or self.seeds

    @property
    def group(self) -> Group:
        """The same runs, for the functions of `cronos_lerobot.report`."""
        return Group(self.row.label, [seed.run for seed in self.drawn])

    def finals(self, split: str) -> list[Point]:
        """The last evaluation of every finished run."""
        return [point for seed in self.finished if (point := seed.final(split)) is not None]

    def success(self, split: str) -> Summary | None:
        """Success at the end, over the finished seeds; one alone has the interval of its evaluation."""
        return summarise_points(self.finals(split))

    @property
    def takeovers(self) -> tuple[float, int]:
        """Mean number of an expert's takeovers among a finished run's interventions, and as many one counts."""
        counts = [seed.run.last["interventions_by_kind"].get("takeover", 0) for seed in self.finished]
        prices = [seed.run.config["protocol"].get("takeover_price", 1) for seed in self.finished]
        return (float(np.mean(counts)), max(prices)) if counts else (0.0, 1)

    def gap(self, axis: str, split: str = "train", up_to: float | None = None) -> Summary | None:
        """D or C, divided by the length of the axis, over the finished seeds."""
        return summarise_rates([gap.normalised for gap in self.gaps(axis, split, up_to)])

    def area(self, axis: str, split: str = "train") -> Summary | None:
        """D or C themselves, over the finished seeds."""
        summary = summarise([gap.area for gap in self.gaps(axis, split)])
        return summary and summary.within(0.0, inf)

    def gaps(self, axis: str, split: str = "train", up_to: float | None = None) -> list[Gap]:
        """D or C of every finished seed."""
        curves = [seed.curve(split) for seed in self.finished]
        return [performance_gap(*_xy(curve, axis), up_to) for curve in curves if curve]

    def success_at(self, interventions: int, split: str = "train") -> AtBudget:
        """Success after so many interventions.

        Measured by the evaluation at the first policy update that came to so many, or the last of those where the
        number happened to be just that; else interpolated.
        """
        finished = [
            (curve, seed.run.last["interventions"]) for seed in self.finished if (curve := seed.curve(split))
        ]
        early = [last for _, last in finished if last < interventions]
        if early:
            which = "the runs" if len(early) == len(finished) else f"{len(early)} of {len(finished)} runs"
            return AtBudget(None, reason=f"{which} ended after {max(early):,} interventions")
        values: list[float] = []
        gaps: list[tuple[int, int]] = []
        for curve, _ in finished:
            measured = [p for p in curve if interventions in p.at_interventions]
            measured = measured or [p for p in curve if p.interventions == interventions]
            if measured:
                values.append(measured[-1].success)
                continue
            values.append(success_at(*_xy(curve, INTERVENTIONS), interventions))
            places = [point.interventions for point in curve]
            before, after = [x for x in places if x < interventions], [x for x in places if x > interventions]
            gaps += [(max(before), min(after))] if before and after else []
        return AtBudget(summarise_rates(values), max(gaps, key=lambda gap: gap[1] - gap[0], default=None))

    def apart(self, split: str) -> dict[str, int]:
        """Of all finished seeds' successes at the end, those found complete and those never grasped."""
        points = self.finals(split)
        return {name: sum(p.apart[name] for p in points) for name in APART if points and name in points[0].apart}


@dataclass
class ExperimentResult:
    """What there is of an experiment."""

    experiment: Experiment
    options: Options
    rows: list[RowResult]
    changed: list[str]
    """Runs and evaluations that another command or version made, or that cannot be read; they are left out."""
    commits: list[str] = field(default_factory=list)
    """Runs that were made at another commit than this one, in the same versions; they count."""

    @property
    def bases(self) -> dict[str, dict[str, list[SeedResult]]]:
        """By its folder's name, then by the fingerprint of the policy that was cloned there: the runs from it.

        Two machines may clone the same demonstrations to other last bits. A policy of the Hub has its commit in
        place of a fingerprint: runs may have begun before and after it was pushed anew.
        """
        found: dict[str, dict[str, list[SeedResult]]] = {}
        for seed in (seed for row in self.rows for seed in row.seeds):
            if base := seed.run.base or _commit_of(seed.run):
                name = (
                    "--policy.path" if self.options.policy_path else base_folder(seed.spec.base, self.options).name
                )
                found.setdefault(name, {}).setdefault(base, []).append(seed)
        return found

    @property
    def mixed(self) -> dict[str, list[str]]:
        """Rows whose runs had several settings of the agent, though the same command: the default has changed.

        By the row's name: each setting with its values and the seeds that had them.
        """
        found: dict[str, list[str]] = {}
        for row in self.rows:
            settings = {seed.spec.seed: flatten(seed.run.config.get("algorithm", {})) for seed in row.seeds}
            for name in sorted({name for values in settings.values() for name in values}):
                seeds: dict[str, list[int]] = {}
                for number, values in settings.items():
                    seeds.setdefault(str(values.get(name)), []).append(number)
                if len(seeds) > 1:
                    said = [f"{value} (seed {', '.join(map(str, numbers))})" for value, numbers in seeds.items()]
                    found.setdefault(row.row.name, []).append(f"{name} {', '.join(said)}")
        return found

    @property
    def tasks(self) -> list[str]:
        """The instructions, in the scene's order."""
        for row in self.rows:
            for seed in row.seeds:
                if seed.run.evaluations:
                    return list(seed.run.evaluations[0]["per_task"])
        return []


def collect(experiment: Experiment, rows: Iterable[Row], options: Options) -> ExperimentResult:
    """Read every run of an experiment that has written a record."""
    result = ExperimentResult(experiment, options, [], [])
    for row in rows:
        row_result = RowResult(row, [], len(options.seeds))
        for spec in run_specs(experiment, options, [row]):
            if seed := _read_seed(spec, result):
                row_result.seeds.append(seed)
            elif _has_record(spec):
                row_result.left_out += 1
            elif (state := status(job := train_job(spec, None))) not in (None, DONE):
                row_result.unrecorded[spec.name] = f"{state}, see {job.log}" if state == FAILED else state
        result.rows.append(row_result)
    return result


def _commit_of(run: TrainingRun) -> str | None:
    """The repository that a run began with and its commit; None if it began with no policy of the Hub."""
    policy = run.config.get("policy") or {}
    path, commit = policy.get("pretrained_path"), policy.get(PINNED)
    return f"{path}@{commit}" if path and commit else None


def _has_record(spec: RunSpec) -> bool:
    metrics = spec.train_folder / METRICS
    return metrics.is_file() and b"\n" in metrics.read_bytes()


def _read_seed(spec: RunSpec, result: ExperimentResult) -> SeedResult | None:
    """What there is of a run; None if that is nothing, or if it is not the experiment's."""
    job = train_job(spec, None)
    if not _has_record(spec):
        return None
    if found := known_changes(job):
        result.changed.append(f"{spec.name}: {'; '.join(found)}")
        return None
    try:
        seed = SeedResult(spec, read_training_run(spec.train_folder), status(job))
        seed.seconds = read_record(job).get("seconds", 0.0)
    except ValueError as error:
        result.changed.append(f"{spec.name}: {error}")
        return None
    if why := went_on(seed.run, spec.steps):
        result.changed.append(f"{spec.name}: {why}")
        return None
    result.commits += [f"{spec.name}: {commit}" for commit in other_commits(job)]
    for evaluation in result.experiment.evaluations:
        for job in base_evaluation_jobs(spec, evaluation):
            _read_evaluation(job, 0, evaluation, seed, result)
        for job, checkpoint in checkpoint_evaluations(spec, evaluation):
            _read_evaluation(job, seed.place(checkpoint), evaluation, seed, result)
    return seed


def _read_evaluation(
    job: Job, checkpoint: int, evaluation: CheckpointEvaluation, seed: SeedResult, result: ExperimentResult
) -> None:
    """Add what an evaluation of a checkpoint, or of the base policy, found on its splits, if it is there."""
    if not (job.output / RESULTS).is_file():
        seed.missing.append(job.name)
        return
    try:
        if found := known_changes(job):
            raise ValueError("; ".join(found))
        results = read_results(job.output)
        if checkpoint == 0 and is_of_another(results, seed.run):
            raise ValueError(f"it is of another base policy than the one that {seed.spec.name} began with")
        splits = results[evaluation.suite]
    except ValueError as error:
        text = f"{job.name}: {error}"
        result.changed += [text] if text not in result.changed else []
        return
    for split, numbers in splits.items():
        seed.evaluations.setdefault((evaluation.suite, split), {})[checkpoint] = numbers


def _point(steps: int, interventions: int, record: dict[str, Any], task: str | None) -> Point:
    rate = record["per_task"][task] if task else record
    apart = {name: rate[name] for name in APART if name in rate}
    at = tuple(record.get("at_interventions", ()))
    return Point(steps, interventions, rate["success"], rate["n"], tuple(rate["ci95"]), apart, at)


def _xy(curve: list[Point], axis: str) -> tuple[list[float], list[float]]:
    return [point.x(axis) for point in curve], [point.success for point in curve]


def sequential(row: RowResult, split: str, orderings: str = "all") -> dict[str, Any] | None:
    """SEQ 0-3 and the average chain length of a row's finished seeds at their last checkpoint.

    Args:
        row: whose.
        split: train or held_out.
        orderings: all, or those `seen` in training (a piece of the training cycle) or `unseen` alone.

    Returns:
        `positions`, a Summary for each, `chain_length`, a Summary, and `n`, chains of each seed; None if there is
        no result.
    """
    whole = [
        results[seed.end]
        for seed in row.finished
        if seed.end in (results := seed.evaluations.get(("sequential", split), {}))
    ]
    found = whole if orderings == "all" else [part for result in whole if (part := result.get(orderings))]
    if not found:
        return None
    rates = np.array([[position["success"] for position in result["positions"]] for result in found])
    lengths = [result["average_chain_length"]["mean"] for result in found]
    apart = {
        name: sum(position.get(name, 0) for result in found for position in result["positions"]) for name in APART
    }
    return apart | {
        "positions": [summarise_rates(column) for column in rates.T],
        "chain_length": summarise(lengths),
        "n": found[0]["n"],
        "seeds": len(found),
    }


@cache
def paper_results() -> dict[str, Any]:
    """The paper's numbers, with their sources."""
    return json.loads((Path(str(files("cronos_lerobot.experiments"))) / "paper_results.json").read_text())
