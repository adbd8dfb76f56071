"""What `cronos-reproduce` prints of experiments and commands without running any."""

from __future__ import annotations

from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.display import describe_missing
from cronos_lerobot.experiments.jobs import (
    RUNNING,
    Job,
    changes,
    continuation,
    is_done,
    missing,
    other_commits,
    status,
)
from cronos_lerobot.scripts.closed_pipe import ends_with_its_reader
from cronos_lerobot.scripts.pipeline import command_line


@ends_with_its_reader()
def print_list() -> None:
    """Print the experiments and their rows."""
    for experiment in EXPERIMENTS.values():
        print(f"{experiment.name}: {experiment.title}{f' ({experiment.source})' if experiment.source else ''}")
        print(f"    {experiment.scene}, {experiment.steps:,} steps at --scale=paper")
        width = max(24, *(len(row.name) for row in experiment.rows))
        for row in experiment.rows:
            print(f"    {row.name:<{width}} {row.label}")


@ends_with_its_reader()
def print_plan(jobs: list[Job]) -> None:
    """Print every command, those that are done as comments."""
    for job in jobs:
        if is_done(job):
            commits = "".join(f", made at commit {commit}" for commit in other_commits(job))
            print(f"# {job.name}: done ({job.output}){commits}")
            continue
        if found := changes(job):
            print(f"# {job.name}: NOT REUSED ({job.output}): {'; '.join(found)}")
            continue
        if status(job) == RUNNING:
            print(f"# {job.name}: is being run by another process")
            continue
        absent = missing(job)
        if absent and all(is_done(needed) for needed in jobs if needed.name in job.needs):
            print(f"# {job.name}: blocked, {describe_missing(absent, job)}")
            continue
        resumed = continuation(job)
        print(f"# {job.name}{': goes on' if resumed else ''}")
        print(command_line(resumed or list(job.command)), end="\n\n")
