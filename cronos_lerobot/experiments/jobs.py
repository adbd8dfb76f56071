"""Commands that make a folder each, and the notes that tell which are done."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Progress:
    """How far a job has come."""

    done: int
    total: int
    """In the job's own unit, such as interaction steps."""
    seconds_left: float | None
    text: str = ""
    """Anything else worth showing, such as the success so far."""


@dataclass(frozen=True)
class Job:
    """One command. Beside its `output` lie `<output>.job.json`, `<output>.log` and a lock.

    Jobs may be shared between experiments: the same output is made by the same command or not at all.
    """

    name: str
    command: tuple[str, ...]
    """A console script of this environment, or `python`, and its flags."""
    output: Path
    """The folder that the command makes; removed before the command starts anew."""
    made_from_it: tuple[Path, ...] = ()
    """What other jobs have made of the output, which is removed with it."""
    needs: tuple[str, ...] = ()
    """Names of the jobs whose outputs it uses."""
    resume: Callable[[], list[str] | None] = lambda: None
    """The command that goes on with an unfinished `output`, None if there is nothing to go on with."""
    progress: Callable[[], Progress | None] = lambda: None
    work: int = 0
    """Interaction steps, for the time that all jobs together may still take."""

    @property
    def log(self) -> Path:
        """What the command printed, over all its starts."""
        return self.output.with_name(f"{self.output.name}.log")

    @property
    def record(self) -> Path:
        """The note of what was run."""
        return self.output.with_name(f"{self.output.name}.job.json")

    def remove_output(self) -> None:
        """Make room for a new start."""
        for folder in (self.output, *self.made_from_it):
            if folder.is_dir():
                shutil.rmtree(folder)
        self.log.unlink(missing_ok=True)


def read_record(job: Job) -> dict[str, Any]:
    """Return `command`, `status` (running, done, failed, stopped), `seconds`, `starts`; {} before its start."""
    return json.loads(job.record.read_text()) if job.record.is_file() else {}


def write_record(job: Job, record: dict[str, Any]) -> None:
    """Replace the note in one step, so that a kill leaves the old one or the new one."""
    job.record.parent.mkdir(parents=True, exist_ok=True)
    partial = job.record.with_name(f".{job.record.name}")
    partial.write_text(json.dumps(record, indent=2))
    partial.replace(job.record)


def is_done(job: Job) -> bool:
    """Whether this very command has run to its end and its output is still there."""
    record = read_record(job)
    return record.get("status") == "done" and not changed_flags(job) and job.output.exists()


def changed_flags(job: Job) -> list[str]:
    """How the command that made `output` differs from the job's, `-old` and `+new`; empty if it does not."""
    record = read_record(job)
    if not record or not job.output.exists():
        return []
    old, new = record["command"], list(job.command)
    if old == new:
        return []
    differing = [f"-{flag}" for flag in old if flag not in new] + [f"+{flag}" for flag in new if flag not in old]
    return differing or ["another order of the flags"]


def lock(job: Job) -> int | None:
    """Claim a job; None if another process has it.

    The claim is a file descriptor. A command that inherits it keeps the claim while it lives, so that a job whose
    runner was killed is not started twice. Close it to give the job back.
    """
    job.record.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(job.record.with_name(f".{job.output.name}.lock"), os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor
