"""Which jobs go into which array of a cluster, and what each array waits for."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence

from cronos_lerobot.experiments.jobs import BASE, EVALUATION, Job, changes, continuation, is_done, missing

Elements = list[list[Job]]
"""Of an array: the jobs of each, needs before those who need them."""


def held_up(jobs: Iterable[Job], queued: Container[str] = ()) -> list[str]:
    """The names of those that cannot run whatever is run: they need what is not theirs, or lack what they read.

    Args:
        jobs: needs come before those who need them.
        queued: what is in the queue, by name, and may be done soon.
    """
    found: list[str] = []
    known: dict[str, Job] = {}
    wrong: set[str] = set()
    for job in jobs:
        known[job.name] = job
        if changes(job):
            wrong.add(job.name)
        elif not is_done(job):
            is_early = any(name in queued or (name in known and not is_done(known[name])) for name in job.needs)
            if any(name in wrong for name in job.needs) or (not is_early and missing(job)):
                found.append(job.name)
                wrong.add(job.name)
    return found


def to_be_made(jobs: Sequence[Job], queued: Container[str] = ()) -> list[Job]:
    """Those that are not done, or will not be: what is begun anew takes with it what was made of it.

    Not what is `held_up`.
    """
    blocked = held_up(jobs, queued)
    unfinished = [job for job in jobs if not changes(job) and not is_done(job) and job.name not in blocked]
    gone = [folder for job in unfinished if continuation(job) is None for folder in job.made_from_it]
    lost = [job for job in jobs if is_done(job) and any(job.output.is_relative_to(folder) for folder in gone)]
    return [*unfinished, *lost]


def plan_arrays(jobs: Sequence[Job], waiting: Iterable[Job]) -> tuple[Elements, Elements, Elements]:
    """Return what each element of the three arrays runs.

    Args:
        jobs: all of them.
        waiting: those that are to be run.

    Returns:
        Base policies, each with its demonstrations; runs, and after them what waits for no run of these; and the
        evaluations of the first of these runs, element by element.
    """
    names = {job.name for job in waiting}
    jobs = [job for job in jobs if job.name in names]
    bases: dict[str, list[Job]] = {}
    evaluations: dict[str, list[Job]] = {}
    runs: list[Job] = []
    for job in jobs:
        if job.stage == BASE:
            bases.setdefault(job.name.rpartition("/")[0], []).append(job)
        elif job.stage == EVALUATION:
            evaluations.setdefault(job.needs[0] if job.needs else job.name, []).append(job)
        else:
            runs.append(job)
    runs.sort(key=lambda job: job.name not in evaluations)
    behind = [evaluations.pop(job.name) for job in runs if job.name in evaluations]
    return list(bases.values()), [*([job] for job in runs), *evaluations.values()], behind


def needs_of_others(element: list[Job], made: dict[str, Job]) -> list[Job]:
    """The jobs that an element needs and others make."""
    own = {job.name for job in element}
    return [made[name] for name in dict.fromkeys(need for job in element for need in job.needs) if name not in own]


def behind_runs(elements: Elements, queued: Container[str], made: Mapping[str, Job]) -> tuple[Elements, Elements]:
    """Those that wait for a run in the queue, and the others, which need not wait for it."""
    parts: tuple[Elements, Elements] = [], []
    for element in elements:
        needs = [need for job in element for need in job.needs]
        parts[not any(need in queued and made[need].stage != BASE for need in needs)].append(element)
    return parts


def after_any(elements: Elements, ids: Mapping[str, str]) -> str | None:
    """The dependency of an array on all that its elements need."""
    needed = {need for element in elements for job in element for need in job.needs}
    first = sorted({number for name, number in ids.items() if name in needed})
    return f"afterany:{':'.join(first)}" if first else None


def after_each(ids: list[str], number: int) -> str | None:
    """The dependency of an array of `number` elements on the first ones of another, one by one."""
    if not number:
        return None
    if number == 1:
        return f"afterok:{ids[0]}"
    return f"aftercorr:{ids[0].split('_')[0]}"
