"""Shows the runner's progress: a live table on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from cronos_lerobot.experiments.jobs import Job, changes, missing
from cronos_lerobot.experiments.runner import BLOCKED, CHANGED, DONE, FAILED, MISSING

TAIL_LINES = 20
"""Lines of a failed job's log that are shown."""
LINE_INTERVAL_S, TABLE_INTERVAL_S = 60.0, 1.0
"""How often progress is shown, without a terminal and on one [s]."""


def log_tail(job: Job, lines: int = TAIL_LINES) -> str:
    """The end of what a job printed; of a progress bar only its last state."""
    if not job.log.is_file():
        return ""
    text = job.log.read_text(errors="replace")
    return "\n".join(line.rstrip().split("\r")[-1] for line in text.splitlines()[-lines:])


def describe(job: Job, what: str) -> str:
    """An event as a line, with what one needs to know if it is a bad one."""
    if what == FAILED:
        return f"{job.name}: FAILED, the end of {job.log}:\n{log_tail(job)}"
    if what == CHANGED:
        return (
            f"{job.name}: NOT REUSED, {job.output} is not known to be this command's, in this version. Delete it,"
            f" choose another --root, or go back to what made it. Why:\n    " + "\n    ".join(changes(job))
        )
    if what == BLOCKED:
        return f"{job.name}: blocked, it needs a job that is not done"
    if what == MISSING:
        return f"{job.name}: blocked, {describe_missing(missing(job), job)}"
    return f"{job.name}: {what}"


def describe_missing(paths: Sequence[Path], job: Job) -> str:
    """What a job does not find of what it reads, and what to do about it."""
    return (
        f"{', '.join(map(str, paths))} is not there: {' and '.join(job.needs)} came without checkpoints. Copy them"
        " from where it was made, or delete its folder here to make it again"
    )


def progress_line(job: Job) -> tuple[str, str, str]:
    """Steps, what else is known, and the time left of a running job."""
    progress = job.progress()
    if progress is None:
        return "", "starting" if not job.output.exists() else "", ""
    left = "" if progress.seconds_left is None else duration(progress.seconds_left)
    return f"{progress.done:,} / {progress.total:,}", progress.text, left


def duration(seconds: float) -> str:
    """Hours and minutes, `1 h 05 min`, or minutes alone."""
    minutes = max(0, round(seconds / 60))
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"


class Forecast:
    """How long all jobs together may still take, from the interaction steps done since it was made."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs = jobs
        self._first: tuple[float, int] | None = None

    def text(self, states: dict[str, str], running: Sequence[Job]) -> str:
        """The time left in words; empty until there is something to tell it from."""
        done = sum(job.work for job in self.jobs if job.name in states)
        done += sum(min(job.work, progress.done) for job in running if (progress := job.progress()))
        now = time.monotonic()
        first_time, first_done = self._first = self._first or (now, done)
        left = sum(job.work for job in self.jobs) - done
        if done <= first_done or left <= 0:
            return ""
        return f"about {duration(left * (now - first_time) / (done - first_done))} of training left"


class LineDisplay:
    """Prints a line for every event, and where the running jobs are once a minute."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs, self._forecast = jobs, Forecast(jobs)
        self._printed = time.monotonic()

    def __enter__(self) -> LineDisplay:
        return self

    def __exit__(self, *_: Any) -> None:
        return

    def event(self, job: Job, what: str) -> None:
        """Print it."""
        print(describe(job, what), flush=True)

    def update(self, states: dict[str, str], running: Sequence[Job]) -> None:
        """Print where the running jobs are, if it is time."""
        if time.monotonic() - self._printed < LINE_INTERVAL_S:
            return
        self._printed = time.monotonic()
        done = f"{sum(state == DONE for state in states.values())} of {len(self.jobs)} jobs done"
        text = ", ".join(filter(None, (done, self._forecast.text(states, running))))
        print(f"[{time.strftime('%H:%M')}] {text}", flush=True)
        for job in running:
            steps, text, left = progress_line(job)
            words = [word for word in (steps, text, f"{left} left" if left else "") if word]
            print(f"    {job.name}: {', '.join(words)}", flush=True)


class TableDisplay:
    """A table of the running jobs under a bar for all of them; events scroll by above."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._console = Console()
        self._forecast = Forecast(jobs)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._console,
        )
        self._task = self._bar.add_task("jobs done", total=len(jobs), left="")
        self._live = Live(console=self._console, refresh_per_second=2, transient=True)
        self._drawn = 0.0

    def __enter__(self) -> TableDisplay:
        self._live.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        self._live.__exit__(*details)

    def event(self, job: Job, what: str) -> None:
        """Print it above the table."""
        self._console.print(describe(job, what), markup=False, highlight=False)

    def update(self, states: dict[str, str], running: Sequence[Job]) -> None:
        """Draw the table anew, if it is time."""
        if time.monotonic() - self._drawn < TABLE_INTERVAL_S:
            return
        self._drawn = time.monotonic()
        table = Table("running", "steps", "success", "left", box=None, pad_edge=False, header_style="dim")
        for job in running:
            table.add_row(job.name, *progress_line(job))
        done = sum(state == DONE for state in states.values())
        self._bar.update(self._task, completed=done, left=self._forecast.text(states, running))
        self._live.update(Group(table, self._bar))


def make_display(jobs: Sequence[Job]) -> LineDisplay | TableDisplay:
    """The display for this process's output."""
    return TableDisplay(jobs) if sys.stdout.isatty() else LineDisplay(jobs)
