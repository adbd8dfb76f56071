"""Follows jobs in a cluster's queue until all of them are over."""

from __future__ import annotations

import time
from collections.abc import Sequence

from cronos_lerobot.experiments.arrays import held_up
from cronos_lerobot.experiments.jobs import RUNNING, Job, changes, is_done, missing, read_record
from cronos_lerobot.experiments.runner import BLOCKED, CHANGED, DONE, FAILED, MISSING, Display
from cronos_lerobot.experiments.slurm import LATE_S, PENDING, Cluster, squeue
from cronos_lerobot.experiments.submitted import SlurmError

POLL_S = 5.0
"""How often the queue is asked [s]."""


class Follower:
    """Tells a display what becomes of jobs that were submitted.

    Args:
        jobs: each name once.
        submitted: the element of an array that has each job, by name.
        cluster: where they were submitted.
        display: shows what happens.
    """

    def __init__(self, jobs: Sequence[Job], submitted: dict[str, str], cluster: Cluster, display: Display) -> None:
        self.jobs, self.submitted, self.cluster, self.display = list(jobs), submitted, cluster, display
        self.states: dict[str, str] = {}
        # Done once, and in the queue again: what they were made of is made anew.
        self._again = {job.name for job in self.jobs if job.name in submitted and is_done(job)}
        self._missed_since: dict[str, float] = {}
        self._seen: dict[str, tuple[str | None, int]] = {}

    def run(self) -> dict[str, str]:
        """Follow to the end; returns the state of every job by name.

        Raises:
            KeyboardInterrupt: Ctrl-C; the jobs go on.
        """
        blocked = held_up(self.jobs, self.submitted)
        for job in self.jobs:
            if changes(job):
                self._finish(job, CHANGED)
            elif job.name in blocked and job.name not in self.submitted:
                self._finish(job, BLOCKED, MISSING if missing(job) else None)
            elif is_done(job) and job.name not in self._again:
                self.states[job.name] = DONE
            elif job.name in self.submitted:
                self.display.event(job, f"is in the queue, {self.submitted[job.name]}")
        while True:
            running = self.look()
            self.display.update(self.states, running)
            if len(self.states) == len(self.jobs):
                return self.states
            time.sleep(POLL_S)

    def look(self) -> list[Job]:
        """Look once; returns the jobs that run."""
        try:
            queue = squeue()
        except SlurmError:
            # A busy controller answers later.
            return []
        running = []
        for job in self.jobs:
            if job.name in self.states:
                continue
            queued = queue.get(self.submitted.get(job.name, ""))
            if not is_done(job):
                self._again.discard(job.name)
            elif not (queued and job.name in self._again):
                self._finish(job, DONE)
                continue
            record = read_record(job)
            if queued:
                self._missed_since.pop(job.name, None)
                # Where an element was killed and requeued, the note says `running` until the next start.
                if record.get("status") == RUNNING and queued[0] != PENDING:
                    running.append(job)
                self._tell(job, record)
                continue
            now = time.monotonic()
            if now - self._missed_since.setdefault(job.name, now) >= LATE_S:
                self._lost(job)
        return running

    def _tell(self, job: Job, record: dict) -> None:
        """Of a start, a stop and a new start, once each."""
        now = record.get("status"), record.get("starts", 0)
        if record and self._seen.get(job.name) != now:
            again = "goes on" if now[1] > 1 and now[0] == RUNNING else now[0]
            self.display.event(job, f"{again} (start {now[1]})" if now[1] > 1 else str(again))
            self._seen[job.name] = now

    def _lost(self, job: Job) -> None:
        number = self.submitted.get(job.name)
        log = "" if number is None else f", see {self.cluster.log(number)}"
        self.display.event(job, f"left the queue and is not done{log}")
        self._finish(job, FAILED)

    def _finish(self, job: Job, state: str, event: str | None = None) -> None:
        self.states[job.name] = state
        self.display.event(job, event or state)
