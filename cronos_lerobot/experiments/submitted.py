"""The note of what was submitted to a cluster: which element of which array has each job, and its command."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from cronos_lerobot.experiments.jobs import Job, differing_flags

NOTE = "submitted.json"


@dataclass(frozen=True)
class Submission:
    """What was submitted last of a job."""

    element: str
    """Id of the element of an array that has the job."""
    command: list[str] | None
    """The job's; None in notes from before it was noted."""


def read_submissions(folder: Path) -> dict[str, Submission]:
    """What was submitted from there, by the jobs' names; {} if nothing ever was."""
    path = folder / NOTE
    noted = json.loads(path.read_text()) if path.is_file() else {}
    return {
        name: Submission(what, None) if isinstance(what, str) else Submission(**what)
        for name, what in noted.items()
    }


def read_submitted(folder: Path) -> dict[str, str]:
    """The id of the element that had each job last, by name; {} if nothing was ever submitted from there."""
    return {name: submission.element for name, submission in read_submissions(folder).items()}


def write_submissions(folder: Path, submissions: dict[str, Submission]) -> None:
    """Replace the note in one step."""
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f".{NOTE}"
    partial.write_text(json.dumps({name: asdict(what) for name, what in submissions.items()}, indent=2))
    os.replace(partial, folder / NOTE)


def other_flags(jobs: Iterable[Job], queued: dict[str, Submission]) -> str | None:
    """Which of these jobs are in the queue with other flags, and what to do; None if there are none.

    An element runs the command that it was submitted with, whatever is asked for now.
    """
    found: dict[str, list[str]] = {}
    for job in jobs:
        noted = queued[job.name].command if job.name in queued else None
        if noted is not None and (differing := differing_flags(job, noted)):
            found[job.name] = differing
    if not found:
        return None
    first, differing = next(iter(found.items()))
    more = f", and so are {len(found) - 1} more" if len(found) > 1 else ""
    elements = " ".join(dict.fromkeys(queued[name].element for name in found))
    return (
        f"{first} is in the queue with other flags ({'; '.join(differing)}){more}: give those, or another --root,"
        f" or take it out of the queue: scancel {elements}"
    )
