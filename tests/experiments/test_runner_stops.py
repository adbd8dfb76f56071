"""What is told to stop, or killed: commands have time to save, and nothing runs on unseen."""

import errno
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest
from tiny_jobs import Tape, python_job, run

from cronos_lerobot.experiments.jobs import (
    Job,
    lock,
    read_record,
    status,
)
from cronos_lerobot.experiments.runner import STOPPING, Runner


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.runner.POLL_S", 0.02)


RUNNER = """
import pathlib, sys
from cronos_lerobot.experiments.display import LineDisplay
from cronos_lerobot.experiments.jobs import Job
from cronos_lerobot.experiments.runner import Runner
out = pathlib.Path(sys.argv[1])
code = (
    "import pathlib, subprocess, sys, time; p = pathlib.Path(sys.argv[1]); p.mkdir(); "
    "child = subprocess.Popen(['sleep', '60']); (p / 'pid').write_text(str(child.pid)); time.sleep(60)"
)
job = Job("a", ("python", "-c", code, str(out / "a")), out / "a")
try:
    Runner([job], 1, LineDisplay([])).run()
except KeyboardInterrupt:
    sys.exit(7)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_stop_the_children_and_theirs(tmp_path, number):
    def as_a_terminal_has_it():
        # Some shells start background commands with SIGINT ignored, nohup with SIGHUP.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(RUNNER), str(tmp_path)], preexec_fn=as_a_terminal_has_it
    )
    pid = tmp_path / "a/pid"
    deadline = time.monotonic() + 60
    while not (pid.exists() and pid.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(timeout=30) == 7
    assert json.loads((tmp_path / "a.job.json").read_text())["status"] == "stopped"
    time.sleep(0.2)
    with pytest.raises(ProcessLookupError):
        _raise_if_gone(int(pid.read_text()))


TRAPPING = """
import signal
def end(number, frame):
    time.sleep({after})
    (out / 'saved').touch()
    sys.exit({code})
signal.signal(signal.SIGTERM, end)
(out / 'ready').touch()
time.sleep(60)
"""


class Interrupting(Tape):
    """Ctrl-C, once all jobs are ready."""

    def __init__(self, jobs):
        super().__init__()
        self.jobs = jobs

    def update(self, states, running):
        if all((job.output / "ready").exists() for job in self.jobs):
            raise KeyboardInterrupt


def test_a_job_has_time_to_save_but_not_for_ever(tmp_path):
    ends = {"saves": (0.3, 1), "at_its_end": (0, 0), "for_ever": (60, 1)}
    jobs = [
        python_job(tmp_path, name, TRAPPING.format(after=after, code=code)) for name, (after, code) in ends.items()
    ]
    with pytest.raises(KeyboardInterrupt):
        Runner(jobs, 3, Interrupting(jobs), grace_s=2).run()
    assert [(job.output / "saved").exists() for job in jobs] == [True, True, False]
    notes = [(record["status"], record["returncode"]) for record in map(read_record, jobs)]
    assert notes == [("stopped", 1), ("done", 0), ("stopped", -signal.SIGKILL)]


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_what_follows_ctrl_c_at_once_does_not_keep_a_job_from_saving(tmp_path, number):
    """A terminal that is closed after it, or an echo."""

    class Following(Interrupting):
        def event(self, job, what):
            super().event(job, what)
            if what == STOPPING:
                threading.Timer(0.2, signal.raise_signal, [number]).start()

    job = python_job(tmp_path, "a", TRAPPING.format(after=1, code=1))
    before = {n: signal.getsignal(n) for n in (signal.SIGHUP, signal.SIGTERM)}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        previous = signal.signal(signal.SIGINT, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            Runner([job], 1, Following([job])).run()
    finally:
        signal.signal(signal.SIGINT, previous)
        for n, handler in before.items():
            signal.signal(n, handler)
    assert (job.output / "saved").exists()
    assert read_record(job)["returncode"] == 1


def test_a_runner_that_is_stopped_twice_asks_once(tmp_path):
    """A time limit may come while a preempted job is being stopped."""

    class Stopping(Interrupting):
        def event(self, job, what):
            super().event(job, what)
            if what == STOPPING and not self.again:
                self.again = True
                threading.Timer(0.2, signal.raise_signal, [signal.SIGUSR2]).start()

    code = TRAPPING.replace("time.sleep({after})", "(out / 'asked').open('a').write('x'); time.sleep({after})")
    job = python_job(tmp_path, "a", code.format(after=1, code=1))
    display = Stopping([job])
    display.again = False
    runner = Runner([job], 1, display)
    before = signal.signal(signal.SIGUSR2, lambda number, frame: runner.stop())
    try:
        with pytest.raises(KeyboardInterrupt):
            runner.run()
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert ((job.output / "asked").read_text(), (job.output / "saved").exists()) == ("x", True)


class Gone(Interrupting):
    """A terminal that was closed while jobs ran."""

    def event(self, job, what):
        super().event(job, what)
        if what not in ("started", "done"):
            raise OSError(errno.EIO, "Input/output error")


def test_a_terminal_that_is_gone_does_not_keep_jobs_from_being_stopped(tmp_path):
    job = python_job(tmp_path, "a", TRAPPING.format(after=0, code=1))
    display = Gone([job])
    with pytest.raises(KeyboardInterrupt):
        Runner([job], 1, display).run()
    assert [what for _, what in display.events] == ["started", STOPPING, "stopped"]
    assert (job.output / "saved").exists()
    assert read_record(job)["status"] == "stopped"


def test_child_of_a_killed_runner_keeps_its_claim(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(RUNNER), str(tmp_path)])
    pid = tmp_path / "a/pid"
    deadline = time.monotonic() + 60
    while not (pid.exists() and pid.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    job = Job("a", ("python",), tmp_path / "a")
    try:
        assert lock(job) is None
        assert status(job) == "running"
    finally:
        # The child leads a group of its own, its `sleep` is in it.
        os.killpg(os.getpgid(int(pid.read_text())), signal.SIGKILL)
    deadline = time.monotonic() + 10
    while (claim := lock(job)) is None and time.monotonic() < deadline:
        time.sleep(0.05)
    assert claim is not None
    os.close(claim)
    # The note still says that it runs, but nobody has the claim.
    assert (read_record(job)["status"], status(job)) == ("running", "stopped")


def _raise_if_gone(pid):
    os.kill(pid, 0)
    # A zombie that nobody has waited for yet is gone too.
    if f"{pid} (sleep) Z" in Path(f"/proc/{pid}/stat").read_text():
        raise ProcessLookupError


def test_a_folder_that_is_deleted_while_its_job_runs_fails_that_job_alone(tmp_path):
    (tmp_path / "a").mkdir()
    a = python_job(tmp_path / "a", "a", f"import shutil; time.sleep(0.3); shutil.rmtree({str(tmp_path / 'a')!r})")
    b = python_job(tmp_path, "b", "time.sleep(0.6)")
    states, _ = run([a, b], parallel=2)
    assert states == {"a": "failed", "b": "done"}
    assert (read_record(a)["status"], read_record(b)["status"]) == ("failed", "done")
