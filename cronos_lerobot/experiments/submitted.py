"""The note of what was submitted to a cluster: the element that has each job, its command and options."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from cronos_lerobot.experiments.jobs import Job, differing_flags
from cronos_lerobot.whole_files import written_whole

NOTE = "submitted.json"


class SlurmError(Exception):
    """Slurm, or what is needed to talk to it, is not there or refuses, or the note of what it has is damaged."""


@dataclass(frozen=True)
class Submission:
    """What was submitted last of a job."""

    element: str
    """Id of the element of an array that has the job."""
    command: list[str] | None
    """The job's; None in notes from before it was noted."""
    options: dict[str, str] | None = None
    """The array's, as flags and their values; None in notes from before they were noted."""


def read_submissions(folder: Path) -> dict[str, Submission]:
    """What was submitted from there, by the jobs' names; {} if nothing ever was.

    Raises:
        SlurmError: the note is damaged.
    """
    path = folder / NOTE
    try:
        noted = json.loads(path.read_text()) if path.is_file() else {}
        return {
            name: Submission(what, None) if isinstance(what, str) else Submission(**what)
            for name, what in noted.items()
        }
    except (ValueError, TypeError, AttributeError) as error:
        raise SlurmError(
            f"{path} is damaged ({error}): see with squeue what is in the queue, cancel it or let it end, and"
            " delete the file"
        ) from None


def read_submitted(folder: Path) -> dict[str, str]:
    """The id of the element that had each job last, by name; {} if nothing was ever submitted from there."""
    return {name: submission.element for name, submission in read_submissions(folder).items()}


def write_submissions(folder: Path, submissions: dict[str, Submission]) -> None:
    """Replace the note in one step."""
    with written_whole(folder / NOTE) as file:
        json.dump({name: asdict(what) for name, what in submissions.items()}, file, indent=2)


def other_options(queued: Mapping[str, Submission], options: Mapping[str, str]) -> str | None:
    """Which elements in the queue keep other options than these, and what to do; None if there are none.

    What is in the queue has its time limit, memory and the like from when it was submitted.
    """
    found: dict[str, list[str]] = {}
    for submission in queued.values():
        old = submission.options
        if old is not None and old != options:
            differing = [f for f in dict.fromkeys((*old, *options)) if old.get(f) != options.get(f)]
            text = ", ".join(f"{flag}={old[flag]}" if flag in old else f"no {flag}" for flag in differing)
            found.setdefault(text, []).append(submission.element)
    if not found:
        return None
    lines = [
        f"in the queue with {text}, which they keep: {' '.join(dict.fromkeys(elements))}"
        for text, elements in found.items()
    ]
    return "\n".join([*lines, "(scancel takes them out, and the same command submits them again)"])


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
