"""The runner with tiny real commands: order, skipping, resuming, failing, stopping."""

import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from cronos_lerobot.experiments.display import LineDisplay
from cronos_lerobot.experiments.jobs import (
    Job,
    Progress,
    changed_flags,
    changes,
    is_done,
    lock,
    made_by,
    other_commits,
    read_record,
    status,
)
from cronos_lerobot.experiments.runner import STOPPING, Runner


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


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.runner.POLL_S", 0.02)


def run(jobs, parallel=2):
    tape = Tape()
    return Runner(jobs, parallel, tape).run(), tape


def test_needs_come_first_and_done_jobs_are_skipped(tmp_path):
    needed = count_job(tmp_path, "a")
    copy = python_job(
        tmp_path, "b", f"(out / 'n').write_text(pathlib.Path({str(tmp_path / 'a/n')!r}).read_text())", needs=("a",)
    )
    states, tape = run([needed, copy])
    assert states == {"a": "done", "b": "done"}
    assert tape.events == [("a", "started"), ("a", "done"), ("b", "started"), ("b", "done")]
    assert (tmp_path / "b/n").read_text() == "x"
    states, tape = run([needed, copy])
    assert (states, tape.events) == ({"a": "done", "b": "done"}, [])
    assert (tmp_path / "a/n").read_text() == "x"
    assert read_record(needed)["command"] == list(needed.command)


def test_as_many_at_a_time_as_asked(tmp_path):
    jobs = [python_job(tmp_path, name, "time.sleep(0.3)") for name in "abcde"]
    assert run(jobs[:2], parallel=1)[1].most == 1
    assert run(jobs[2:], parallel=3)[1].most == 3


def test_failure_blocks_what_needs_it_and_nothing_else(tmp_path, capsys):
    jobs = [
        python_job(tmp_path, "a", "print('so far so good'); raise SystemExit('the disk is full')"),
        count_job(tmp_path, "b", needs=("a",)),
        count_job(tmp_path, "c", needs=("b",)),
        count_job(tmp_path, "d"),
    ]
    states = Runner(jobs, 1, LineDisplay([])).run()
    assert states == {"a": "failed", "b": "blocked", "c": "blocked", "d": "done"}
    out = capsys.readouterr().out
    assert "so far so good\nthe disk is full" in out
    assert not (tmp_path / "b").exists()
    assert (read_record(jobs[0])["status"], read_record(jobs[0])["returncode"]) == ("failed", 1)


def test_failed_job_is_resumed_where_it_can_be(tmp_path):
    half = "(out / 'n').open('a').write('half'); raise SystemExit(1)"
    rest = ["python", "-c", f"open({str(tmp_path / 'a/n')!r}, 'a').write(' and half')"]
    job = python_job(tmp_path, "a", half, resume=lambda: rest)
    assert run([job])[0] == {"a": "failed"}
    states, tape = run([job])
    assert (states, tape.events[0]) == ({"a": "done"}, ("a", "resumed"))
    assert (tmp_path / "a/n").read_text() == "half and half"
    record = read_record(job)
    # It is still known as what it was begun as.
    assert (record["command"], record["starts"]) == (list(job.command), 2)
    assert job.log.read_text().count("$ python") == 2


def test_failed_job_that_cannot_be_resumed_begins_anew(tmp_path):
    fails_once = (
        f"first = not pathlib.Path({str(tmp_path / 'once')!r}).exists(); (out / 'n').open('a').write('x')\n"
    )
    fails_once += f"pathlib.Path({str(tmp_path / 'once')!r}).touch(); sys.exit(first)"
    job = python_job(tmp_path, "a", fails_once)
    assert run([job])[0] == {"a": "failed"}
    assert run([job])[0] == {"a": "done"}
    assert (tmp_path / "a/n").read_text() == "x"


def test_changed_command_is_reported_and_its_output_left_alone(tmp_path, capsys):
    old = Job("a", ("python", "-c", "pass", "--seed=1", "--lr=1"), tmp_path / "a")
    (tmp_path / "a").mkdir()
    new = Job("a", ("python", "-c", "pass", "--seed=1", "--lr=2"), tmp_path / "a")
    run([python_job(tmp_path, "a", "")])
    record = json.loads(old.record.read_text()) | {"command": list(old.command)}
    old.record.write_text(json.dumps(record))
    assert is_done(old)
    assert not is_done(new)
    assert changed_flags(new) == ["---lr=1", "+--lr=2"]
    states = Runner([new, count_job(tmp_path, "b", needs=("a",))], 1, LineDisplay([])).run()
    assert states == {"a": "changed", "b": "blocked"}
    assert "+--lr=2" in capsys.readouterr().out
    assert json.loads(old.record.read_text()) == record
    # Once its output is out of the way it runs.
    (tmp_path / "a").rmdir()
    assert Runner([python_job(tmp_path, "a", "")], 1, LineDisplay([])).run() == {"a": "done"}


def test_lost_output_is_made_again(tmp_path):
    job = count_job(tmp_path, "a")
    run([job])
    (tmp_path / "a/n").unlink()
    (tmp_path / "a").rmdir()
    assert run([job])[0] == {"a": "done"}
    assert (tmp_path / "a/n").read_text() == "x"


def test_what_was_made_of_a_lost_output_is_made_again(tmp_path):
    made = count_job(tmp_path, "a", made_from_it=(tmp_path / "b",))
    jobs = [made, count_job(tmp_path, "b", needs=("a",)), count_job(tmp_path, "c")]
    run(jobs)
    shutil.rmtree(tmp_path / "a")
    states, tape = run(jobs, parallel=1)
    assert states == dict.fromkeys("abc", "done")
    assert tape.events == [("a", "started"), ("a", "done"), ("b", "started"), ("b", "done")]
    assert [(tmp_path / name / "n").read_text() for name in "abc"] == ["x"] * 3


def test_job_of_another_process_is_waited_for(tmp_path):
    job = count_job(tmp_path, "a")
    (tmp_path / ".a.job.lock").touch()
    with (tmp_path / ".a.job.lock").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        release = subprocess.Popen(
            [sys.executable, "-c", "import time; time.sleep(0.5)"], pass_fds=(held.fileno(),)
        )
    # This process has closed its end; the child holds on for half a second.
    start = time.monotonic()
    states, tape = run([job])
    assert states == {"a": "done"}
    assert time.monotonic() - start > 0.3
    assert "another process" in tape.events[0][1]
    assert release.wait() == 0


@pytest.mark.parametrize("text", ["", '{"command": ["pyth', "[]", '{"status": "done"}'])
def test_damaged_note_is_said_and_nothing_is_deleted_for_it(tmp_path, text, capsys):
    job = count_job(tmp_path, "a")
    run([job])
    job.record.write_text(text)
    assert (read_record(job), status(job), is_done(job)) == ({}, None, False)
    assert Runner([job], 1, LineDisplay([])).run() == {"a": "changed"}
    assert f"{job.record} is damaged" in capsys.readouterr().out
    assert (tmp_path / "a/n").read_text() == "x"
    # Without an output it is as if the job had not been started.
    shutil.rmtree(tmp_path / "a")
    assert run([job])[0] == {"a": "done"}
    assert (status(job), (tmp_path / "a/n").read_text()) == ("done", "x")


def test_output_of_another_version_is_not_taken_for_done(tmp_path, monkeypatch, capsys):
    job = count_job(tmp_path, "a", environment="lerobot_env_cronos/kitchen_2x2-v1")
    run([job])
    assert is_done(job)
    here = made_by(job)
    monkeypatch.setattr("cronos_lerobot.experiments.jobs.this_version", lambda: here | {"mujoco": "99.0"})
    newer = replace(job, environment="lerobot_env_cronos/kitchen_2x2-v7")
    mujoco = f"mujoco {here['mujoco']} there, 99.0 here"
    assert changes(job) == [mujoco]
    assert changes(newer) == [mujoco, f"environment {job.environment} there, {newer.environment} here"]
    assert Runner([job], 1, LineDisplay([])).run() == {"a": "changed"}
    out = capsys.readouterr().out
    assert mujoco in out
    assert "Delete it, choose another --root, or go back" in out
    # A note of version 0 has no versions at all.
    record = read_record(job)
    del record["made_by"]
    job.record.write_text(json.dumps(record))
    assert changes(job) == ["its note does not say which versions made it, as those of version 0"]


def test_another_commit_alone_is_only_noted(tmp_path, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.runner.this_commit", lambda: "0123abc")
    job = count_job(tmp_path, "a")
    run([job])
    monkeypatch.setattr("cronos_lerobot.experiments.jobs.this_commit", lambda: "4567def")
    assert (is_done(job), other_commits(job)) == (True, ["0123abc"])


def test_two_jobs_of_one_name(tmp_path):
    with pytest.raises(ValueError, match="same name"):
        Runner([count_job(tmp_path, "a"), count_job(tmp_path, "a")], 1, Tape())


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


def test_lines_of_progress(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("cronos_lerobot.experiments.display.LINE_INTERVAL_S", 0.0)
    clock = iter(range(0, 10_000, 600))
    monkeypatch.setattr("cronos_lerobot.experiments.display.time.monotonic", lambda: float(next(clock)))
    done = [0]

    def progress():
        return Progress(done[0], 1000, 90 * 60.0, "evaluation 0.50")

    running = Job("b", ("python",), tmp_path / "b", progress=progress, work=1000)
    jobs = [
        Job("a", ("python",), tmp_path / "a", work=1000),
        running,
        Job("c", ("python",), tmp_path / "c", work=1000),
    ]
    display = LineDisplay(jobs)
    display.update({"a": "done"}, [running])
    assert "left" not in capsys.readouterr().out.splitlines()[0]
    done[0] = 500
    display.update({"a": "done"}, [running])
    first, second = capsys.readouterr().out.splitlines()
    # 500 steps between two looks at the clock, three calls of it (half an hour) apart; 1500 steps are left.
    assert first.endswith("1 of 3 jobs done, about 1 h 30 min of training left")
    assert second == "    b: 500 / 1,000, evaluation 0.50, 1 h 30 min left"
