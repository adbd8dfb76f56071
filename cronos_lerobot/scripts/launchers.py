"""Where `cronos-reproduce` runs its commands: here, or on a Slurm cluster."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from cronos_lerobot.experiments.display import make_display
from cronos_lerobot.experiments.follow import Follower
from cronos_lerobot.experiments.jobs import Job
from cronos_lerobot.experiments.runner import DONE, Runner
from cronos_lerobot.experiments.slurm import Cluster, SlurmOptions, slurm_folder

LAUNCHERS = ("local", "slurm")
SLURM_FLAGS = {
    "partition": "queue of the cluster",
    "account": "account that pays",
    "qos": "quality of service",
    "constraint": "features of the nodes",
    "gres": "such as gpu:1",
    "mem": "memory of a run, such as 8G",
    "time": "time limit of a run: minutes, H:MM:SS or D-HH:MM:SS; one that comes to it goes on from its last "
    "checkpoint",
    "cpus": "cores of a run (default: --threads)",
    "setup": "a line of shell before the command, such as 'module load python'; may be given again",
    "requeues": "how often a run may come to its time limit",
    "warning_s": "seconds before the time limit at which a run is stopped",
}
"""What `--help` says of the fields of `SlurmOptions`."""


def add_launcher_flags(parser: argparse.ArgumentParser) -> None:
    """`--launcher` and what only a cluster needs."""
    group = parser.add_argument_group("clusters", "docs/cluster.md has it from nothing to a table")
    group.add_argument("--launcher", choices=LAUNCHERS, default="local", help="here (the default), or by Slurm")
    for option in fields(SlurmOptions):
        flag, dest = f"--slurm.{option.name}", f"slurm_{option.name}"
        text = SLURM_FLAGS[option.name] + (f" (default: {option.default})" if option.default else "")
        if str(option.type).startswith("int"):
            group.add_argument(flag, dest=dest, type=int, metavar="N", help=text)
        else:
            action = "append" if option.name == "setup" else "store"
            group.add_argument(flag, dest=dest, action=action, metavar=option.name.upper(), help=text)


def make_slurm_options(args: argparse.Namespace) -> SlurmOptions | None:
    """The `--slurm.*` flags; None where the commands run here.

    Raises:
        ValueError: one makes no sense, or is given and would not be followed.
    """
    given = {name: value for name in SLURM_FLAGS if (value := getattr(args, f"slurm_{name}")) is not None}
    if args.launcher == "local":
        if given:
            raise ValueError(f"--slurm.{next(iter(given))} needs --launcher=slurm")
        return None
    if "setup" in given:
        given["setup"] = tuple(given["setup"])
    return SlurmOptions(**given)


def run_here(jobs: list[Job], parallel: int, threads: int) -> dict[str, str]:
    """Run what is not done; returns the state of every job by name.

    Raises:
        KeyboardInterrupt: with what to do then as its text.
    """
    try:
        with make_display(jobs) as display:
            return Runner(jobs, parallel, display, {"OMP_NUM_THREADS": str(threads)}).run()
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted: the same command goes on from here") from None


def run_on_slurm(
    jobs: list[Job], options: SlurmOptions, root: Path, threads: int, parallel: int | None
) -> dict[str, str]:
    """Submit what is not done, follow it to the end; returns the state of every job by name.

    Raises:
        SlurmError: the cluster does not take it.
        KeyboardInterrupt: with what to do then as its text; the jobs go on.
    """
    cluster = Cluster(slurm_folder(root), options)
    try:
        submitted = cluster.submit(jobs, threads, parallel)
        with make_display(jobs) as display:
            return Follower(jobs, submitted, cluster, display).run()
    except KeyboardInterrupt:
        if not cluster.elements:
            raise KeyboardInterrupt("interrupted: the same command goes on from here") from None
        arrays = " ".join(sorted({element.split("_")[0] for element in cluster.elements.values()}, key=int))
        raise KeyboardInterrupt(
            "the jobs go on in the queue: the same command follows them again,\n"
            f"`cronos-reproduce status --root={root}` shows them, `scancel {arrays}` cancels them"
        ) from None


def finish(states: dict[str, str]) -> bool:
    """Print how many jobs came to which end; returns whether all is done."""
    counts = {state: list(states.values()).count(state) for state in dict.fromkeys(states.values())}
    print("jobs: " + ", ".join(f"{number} {state}" for state, number in counts.items()))
    return all(state == DONE for state in states.values())
