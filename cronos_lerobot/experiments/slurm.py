"""Runs jobs on a Slurm cluster through submitit: arrays that wait for each other, requeued at their time limit.

Base policies are one array, the training runs another, their evaluations a third whose elements wait each for its
own run. An element is what the local runner is for these jobs, on a node: same folders, locks and notes, so that
both may work on one root.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NoReturn

from cronos_lerobot.experiments.arrays import (
    Elements,
    after_any,
    after_each,
    behind_runs,
    needs_of_others,
    plan_arrays,
    to_be_made,
)
from cronos_lerobot.experiments.display import LineDisplay
from cronos_lerobot.experiments.jobs import BASE, EVALUATION, RUN, Job, is_done, read_record
from cronos_lerobot.experiments.runner import DONE, FAILED, Runner
from cronos_lerobot.experiments.signals import deferred
from cronos_lerobot.experiments.submitted import (
    SlurmError,
    Submission,
    other_flags,
    other_options,
    read_submissions,
    write_submissions,
)
from cronos_lerobot.locks import FolderLock

PENDING = "PENDING"
"""Slurm's state of an element that waits, also of one that was requeued."""
LATE_S = 90.0
"""How long what another node has written is looked for [s]: NFS may show it a minute late."""
INSTALL = "--launcher=slurm needs submitit: pip install '.[slurm]' in a clone"


@dataclass(frozen=True)
class SlurmOptions:
    """What an array asks of the cluster; None leaves it to the cluster."""

    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    gres: str | None = None
    """Such as gpu:1."""
    mem: str | None = None
    """Memory of an element, such as 8G."""
    time: str = "24:00:00"
    """Time limit of an element: minutes, H:MM:SS or D-HH:MM:SS."""
    cpus: int | None = None
    """Cores of an element; None is a run's threads."""
    setup: tuple[str, ...] = ()
    """Lines of shell before the command, such as `module load python`."""
    requeues: int = 50
    """How often an element may come to its time limit."""
    warning_s: int = 120
    """Seconds before the time limit at which an element stops its command and asks for the next start."""

    def __post_init__(self) -> None:
        if self.minutes < 1:
            raise ValueError(f"--slurm.time={self.time} is no time to run")
        for name, low in (("requeues", 0), ("warning_s", 1), ("cpus", 1)):
            if (value := getattr(self, name)) is not None and value < low:
                raise ValueError(f"--slurm.{name} must be at least {low}, got {value}")
        if self.warning_s >= 60 * self.minutes:
            raise ValueError(f"--slurm.warning_s={self.warning_s} must be less than --slurm.time={self.time}")

    @property
    def minutes(self) -> int:
        """The time limit [min].

        Raises:
            ValueError: it cannot be read.
        """
        found = re.fullmatch(r"(\d+)|(?:(\d+)-)?(\d+):(\d\d):(\d\d)", self.time)
        if not found:
            raise ValueError(f"--slurm.time must be minutes, H:MM:SS or D-HH:MM:SS, got {self.time!r}")
        minutes, *rest = (int(number or 0) for number in found.groups())
        days, hours, more, seconds = rest
        return minutes + 1440 * days + 60 * hours + more + -(-seconds // 60)

    @property
    def flags(self) -> dict[str, str]:
        """Those that are not None, as flags and their values."""
        values = {f"--slurm.{option.name}": getattr(self, option.name) for option in fields(self)}
        values["--slurm.setup"] = "; ".join(self.setup)
        return {flag: str(value) for flag, value in values.items() if value not in (None, "")}

    def parameters(self, threads: int, parallel: int | None) -> dict[str, Any]:
        """The parameters of submitit's SlurmExecutor.

        Args:
            threads: of each command.
            parallel: elements of an array at a time; None leaves it to the cluster.
        """
        cpus = self.cpus or threads
        names = ("partition", "account", "qos", "constraint", "gres", "mem")
        return {name: value for name in names if (value := getattr(self, name)) is not None} | {
            "time": self.minutes,
            "cpus_per_task": cpus,
            "signal_delay_s": self.warning_s,
            "array_parallelism": parallel or 10_000,
            "stderr_to_stdout": True,
            # Since Slurm 22.05 srun does not ask for what sbatch was given.
            "srun_args": [f"--cpus-per-task={cpus}"],
            "setup": list(self.setup) or None,
            # Requeued where a node fails; gone where what it waits for failed.
            "additional_parameters": {"requeue": True, "kill-on-invalid-dep": "yes"},
        }


class Task:
    """An element of an array: its jobs, run as the local runner does; pickled, and run on a node by submitit.

    Args:
        jobs: needs come before those who need them.
        needs: those of them that other elements run.
        threads: of each command.
        limit_s: its time limit [s].
        grace_s: how long a command may take to end after it was asked to [s].
        requeues: how often it may still come to its time limit.
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        needs: Sequence[Job],
        threads: int,
        limit_s: float,
        grace_s: float,
        requeues: int = SlurmOptions.requeues,
    ) -> None:
        self.jobs, self.needs, self.threads = tuple(jobs), tuple(needs), threads
        self.limit_s, self.grace_s, self.requeues = limit_s, grace_s, requeues
        self._late_s = LATE_S
        self._began = time.monotonic()
        self._waiting: list[Job] = []
        """What was not done at this start."""
        self._runner: Runner | None = None

    def __call__(self) -> dict[str, str]:
        """Run what is not done.

        Returns:
            The state of every job by name.

        Raises:
            RuntimeError: something needed is not done, or a job failed.
        """
        self._began = time.monotonic()
        self._waiting = [job for job in self.jobs if not is_done(job)]
        if missing := self._await_needs():
            raise RuntimeError(f"blocked: {', '.join(missing)} is not done")
        own = {job.name for job in self.jobs}
        jobs = [replace(job, needs=tuple(need for need in job.needs if need in own)) for job in self.jobs]
        self._runner = Runner(jobs, 1, LineDisplay(jobs), {"OMP_NUM_THREADS": str(self.threads)}, self.grace_s)
        try:
            states = self._runner.run()
        except KeyboardInterrupt:
            states = self._await_end()
        # The signal reaches all processes of an element, and the command may have ended before the runner knew.
        failed = [job for job in jobs if states[job.name] == FAILED]
        if any(read_record(job).get("returncode") == -signal.SIGTERM for job in failed):
            self._await_end()
        if bad := {name: state for name, state in states.items() if state != DONE}:
            raise RuntimeError(f"not done: {bad}")
        return states

    def _await_needs(self) -> list[str]:
        """The names of what is needed and not done, also after a while."""
        deadline = time.monotonic() + self._late_s
        while missing := [job.name for job in self.needs if not is_done(job)]:
            if time.monotonic() >= deadline:
                break
            time.sleep(self._late_s / 20)
        return missing

    def _await_end(self) -> NoReturn:
        """Wait for what follows SIGTERM: what ends by itself in the grace time of a preemption is not requeued."""
        print("cancelled or preempted: waiting for Slurm to end or requeue this job", flush=True)
        while True:
            time.sleep(60)

    def checkpoint(self) -> Any:
        """Stop: submitit calls this shortly before the time limit, and then requeues what is returned.

        None, which ends the job, where a whole time limit has finished no job and left nothing to go on with, as
        the next one would; or where it has come to its limit too often. Submitit counts these alone, and takes a
        warning of more than a fifth of the limit and ten minutes for a preemption.
        """
        from submitit.helpers import DelayedSubmission

        if self._runner is not None:
            self._runner.stop()
        unfinished = next((job for job in self.jobs if not is_done(job)), None)
        has_timed_out = time.monotonic() - self._began > self.limit_s / 2
        has_got_on = any(map(is_done, self._waiting))
        if has_timed_out and not has_got_on and unfinished is not None and unfinished.resume() is None:
            print(
                f"{unfinished.name} came to its time limit before its first checkpoint: give a longer --slurm.time"
            )
            return None
        requeues = self.requeues - has_timed_out
        if requeues < 0:
            print("came to its time limit more often than --slurm.requeues allows: submit it again to go on")
            return None
        task = Task(self.jobs, self.needs, self.threads, self.limit_s, self.grace_s, requeues)
        return DelayedSubmission(task)


def slurm_folder(root: Path) -> Path:
    """Where what was submitted of a root is remembered."""
    return root / "slurm"


class Cluster:
    """Submits jobs, and remembers in `folder` which element of which array has each.

    Args:
        folder: on a disk that all nodes share; holds logs and the notes.
        options: see there.

    Raises:
        SlurmError: there is no Slurm, or no submitit.
    """

    def __init__(self, folder: Path, options: SlurmOptions) -> None:
        try:
            import submitit
        except ImportError:
            raise SlurmError(INSTALL) from None
        for program in ("sbatch", "srun", "squeue"):
            if not shutil.which(program):
                raise SlurmError(f"--launcher=slurm: there is no {program} here; start it on a login node")
        self.folder, self.options = folder.resolve(), options
        root = self.folder.parent
        if "%" in str(root):
            raise SlurmError(
                f"Slurm reads a % in a path as its own: choose another --root than {self.folder.parent}"
            )
        self.logs = self.folder / "logs"
        self.elements: dict[str, str] = {}
        """The id of the element that has each job in the queue, by name, as far as `submit` has come."""
        self._submitit = submitit

    def submit(self, jobs: Sequence[Job], threads: int, parallel: int | None) -> dict[str, str]:
        """Submit what is neither done nor in the queue.

        Args:
            jobs: each name once; needs come before those who need them.
            threads: of each command.
            parallel: elements of an array at a time; None leaves it to the cluster.

        Returns:
            The id of the element that has each job, by name.

        Raises:
            SlurmError: a job is in the queue with other flags, or the cluster refuses an array.
        """
        options = self.options.flags | ({"--jobs": str(parallel)} if parallel else {})
        made = {job.name: job for job in jobs}
        with FolderLock(self.folder):
            known, queue = read_submissions(self.folder), squeue()
            in_queue = {name: what for name, what in known.items() if what.element in queue}
            if text := other_flags(jobs, in_queue):
                raise SlurmError(text)
            if text := other_options({name: what for name, what in in_queue.items() if name in made}, options):
                print(text, flush=True)
            queued = {name: what.element for name, what in in_queue.items()}
            self.elements = {name: element for name, element in queued.items() if name in made}
            waiting = to_be_made([job for job in jobs if job.name not in queued], queued)
            bases, runs, evaluations = plan_arrays(jobs, waiting)
            submitted: dict[str, str] = {}

            def array(name: str, elements: Elements, dependency: str | None) -> list[str]:
                limit_s = 60.0 * self.options.minutes - self.options.warning_s
                # The rest of the warning is for what follows a killed command.
                grace_s = 0.75 * self.options.warning_s
                limits = threads, limit_s, grace_s, self.options.requeues
                tasks = [Task(element, needs_of_others(element, made), *limits) for element in elements]
                parameters = self.options.parameters(threads, parallel) | {"dependency": dependency}
                # What the cluster has taken is remembered, whatever comes.
                with deferred():
                    numbers = self._submit_array(_array_name(name), tasks, parameters)
                    for element, number in zip(elements, numbers, strict=True):
                        submitted.update({job.name: number for job in element})
                    new = {
                        name: Submission(number, list(made[name].command), options)
                        for name, number in submitted.items()
                    }
                    write_submissions(self.folder, known | new)
                    self.elements |= submitted
                return numbers

            array(BASE, bases, None)
            # `any`: what an element needs it looks for itself, and others may have theirs.
            begun, runs = behind_runs(runs, queued, made)
            numbers = array(RUN, runs, after_any(runs, queued | submitted))
            array(EVALUATION, evaluations, after_each(numbers, len(evaluations)))
            if begun:
                array(EVALUATION, begun, after_any(begun, queued))
        return self.elements

    def _submit_array(self, name: str, tasks: list[Task], parameters: dict[str, Any]) -> list[str]:
        """Submit an array; returns its elements' ids.

        Raises:
            SlurmError: the cluster refuses it.
        """
        if not tasks:
            return []
        from submitit.core.utils import FailedJobError

        executor = self._submitit.SlurmExecutor(self.logs, max_num_timeout=self.options.requeues)
        executor.update_parameters(job_name=name, **parameters)
        try:
            with executor.batch():
                jobs = [executor.submit(task) for task in tasks]
        except FailedJobError as error:
            raise SlurmError(f"sbatch: {error}") from None
        return [job.job_id for job in jobs]

    def log(self, number: str) -> Path:
        """What an element printed."""
        return self.logs / f"{number}_0_log.out"


def _array_name(stage: str) -> str:
    return f"cronos-{stage}"


def squeue() -> dict[str, tuple[str, str]]:
    """State (PENDING, RUNNING ...) and reason of all elements of such arrays that are in the queue, by id.

    Of all users: who shares a root does not submit again what another has.

    Raises:
        SlurmError: squeue does not answer.
    """
    names = ",".join(_array_name(stage) for stage in (BASE, RUN, EVALUATION))
    command = ["squeue", "--noheader", "--array", "--format=%i|%T|%r", f"--name={names}"]
    answer = subprocess.run(command, capture_output=True, text=True)
    if answer.returncode:
        raise SlurmError(f"squeue: {answer.stderr.strip() or 'no answer'}")
    rows = [line.split("|") for line in answer.stdout.splitlines() if line]
    return {number: (state, reason) for number, state, reason in rows}
