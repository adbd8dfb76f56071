"""Runs jobs, several at a time, and stops them cleanly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from cronos_lerobot.experiments.arithmetic import portable_arithmetic
from cronos_lerobot.experiments.jobs import (
    RUNNING,
    STOPPED,
    Job,
    changes,
    continuation,
    is_done,
    lock,
    made_by,
    missing,
    read_record,
    this_commit,
    write_record,
)
from cronos_lerobot.experiments.signals import blocked
from cronos_lerobot.locks import FolderInUseError, FolderLock
from cronos_lerobot.training.stopping import SAME_S

POLL_S = 0.5
"""How often the running jobs are looked at [s]."""
GRACE_S = 120.0
"""How long a job may take to end after it was asked to [s]: `cronos-train` ends its update and saves."""
KILL_S = 15.0
"""How long one may take that was killed [s]."""
ELSEWHERE = "is being run by another process: waiting for it"
STOPPING = "was asked to stop; Ctrl-C ends it at once"
DONE, FAILED, CHANGED, BLOCKED = "done", "failed", "changed", "blocked"
MISSING = "missing"
"""Why a job is blocked whose needs are done: what it reads of them is not there."""
ENDING_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
"""Those that end the runner as Ctrl-C does; the second is a closed terminal's."""
TIME_LIMIT_SIGNAL = signal.SIGUSR2
"""A cluster sends it to all processes of a job before its time ends. It is the runner's process that knows what to
do; the commands it would kill."""


class Display(Protocol):
    """Shows what happens."""

    def event(self, job: Job, what: str) -> None:
        """Something happened to a job: it was started, resumed, done, failed ..."""

    def update(self, states: dict[str, str], running: Sequence[Job]) -> None:
        """Called a few times a second; `states` has the jobs that are over."""


@dataclass
class _Child:
    job: Job
    process: subprocess.Popen
    lock: int
    record: dict[str, Any]
    """Its note: the folder with the one on disk may be deleted meanwhile."""
    started: float = field(default_factory=time.time)
    is_asked: bool = False
    """Whether it was asked to end."""


class Runner:
    """Runs jobs whose needs are done, at most `parallel` at a time.

    Jobs that are done are skipped, unfinished ones resumed, those that were made by another command or
    version left alone and reported. What needs a job that is not done, or that has come without its
    checkpoints, is blocked; everything else goes on.

    Args:
        jobs: each name once; needs come before those who need them.
        parallel: how many run at once.
        display: shows what happens.
        environment: variables of the commands, besides those of this process and `portable_arithmetic`.
        grace_s: how long a job may take to end after it was asked to [s].
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        parallel: int,
        display: Display,
        environment: dict[str, str] | None = None,
        grace_s: float = GRACE_S,
    ) -> None:
        self.jobs = {job.name: job for job in jobs}
        if len(self.jobs) < len(jobs):
            raise ValueError("two jobs have the same name")
        if parallel < 1:
            raise ValueError(f"at least one job must run at a time, got {parallel}")
        self.parallel, self.display, self.grace_s = parallel, display, grace_s
        # Unbuffered, so that a log says in time, and in order, what its command does.
        self.environment = os.environ | {"PYTHONUNBUFFERED": "1"} | (environment or {})
        self.states: dict[str, str] = {}
        self._children: list[_Child] = []
        self._elsewhere: set[str] = set()

    def run(self) -> dict[str, str]:
        """Run until nothing can run any more; returns the state of every job by name.

        Raises:
            KeyboardInterrupt: Ctrl-C, SIGTERM or a closed terminal; the running jobs have been stopped and can be
                resumed.
        """
        previous = raise_on_signals()
        try:
            for job in self.jobs.values():
                self._look_up(job)
            while len(self.states) < len(self.jobs):
                self._collect()
                self._start_what_can()
                self.display.update(self.states, [child.job for child in self._children])
                time.sleep(POLL_S)
        finally:
            self.stop()
            for number, handler in previous.items():
                signal.signal(number, handler)
        self.display.update(self.states, [])
        return self.states

    def _look_up(self, job: Job) -> None:
        if changes(job):
            self._finish(job, CHANGED)
        elif is_done(job):
            self.states[job.name] = DONE

    def _start_what_can(self) -> None:
        busy = {child.job.name for child in self._children}
        for job in self.jobs.values():
            if job.name in self.states or job.name in busy:
                continue
            needs = [self.states.get(name) for name in job.needs]
            are_done = all(state == DONE for state in needs)
            if any(state not in (None, DONE) for state in needs):
                self._finish(job, BLOCKED)
            elif are_done and missing(job):
                self._finish(job, BLOCKED, MISSING)
            elif are_done and len(self._children) < self.parallel:
                self._start(job)

    def _start(self, job: Job) -> None:
        claim = lock(job)
        if claim is None:
            self._wait_for_others(job)
            return
        self._look_up(job)
        if job.name in self.states:
            os.close(claim)
            return
        record: dict[str, Any] = read_record(job)
        resumed = continuation(job)
        try:
            # Whoever runs the command by hand has no claim, but the folder.
            with FolderLock(job.output):
                if resumed is None:
                    job.remove_output()
        except FolderInUseError:
            os.close(claim)
            self._wait_for_others(job)
            return
        if resumed is None:
            gone = [name for name, state in self.states.items() if state == DONE and not is_done(self.jobs[name])]
            for name in gone:
                del self.states[name]
            record = {"command": list(job.command), "seconds": 0.0, "starts": 0, "made_by": made_by(job)}
        commits = [*record.get("commits", []), *filter(None, [this_commit()])]
        record |= {"status": RUNNING, "starts": record["starts"] + 1, "commits": list(dict.fromkeys(commits))}
        write_record(job, record)
        command = resumed or list(job.command)
        # A session of its own: Ctrl-C reaches us alone, and we stop it and whatever it has started.
        with job.log.open("ab") as log, blocked(TIME_LIMIT_SIGNAL):
            log.write(f"$ {' '.join(command)}\n".encode())
            log.flush()
            process = subprocess.Popen(
                [_program(command[0]), *command[1:]],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=portable_arithmetic(command[0]) | self.environment,
                start_new_session=True,
                pass_fds=(claim,),
            )
        self._children.append(_Child(job, process, claim, record))
        self.display.event(job, "resumed" if resumed else "started")

    def _wait_for_others(self, job: Job) -> None:
        """Another process is at it: look again until it is through."""
        if job.name not in self._elsewhere:
            self._elsewhere.add(job.name)
            self.display.event(job, ELSEWHERE)

    def _collect(self) -> None:
        for child in list(self._children):
            code = child.process.poll()
            if code is not None:
                state = DONE if code == 0 and child.job.output.exists() else FAILED
                self._end(child, state, {"returncode": code})
                self._finish(child.job, state)

    def _end(self, child: _Child, status: str, extra: dict[str, Any]) -> None:
        seconds = child.record["seconds"] + time.time() - child.started
        write_record(child.job, child.record | {"status": status, "seconds": round(seconds, 1)} | extra)
        os.close(child.lock)
        self._children.remove(child)

    def _finish(self, job: Job, state: str, event: str | None = None) -> None:
        self.states[job.name] = state
        self.display.event(job, event or state)

    def stop(self) -> None:
        """End the commands that still run: they can be resumed. Ctrl-C ends them at once.

        May be called again before it has returned, by a handler: then it only waits.
        """
        _silence_ending_signals()
        # Not by SIGINT: whoever starts us in the background has it ignored.
        for sent, limit_s in ((signal.SIGTERM, self.grace_s), (signal.SIGKILL, KILL_S)):
            # A second SIGTERM would end at once what the first one has made save.
            told = [child for child in self._children if sent == signal.SIGKILL or not child.is_asked]
            _signal_groups(told, sent)
            for child in told:
                child.is_asked = True
            with suppress(KeyboardInterrupt):
                if sent == signal.SIGTERM:
                    self._show({child.job.name: STOPPING for child in self._children})
                self._await_children(limit_s)
        ends = {}
        for child in list(self._children):
            code = child.process.wait()
            # It may have been at its end anyway.
            ends[child.job.name] = DONE if code == 0 else STOPPED
            self._end(child, ends[child.job.name], {"returncode": code})
        self._show(ends)

    def _show(self, events: dict[str, str]) -> None:
        """Show what happened to jobs while all is stopped, perhaps because the terminal is gone."""
        with suppress(OSError):
            for name, what in events.items():
                self.display.event(self.jobs[name], what)

    def _await_children(self, limit_s: float) -> None:
        began = time.monotonic()
        while time.monotonic() < began + limit_s:
            try:
                if all(child.process.poll() is not None for child in self._children):
                    return
                time.sleep(0.05)
            except KeyboardInterrupt:
                if time.monotonic() > began + SAME_S:
                    return


def _signal_groups(children: Sequence[_Child], number: int) -> None:
    for child in children:
        if child.process.poll() is None:
            os.killpg(child.process.pid, number)


def _program(name: str) -> str:
    """The script of the environment that this Python runs in, whatever PATH says."""
    return sys.executable if name == "python" else str(Path(sys.executable).with_name(name))


def _silence_ending_signals() -> None:
    """A terminal that closes sends several: the children are to be stopped in peace, but for Ctrl-C."""
    if threading.current_thread() is threading.main_thread():
        for number in ENDING_SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def usable_cores() -> int:
    """Cores that this process may use, which a job or a container may have fewer of than the machine.

    As the environment's `num_cores`, which MuJoCo's seconds would have to be imported for.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def raise_on_signals() -> dict[signal.Signals, Any]:
    """Let ENDING_SIGNALS end this process as Ctrl-C does; returns the handlers before."""
    if threading.current_thread() is not threading.main_thread():
        return {}

    def interrupt(number: int, frame: FrameType | None) -> None:
        _silence_ending_signals()
        raise KeyboardInterrupt

    # nohup has SIGHUP ignored, and means it.
    caught = [number for number in ENDING_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    return {number: signal.signal(number, interrupt) for number in caught}
