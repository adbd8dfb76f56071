"""Jobs of one line, and a display that remembers."""

from cronos_lerobot.experiments.jobs import Job
from cronos_lerobot.experiments.runner import Runner


class Tape:
    """A display that remembers."""

    def __init__(self):
        self.events, self.most = [], 0

    def event(self, job, what):
        self.events.append((job.name, what))

    def update(self, states, running):
        self.most = max(self.most, len(running))


def python_job(folder, name, code, **options):
    """`code` runs with `out`, the job's folder, which it finds made."""
    lines = (
        f"import pathlib, sys, time\nout = pathlib.Path({str(folder / name)!r})\nout.mkdir(exist_ok=True)\n{code}"
    )
    return Job(name, ("python", "-c", lines), folder / name, **options)


def count_job(folder, name, **options):
    """Adds an x to a file for each time it runs."""
    return python_job(folder, name, "(out / 'n').open('a').write('x')", **options)


def run(jobs, parallel=2):
    tape = Tape()
    return Runner(jobs, parallel, tape).run(), tape
