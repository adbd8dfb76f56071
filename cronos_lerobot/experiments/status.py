"""What has become of all jobs of a root, wherever they run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.table import Table

from cronos_lerobot.experiments.display import duration
from cronos_lerobot.experiments.jobs import RUNNING, STOPPED, Job, status
from cronos_lerobot.experiments.progress import train_progress
from cronos_lerobot.experiments.runner import DONE
from cronos_lerobot.experiments.slurm import PENDING, slurm_folder, squeue
from cronos_lerobot.experiments.submitted import SlurmError, read_submitted

NOTES = ("base/*/*.job.json", "runs/*/*/seed*/*.job.json", "runs/*/*/seed*/eval/*.job.json")
"""Where the notes of jobs lie in a root."""

REQUEUED = "requeued"
WAITING = (REQUEUED, PENDING.lower())
"""States that Slurm has a reason for."""


def read_jobs(root: Path) -> Iterator[tuple[str, Job, dict[str, Any]]]:
    """Name, job and note of everything that was ever started in a root; damaged notes are left out."""
    for pattern in NOTES:
        for note in sorted(root.glob(pattern)):
            try:
                record = json.loads(note.read_text())
                command = tuple(record["command"])
            except (ValueError, KeyError, TypeError):
                continue
            output = note.with_name(note.name.removesuffix(".job.json"))
            yield _name(output, root), Job(_name(output, root), command, output), record


def _name(output: Path, root: Path) -> str:
    """The job's name, as plan.py gives it."""
    parts = output.relative_to(root).parts
    if parts[0] == "base":
        return "/".join(parts)
    # runs/<scale>/<row>/seed<n>/train is the run itself.
    return "/".join(part for part in parts[1:] if part not in ("train", "eval"))


def make_status_table(root: Path) -> Table:
    """A table of all jobs of a root that were started or are in the queue.

    Raises:
        SlurmError: the note of what is in the queue is damaged.
    """
    submitted = read_submitted(slurm_folder(root))
    try:
        queue = squeue() if submitted else {}
    except (SlurmError, OSError):
        queue = {}
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in ("job", "state", "steps", "success", "time", "starts", "element"):
        justify = "right" if column in ("steps", "time", "starts") else "left"
        table.add_column(column, justify=justify, no_wrap=True)
    seen = set()
    for name, job, record in read_jobs(root):
        seen.add(name)
        number = submitted.get(name, "")
        queued = queue.get(number)
        state = status(job) if queued is None else _queued_state(record.get("status"), queued[0])
        steps, text = _progress(job)
        if queued and state in WAITING:
            text = ", ".join(filter(None, (text, queued[1])))
        table.add_row(
            name, state, steps, text, duration(record.get("seconds", 0.0)), str(record.get("starts", 0)), number
        )
    for name, number in submitted.items():
        if name not in seen and number in queue:
            state, reason = queue[number]
            # Another job of the same element runs, and this one after it.
            waits = (state.lower(), reason) if state == PENDING else ("waiting", "")
            table.add_row(name, waits[0], "", waits[1], "", "", number)
    return table


def _queued_state(noted: str | None, slurm: str) -> str | None:
    """The state of a job whose element is in the queue, from that of its note and Slurm's.

    A lock on another node is not always seen here, and a note of a job that was killed says `running` for ever.
    """
    if noted == DONE:
        return noted
    if slurm == PENDING:
        return REQUEUED if noted in (RUNNING, STOPPED) else slurm.lower()
    return slurm.lower() if noted == RUNNING else REQUEUED if noted == STOPPED else noted


def _progress(job: Job) -> tuple[str, str]:
    """Steps and success of a run; empty for other jobs."""
    wanted = next((flag.split("=")[1] for flag in job.command if flag.startswith("--steps=")), None)
    if job.command[0] != "cronos-train" or wanted is None:
        return "", ""
    progress = train_progress(job.output, int(wanted))
    return ("", "") if progress is None else (f"{progress.done:,} / {int(wanted):,}", progress.text)
