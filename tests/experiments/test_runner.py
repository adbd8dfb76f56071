"""The runner with tiny real commands: order, skipping, resuming, failing, stopping."""

import fcntl
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_jobs import Tape, count_job, python_job, run

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
    write_record,
)
from cronos_lerobot.experiments.runner import Runner


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.runner.POLL_S", 0.02)


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
        count_job(tmp_path, "b", needs=("a",), reads=(tmp_path / "a/checkpoint",)),
        count_job(tmp_path, "c", needs=("b",)),
        count_job(tmp_path, "d"),
    ]
    states = Runner(jobs, 1, LineDisplay([])).run()
    assert states == {"a": "failed", "b": "blocked", "c": "blocked", "d": "done"}
    out = capsys.readouterr().out
    assert "so far so good\nthe disk is full" in out
    assert "b: blocked, it needs a job that is not done\n" in out
    assert not (tmp_path / "b").exists()
    assert (read_record(jobs[0])["status"], read_record(jobs[0])["returncode"]) == ("failed", 1)


def test_what_came_without_its_checkpoint_blocks_those_who_read_it_and_is_left_alone(tmp_path, capsys):
    made = python_job(tmp_path, "a", "(out / 'metrics').touch(); (out / 'checkpoint').touch()")
    read = tmp_path / "a/checkpoint"
    assert Runner([made], 1, LineDisplay([])).run() == {"a": "done"}
    read.unlink()
    reader, other = count_job(tmp_path, "b", needs=("a",), reads=(read,)), count_job(tmp_path, "c", needs=("a",))
    jobs = [made, reader, other]
    assert Runner(jobs, 1, LineDisplay([])).run() == {"a": "done", "b": "blocked", "c": "done"}
    assert f"b: blocked, {read} is not there: a came without checkpoints" in capsys.readouterr().out
    assert (tmp_path / "a/metrics").exists()
    assert not (tmp_path / "b").exists()
    # What was made of it before is as good as ever.
    read.touch()
    assert Runner(jobs, 1, LineDisplay([])).run()["b"] == "done"
    read.unlink()
    assert Runner(jobs, 1, LineDisplay([])).run() == {"a": "done", "b": "done", "c": "done"}


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
    assert changed_flags(new) == ["--lr=1 there, --lr=2 here"]
    states = Runner([new, count_job(tmp_path, "b", needs=("a",))], 1, LineDisplay([])).run()
    assert states == {"a": "changed", "b": "blocked"}
    assert "--lr=1 there, --lr=2 here" in capsys.readouterr().out
    assert json.loads(old.record.read_text()) == record
    # Once its output is out of the way it runs.
    (tmp_path / "a").rmdir()
    assert Runner([python_job(tmp_path, "a", "")], 1, LineDisplay([])).run() == {"a": "done"}


def rooted_job(root, policy="base/clone", seed=1):
    root = Path(root)
    command = ("train", f"--policy.path={root / policy}", f"--seed={seed}", f"--output_dir={root / 'runs/a'}")
    return Job("a", command, root / "runs/a", root=root)


@pytest.mark.parametrize("noted", ["outputs/reproduce", "/elsewhere/x", ".", "outputs/runs/a"])
def test_a_root_may_be_moved_or_named_another_way(tmp_path, noted):
    here = rooted_job(tmp_path)
    here.output.mkdir(parents=True)
    record = {"command": [], "status": "done", "seconds": 1.0, "starts": 1, "made_by": made_by(here)}
    write_record(here, record | {"command": list(rooted_job(noted).command)})
    assert (changes(here), is_done(here)) == ([], True)
    assert changes(rooted_job(tmp_path, seed=2)) == ["--seed=1 there, --seed=2 here"]
    # Another policy is another policy, below the root or not.
    (other,) = changes(rooted_job(tmp_path, policy="base/other"))
    assert other.endswith(f"base/clone there, --policy.path={tmp_path}/base/other here")
    assert changes(rooted_job(tmp_path, policy="/base/clone")) != []
    # The note of another output, and of a job that has no root.
    assert changes(replace(here, root=None)) != []
    write_record(here, record | {"command": [flag.replace("runs/a", "runs/b") for flag in here.command]})
    assert changes(here) == [f"--output_dir={tmp_path}/runs/b there, --output_dir={tmp_path}/runs/a here"]


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


def test_a_folder_that_somebody_writes_to_by_hand_is_waited_for_and_left_alone(tmp_path):
    """Without the job's claim: the command was copied from the log."""
    job = python_job(tmp_path, "a", "raise SystemExit('once')")
    run([job])
    hold = "import sys, time; from cronos_lerobot.locks import FolderLock\n"
    hold += "with FolderLock(sys.argv[1]): print('held', flush=True); time.sleep(1)"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(job.output)], stdout=subprocess.PIPE, text=True, env=environment
    ) as by_hand:
        assert by_hand.stdout.readline() == "held\n"
        (job.output / "by_hand").touch()
        _, tape = run([replace(job, resume=lambda: ["python", "-c", "pass"])])
        assert by_hand.poll() == 0
    assert [what for _, what in tape.events][1:] == ["resumed", "done"]
    assert "another process" in tape.events[0][1]
    assert (job.output / "by_hand").exists()


def test_a_lock_is_for_all_who_may_write_to_the_folder(tmp_path):
    before = os.umask(0o002)
    try:
        os.close(lock(count_job(tmp_path, "a")))
    finally:
        os.umask(before)
    assert (tmp_path / ".a.job.lock").stat().st_mode & 0o777 == 0o664


def test_another_user_s_lock_that_may_only_be_read_is_taken_all_the_same(tmp_path, monkeypatch):
    job = count_job(tmp_path, "a")
    (tmp_path / ".a.job.lock").touch()
    open_ = os.open

    def refuse_writing(path, flags, mode=0o777):
        if flags & os.O_RDWR:
            raise PermissionError(13, "Permission denied")
        return open_(path, flags, mode)

    monkeypatch.setattr("cronos_lerobot.experiments.jobs.os.open", refuse_writing)
    held = lock(job)
    assert lock(job) is None
    os.close(held)


def test_of_what_may_only_be_read_the_note_is_believed(tmp_path, monkeypatch):
    job = count_job(tmp_path, "a")
    run([job])
    job.record.write_text(json.dumps(json.loads(job.record.read_text()) | {"status": "running"}))
    assert status(job) == "stopped"

    def refuse(*args):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("cronos_lerobot.experiments.jobs.os.open", refuse)
    assert status(job) == "running"


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


def test_what_came_without_its_note_is_said_and_left_alone_with_what_was_made_of_it(tmp_path, capsys):
    made = count_job(tmp_path, "a", made_from_it=(tmp_path / "b",))
    jobs = [made, count_job(tmp_path, "b", needs=("a",))]
    run(jobs)
    note = made.record.read_text()
    made.record.unlink()
    assert Runner(jobs, 1, LineDisplay([])).run() == {"a": "changed", "b": "done"}
    out = capsys.readouterr().out
    assert f"{tmp_path}/a has no note, so nobody knows what made it: copy a.job.json from where it was made" in out
    assert "Delete it, choose another --root" in out
    assert [(tmp_path / name / "n").read_text() for name in "ab"] == ["x", "x"]
    # With its note it is what it was.
    made.record.write_text(note)
    assert run(jobs)[0] == {"a": "done", "b": "done"}
    # An empty folder is nothing to lose.
    (tmp_path / "c").mkdir()
    assert run([count_job(tmp_path, "c")])[0] == {"c": "done"}
    assert (tmp_path / "c/n").read_text() == "x"


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


def test_runs_of_an_edited_plugin_are_not_taken_for_those_of_todays(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "a_strategy_of_mine"
    package.mkdir()
    (package / "__init__.py").write_text("from a_strategy_of_mine.rule import K\n")
    (package / "rule.py").write_text("K = 3\n")
    job = count_job(tmp_path, "a")
    job = replace(job, command=(*job.command, "--protocol.discover_packages_path=a_strategy_of_mine"))
    run([job])
    assert is_done(job)
    (package / "rule.py").write_text("K = 2\n")
    (change,) = changes(job)
    assert re.fullmatch(r"the module a_strategy_of_mine [0-9a-f]{16} there, [0-9a-f]{16} here", change)
    assert not is_done(job)
    # A report elsewhere does without it.
    shutil.rmtree(package)
    importlib.invalidate_caches()
    assert is_done(job)


def test_runs_of_a_policy_that_was_made_anew_in_its_folder_are_not_taken_for_todays(tmp_path):
    policy, root = tmp_path / "my_policy", tmp_path / "root"
    policy.mkdir()
    (policy / "model.safetensors").write_bytes(b"first")
    job = replace(count_job(root, "a"), root=root)
    job = replace(job, command=(*job.command, f"--policy.path={policy}"))
    run([job])
    assert is_done(job)
    (policy / "train_config.json").write_text("{}")  # says how it was made, not how it acts
    assert is_done(job)
    (policy / "model.safetensors").write_bytes(b"second")
    (change,) = changes(job)
    assert re.fullmatch(rf"the policy {policy} [0-9a-f]{{16}} there, [0-9a-f]{{16}} here", change)
    assert not is_done(job)
    # A report elsewhere does without it.
    shutil.rmtree(policy)
    assert is_done(job)
    # Another job's output has a note of its own.
    policy.mkdir()
    assert f"the policy {policy}" in made_by(job)
    assert f"the policy {policy}" not in made_by(replace(job, needs=("clone",)))


def test_another_commit_alone_is_only_noted(tmp_path, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.runner.this_commit", lambda: "0123abc")
    job = count_job(tmp_path, "a")
    run([job])
    monkeypatch.setattr("cronos_lerobot.experiments.jobs.this_commit", lambda: "4567def")
    assert (is_done(job), other_commits(job)) == (True, ["0123abc"])


def test_two_jobs_of_one_name(tmp_path):
    with pytest.raises(ValueError, match="same name"):
        Runner([count_job(tmp_path, "a"), count_job(tmp_path, "a")], 1, Tape())


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
