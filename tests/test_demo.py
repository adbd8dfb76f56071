"""`cronos-demo`: the pipeline's bookkeeping with trivial commands, and the real one at its smallest."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import pandas as pd
import pytest
from forked_commands import run_forked
from lerobot.datasets import LeRobotDataset

from cronos_lerobot.locks import FolderInUseError, FolderLock
from cronos_lerobot.report import page
from cronos_lerobot.scripts import demo, pipeline, probe
from cronos_lerobot.scripts.demo import SCALES, make_steps
from cronos_lerobot.scripts.pipeline import Step, StepFailedError, command_line, run_steps


def append_step(folder, name, text="x", **options):
    """A command that appends `text` to a file, so that the file tells how often it ran."""
    output = folder / f"{name}.txt"
    command = ["python", "-c", f"open({str(output)!r}, 'a').write({text!r})"]
    return Step(name, name.upper(), command, output, **options)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "out"


def contents(folder):
    return {path.stem: path.read_text() for path in sorted(folder.glob("*.txt"))}


def test_steps_that_are_done_are_skipped(folder, capsys):
    steps = [append_step(folder, "a"), append_step(folder, "b")]
    run_steps(steps, folder)
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.txt")}
    capsys.readouterr()
    run_steps(steps, folder)
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.txt")} == before
    assert capsys.readouterr().out.count("done before") == 2


def test_what_is_done_is_not_removed_for_another_command(folder):
    run_steps([append_step(folder, "a"), append_step(folder, "b"), append_step(folder, "c")], folder)
    for name in "abc":
        (folder / f"{name}.txt").write_text("touched")
    with pytest.raises(FileExistsError, match=r"b\.txt is done and was made otherwise \(.*now .*'new'.*: choose"):
        run_steps([append_step(folder, "a"), append_step(folder, "b", "new"), append_step(folder, "c")], folder)
    assert contents(folder) == dict.fromkeys("abc", "touched")


def test_another_command_begins_what_is_not_done_anew_and_so_do_all_after_it(folder):
    broken = Step("b", "B", ["python", "-c", "raise SystemExit(3)"], folder / "b.txt")
    with pytest.raises(StepFailedError):
        run_steps([append_step(folder, "a"), broken], folder)
    for name in "ab":
        (folder / f"{name}.txt").write_text("touched")
    run_steps([append_step(folder, "a"), append_step(folder, "b"), append_step(folder, "c")], folder)
    assert contents(folder) == {"a": "touched", "b": "x", "c": "x"}


def test_what_is_done_is_not_removed_for_other_versions(folder, monkeypatch):
    run_steps([append_step(folder, "a")], folder)
    monkeypatch.setattr(pipeline, "package_versions", lambda: {"lerobot": "0.0.0"})
    with pytest.raises(FileExistsError, match=r"lerobot .*, now 0\.0\.0"):
        run_steps([append_step(folder, "a")], folder)
    assert contents(folder) == {"a": "x"}


def test_a_folder_may_be_spelled_in_another_way(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "import sys; open(sys.argv[1].partition('=')[2], 'a').write('x')"

    def steps(folder):
        output = Path(folder, "a.txt")
        return [Step("a", "A", ["python", "-c", code, f"--output={output}"], output)]

    for folder in ("out", "./out/", tmp_path / "out"):
        run_steps(steps(folder), Path(folder))
    assert contents(tmp_path / "out") == {"a": "x"}


def test_lost_output_is_made_again(folder):
    steps = [append_step(folder, "a"), append_step(folder, "b")]
    run_steps(steps, folder)
    (folder / "a.txt").unlink()
    run_steps(steps, folder)
    assert contents(folder) == {"a": "x", "b": "x"}


def test_two_at_once_do_not_remove_what_the_other_makes(folder):
    with FolderLock(folder), pytest.raises(FolderInUseError, match="is being written by process"):
        run_steps([append_step(folder, "a")], folder)
    run_steps([append_step(folder, "a")], folder)
    assert contents(folder) == {"a": "x"}


def test_failed_step_is_resumed_where_it_can_be(folder):
    output = folder / "b.txt"
    fail = ["python", "-c", f"open({str(output)!r}, 'a').write('half'); raise SystemExit(3)"]
    resume = ["python", "-c", f"open({str(output)!r}, 'a').write(' and half')"]
    steps = [append_step(folder, "a"), Step("b", "B", fail, output, resume=lambda: resume)]
    with pytest.raises(StepFailedError, match="SystemExit"):
        run_steps(steps, folder)
    run_steps(steps, folder)
    assert contents(folder) == {"a": "x", "b": "half and half"}
    # Once it has run to its end, it is done.
    run_steps(steps, folder)
    assert contents(folder)["b"] == "half and half"


SAVING = """
import pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
def end(number, frame):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(1.5)
    (folder / "saved").touch()
    sys.exit(1)
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, end)
(folder / "ready").touch()
time.sleep(60)
"""


@pytest.mark.parametrize(("to_all", "number"), [(1, signal.SIGINT), (0, signal.SIGINT), (0, signal.SIGTERM)])
def test_a_signal_leaves_a_command_the_time_to_save(to_all, number, tmp_path):
    """Of a terminal, which sends it to the command as well, or of whoever knows the demo's process alone."""
    step = ("a", "A", ["python", "-c", SAVING, str(tmp_path)], tmp_path / "d/a")
    code = f"""
from pathlib import Path, PosixPath
from cronos_lerobot.scripts.pipeline import Step, run_steps
run_steps([Step(*{step})], Path({str(tmp_path / "d")!r}))
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Some shells start background commands with it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 60
    while not (tmp_path / "ready").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    (os.killpg if to_all else os.kill)(process.pid, number)
    _, said = process.communicate(timeout=30)
    assert (tmp_path / "saved").exists()
    assert said.endswith("KeyboardInterrupt\n")


def test_unfinished_output_without_resume_is_removed_first(folder):
    steps = [append_step(folder, "a")]
    run_steps(steps, folder)
    state = json.loads((folder / "demo.json").read_text())
    del state["a"]["done"]
    (folder / "demo.json").write_text(json.dumps(state))
    run_steps(steps, folder)
    assert contents(folder) == {"a": "x"}


def test_always_runs_again(folder):
    steps = [append_step(folder, "a"), append_step(folder, "b", always=True)]
    run_steps(steps, folder)
    for name in "ab":
        (folder / f"{name}.txt").write_text("touched")
    run_steps(steps, folder)
    assert contents(folder) == {"a": "touched", "b": "x"}


def test_folder_of_something_else_is_left_alone(folder):
    folder.mkdir()
    (folder / "a.txt").write_text("precious")
    with pytest.raises(FileExistsError, match="not of an earlier run"):
        run_steps([append_step(folder, "a")], folder)
    assert contents(folder) == {"a": "precious"}


def test_shown_command_can_be_copied(tmp_path):
    line = command_line(["printf", "%s,", "--a=1", "b c", "--d", "$e"])
    assert (
        subprocess.run(line, shell=True, capture_output=True, text=True, check=True).stdout == "--a=1,b c,--d,$e,"
    )


@pytest.mark.parametrize(("probe_s", "scale"), [(0.9, "full"), (3.0, "short")])
def test_a_slow_machine_gets_a_shorter_demo_and_is_told_the_time(folder, monkeypatch, capsys, probe_s, scale):
    monkeypatch.setattr(demo, "MINUTES_PER_PROBE_SECOND", {"full": 11.0, "short": 5.0})
    monkeypatch.setattr(probe, "measure", lambda: probe_s)
    assert demo.choose_scale(folder) == scale
    said = capsys.readouterr().out
    # 0.9 s * 11 min/s; 3 s * 5 and 3 s * 11.
    assert "about 10 min here" in said if scale == "full" else "about 15 min here" in said and "33 min" in said
    # Asked again, at another moment, the folder's demo stays the one that it is.
    monkeypatch.setattr(probe, "measure", lambda: 0.1)
    assert demo.choose_scale(folder) == scale


def test_the_page_is_where_the_demo_says():
    assert demo.PAGE == page.PAGE


def test_full_demo_evaluates_every_configuration_of_both_splits(tmp_path):
    commands = {step.name: step.command for step in make_steps(SCALES["full"], tmp_path)}
    for when in ("before", "after"):
        for split in ("train", "held_out"):
            assert {f"--env.split={split}", "--eval.n_episodes=64"} <= set(commands[f"{when}_{split}"])
    # Whole cycles between scene resets, so that success by segment is known for all segments.
    full = SCALES["full"]
    assert full.train_steps % (full.streams * full.scene_reset_interval) == 0


def test_demo_end_to_end(tmp_path, monkeypatch, capsys):
    def run(command):
        # What LeRobot films is small here.
        small = ["--env.render_size=[32, 32]"] if command[0] == "lerobot-eval" else []
        done = run_forked([*command, *small])
        print(done.stdout, done.stderr[-3000:])
        return done.returncode

    monkeypatch.setattr(pipeline, "_run", run)
    output = tmp_path / "demo"
    monkeypatch.setattr(sys, "argv", ["cronos-demo", "--scale=smoke", f"--output_dir={output}"])
    (script,) = entry_points(group="console_scripts", name="cronos-demo")
    script.load()()
    said = capsys.readouterr().out
    assert "$ cronos-train" in said
    assert "independent_held_out" in said.split("$ cronos-report")[1]
    assert LeRobotDataset("local/cronos_demos", root=output / "demos").num_episodes == 8
    stream = LeRobotDataset("local/cronos_demo_streams", root=output / "finetune/streams")
    assert stream.num_frames == 160
    with (output / "report/gains.csv").open() as file:
        gains = {row["suite"]: row for row in csv.DictReader(file) if row["task"] == "all tasks"}
    evaluated = json.loads((output / "eval/after_held_out/eval_info.json").read_text())
    successes = sum(sum(task["metrics"]["successes"]) for task in evaluated["per_task"])
    after = gains["independent_held_out"]
    assert (after["after_successes"], after["after_n"]) == (str(successes), "4")
    page = (output / "report/index.html").read_text()
    # The stream, and each of four tasks before and after.
    assert page.count("data:video/mp4") == 1 + 8
    assert pd.read_csv(output / "report/updates.csv")["interaction_steps"].tolist() == [320, 640]
