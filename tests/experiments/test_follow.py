"""What becomes of jobs in a cluster's queue, told by a made-up queue and the jobs' notes."""

import json
import signal
import sys
from dataclasses import replace

import pytest
from tiny_jobs import Tape

from cronos_lerobot.experiments import follow, status
from cronos_lerobot.experiments.follow import Follower
from cronos_lerobot.experiments.jobs import BASE, EVALUATION, Job, made_by, write_record
from cronos_lerobot.experiments.slurm import Cluster, SlurmOptions, slurm_folder
from cronos_lerobot.experiments.submitted import SlurmError, read_submitted
from cronos_lerobot.scripts import reproduce
from cronos_lerobot.scripts.launchers import run_on_slurm


class MadeUpCluster:
    def log(self, number):
        return f"{number}.out"


def note(job, state, **more):
    record = {"command": list(job.command), "status": state, "seconds": 60.0, "starts": 1, "made_by": {}}
    write_record(job, record | more)


@pytest.fixture
def job(tmp_path, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.jobs.changed_versions", lambda job: [])
    made = Job("a", ("python",), tmp_path / "a")
    made.output.mkdir()
    return made


@pytest.fixture
def clock(monkeypatch):
    """Set by the test [s]."""
    now = [0.0]
    monkeypatch.setattr(follow.time, "monotonic", lambda: now[0])
    return now


def make_follower(job, monkeypatch, queue):
    monkeypatch.setattr(follow, "squeue", lambda: queue)
    return Follower([job], {"a": "7_0"}, MadeUpCluster(), Tape())


def test_a_note_that_comes_late_over_nfs_is_waited_for(job, monkeypatch, clock):
    queue = {"7_0": ("RUNNING", "None")}
    follower = make_follower(job, monkeypatch, queue)
    note(job, "running")
    assert follower.look() == [job]
    queue.clear()
    for clock[0] in (100.0, 105.0, 160.0):
        assert (follower.look(), follower.states) == ([], {})
    note(job, "done")
    follower.look()
    assert follower.states == {"a": "done"}


def test_what_has_left_the_queue_and_is_not_done_has_failed_in_the_end(job, monkeypatch, clock):
    queue = {}
    follower = make_follower(job, monkeypatch, queue)
    note(job, "running")
    for clock[0] in (0.0, 89.0):
        follower.look()
    # Requeued: not in the queue for a moment.
    queue["7_0"] = ("PENDING", "BeginTime")
    clock[0] = 91.0
    assert follower.look() == []
    queue.clear()
    for clock[0] in (92.0, 181.0):
        follower.look()
    assert follower.states == {}
    clock[0] = 182.0
    follower.look()
    assert follower.states == {"a": "failed"}
    assert ("a", "left the queue and is not done, see 7_0.out") in follower.display.events


LONG = "t4400_eer_lsr_staggered_early_decay_critic_memory_takeover_wide_resets_1300k"


def make_root(root, monkeypatch, states, queue):
    """Seeds 1, 2, ... with a note each, an array's elements of the same numbers, and one that has not begun."""
    name = f"kitchen_2x2_state_paper/{LONG}/seed"
    for seed, state in enumerate(states, 1):
        folder = root / f"runs/{name}{seed}/train"
        folder.mkdir(parents=True)
        evaluation = {"kind": "evaluation", "interaction_steps": 10_240, "success": 0.5}
        (folder / "metrics.jsonl").write_text(json.dumps(evaluation) + "\n")
        note(Job("", ("cronos-train", "--steps=10240"), folder), state)
    slurm = slurm_folder(root)
    slurm.mkdir()
    submitted = {f"{name}{seed}": f"7_{seed}" for seed in range(1, len(states) + 2)}
    (slurm / "submitted.json").write_text(json.dumps(submitted))
    monkeypatch.setattr(status, "squeue", lambda: queue)
    return name


def print_status(root, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["cronos-reproduce", "status", f"--root={root}"])
    reproduce.main()
    return capsys.readouterr().out.splitlines()


def test_states_are_those_of_the_queue_and_names_are_whole(tmp_path, monkeypatch, capsys):
    waits, runs = ("PENDING", "BeginTime"), ("RUNNING", "None")
    notes = ("done", "running", "running", "stopped", "failed", "failed", "running", "running")
    queue = {f"7_{n}": state for n, state in enumerate((waits, waits, runs, waits, waits, runs), 1)}
    queue |= {"7_8": ("COMPLETING", "None"), "7_9": ("PENDING", "Dependency")}
    name = make_root(tmp_path, monkeypatch, notes, queue)
    lines = print_status(tmp_path, monkeypatch, capsys)
    rows = [line.split() for line in lines[1:]]
    assert [row[0] for row in rows] == [f"{name}{seed}" for seed in range(1, 10)]
    # The seventh has left the queue, and nobody has its lock.
    words = ["done", "requeued", "running", "requeued", "pending", "failed", "stopped", "completing", "pending"]
    assert [row[1] for row in rows] == words
    assert [seed for seed, line in enumerate(lines[1:], 1) if "BeginTime" in line] == [2, 4, 5]
    assert "Dependency" in lines[9]
    assert rows[2][2:7] == ["10,240", "/", "10,240", "evaluation", "0.50"]
    assert "…" not in "".join(lines)


def test_without_an_answer_of_the_queue_the_notes_tell(tmp_path, monkeypatch, capsys):
    make_root(tmp_path, monkeypatch, ("done", "running"), {})

    def silent():
        raise SlurmError("squeue: no answer")

    monkeypatch.setattr(status, "squeue", silent)
    assert [line.split()[1] for line in print_status(tmp_path, monkeypatch, capsys)[1:]] == ["done", "stopped"]


def test_what_was_done_and_is_made_again_is_done_when_it_has_left_the_queue(job, monkeypatch, clock):
    note(job, "done")
    queue = {"7_0": ("PENDING", "Dependency")}
    follower = make_follower(job, monkeypatch, queue)
    assert (follower.look(), follower.states) == ([], {})
    # What it was made of is begun anew, and it is gone until it is made again.
    job.output.rmdir()
    assert (follower.look(), follower.states) == ([], {})
    queue["7_0"] = ("RUNNING", "None")
    job.output.mkdir()
    follower.look()
    assert follower.states == {"a": "done"}


def cluster_of(folder, monkeypatch, queue):
    """A cluster with this queue, and the jobs of each element of each array that it takes."""
    cluster = Cluster.__new__(Cluster)
    cluster.folder, cluster.options = folder / "slurm", SlurmOptions()
    monkeypatch.setattr("cronos_lerobot.experiments.slurm.squeue", lambda: queue)
    taken = []

    def submit_array(self, name, tasks, parameters):
        taken.append([[made.name for made in task.jobs] for task in tasks])
        return [f"{len(taken)}_{i}" for i in range(len(tasks))]

    monkeypatch.setattr(Cluster, "_submit_array", submit_array)
    return cluster, taken


def run_job(root, name, *flags):
    return Job(name, ("cronos-train", *flags, f"--output_dir={root / name}"), root / name, root=root)


def test_what_is_in_the_queue_with_other_flags_is_refused(tmp_path, monkeypatch):
    """An element runs what it was submitted with: it would be shown as this command's until its end."""
    queue = {}
    cluster, taken = cluster_of(tmp_path, monkeypatch, queue)
    jobs = [run_job(tmp_path, name, "--algorithm.target_kl=0.01") for name in ("a", "b", "c")]
    submitted = cluster.submit(jobs, threads=1, parallel=None)
    assert submitted == {"a": "2_0", "b": "2_1", "c": "2_2"}
    queue |= dict.fromkeys(("2_1", "2_2"), ("PENDING", "Resources"))
    others = [run_job(tmp_path, name, "--algorithm.target_kl=0.02") for name in ("a", "b", "c")]
    with pytest.raises(SlurmError) as refused:
        cluster.submit(others, threads=1, parallel=None)
    assert str(refused.value) == (
        "b is in the queue with other flags (--algorithm.target_kl=0.01 there, --algorithm.target_kl=0.02 here), "
        "and so are 1 more: give those, or another --root, or take it out of the queue: scancel 2_1 2_2"
    )
    # The same command follows them, from wherever their root is called; only what has left the queue is new.
    moved = tmp_path / "elsewhere/.."
    jobs = [run_job(moved, name, "--algorithm.target_kl=0.01") for name in ("a", "b", "c")]
    assert cluster.submit(jobs, threads=1, parallel=None) == {"a": "5_0", "b": "2_1", "c": "2_2"}
    assert taken[-3:] == [[], [["a"]], []]


def test_what_is_in_the_queue_keeps_its_time_limit_and_that_is_said(tmp_path, monkeypatch, capsys):
    queue = {}
    cluster, taken = cluster_of(tmp_path, monkeypatch, queue)
    jobs = [run_job(tmp_path, name) for name in ("a", "b", "c")]
    cluster.submit(jobs, threads=1, parallel=8)
    queue |= dict.fromkeys(("2_1", "2_2"), ("PENDING", "Resources"))
    assert cluster.submit(jobs, threads=1, parallel=8)["a"] == "5_0"
    assert capsys.readouterr().out == ""
    queue["5_0"] = ("RUNNING", "None")
    cluster.options = SlurmOptions(time="2-00:00:00", mem="64G")
    assert cluster.submit(jobs, threads=1, parallel=None) == {"a": "5_0", "b": "2_1", "c": "2_2"}
    assert capsys.readouterr().out == (
        "in the queue with --slurm.time=24:00:00, --jobs=8, no --slurm.mem, which they keep: 2_1 2_2 5_0\n"
        "(scancel takes them out, and the same command submits them again)\n"
    ).replace("2_1 2_2 5_0", "5_0 2_1 2_2")
    assert taken[-3:] == [[], [], []]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_the_cluster_has_taken_is_remembered_if_somebody_interrupts(number, tmp_path, monkeypatch):
    """As sbatch has answered, and before the second array."""
    cluster, taken = cluster_of(tmp_path, monkeypatch, {})
    monkeypatch.setattr("cronos_lerobot.scripts.launchers.Cluster", lambda folder, options: cluster)
    submit_array = Cluster._submit_array

    def interrupted(self, name, tasks, parameters):
        made = submit_array(self, name, tasks, parameters)
        if tasks:
            signal.raise_signal(number)
            # A program that is started now, as sbatch, does not hear what a terminal sends to all.
            assert number in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        return made

    def interrupt(number, frame):
        raise KeyboardInterrupt

    monkeypatch.setattr(Cluster, "_submit_array", interrupted)
    run = run_job(tmp_path, "a")
    evaluation = replace(run_job(tmp_path, "a/eval"), needs=("a",), stage=EVALUATION)
    before = signal.signal(number, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt, match=f"--root={tmp_path}` shows them, `scancel 2` cancels them"):
            run_on_slurm([run, evaluation], SlurmOptions(), tmp_path, threads=1, parallel=None)
        assert signal.getsignal(number) is interrupt
    finally:
        signal.signal(number, before)
    assert taken == [[], [["a"]]]
    assert read_submitted(cluster.folder) == {"a": "2_0"}
    assert number not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_what_needs_a_base_of_other_flags_is_not_submitted_and_is_blocked_at_once(tmp_path, monkeypatch, capsys):
    clone = replace(run_job(tmp_path, "clone", "--steps=1"), stage=BASE)
    clone.output.mkdir()
    note(clone, "done", command=["cronos-train", "--steps=2", f"--output_dir={clone.output}"])
    run = replace(run_job(tmp_path, "run"), needs=("clone",))
    evaluation = replace(run_job(tmp_path, "run/eval"), needs=("run",), stage=EVALUATION)
    # Of another machine, and its checkpoint stayed there.
    came, done = run_job(tmp_path, "came"), replace(run_job(tmp_path, "done"), needs=("clone",))
    for made in (came, done):
        made.output.mkdir()
        note(made, "done", made_by=made_by(made))
    reads = replace(run_job(tmp_path, "came/eval"), needs=("came",), reads=(came.output / "checkpoints",))
    cluster, taken = cluster_of(tmp_path, monkeypatch, {})
    jobs = [clone, run, evaluation, came, done, reads, run_job(tmp_path, "own")]
    submitted = cluster.submit(jobs, threads=1, parallel=None)
    assert (submitted, taken) == ({"own": "2_0"}, [[], [["own"]], []])
    monkeypatch.setattr(follow, "squeue", lambda: {"2_0": ("RUNNING", "None")})
    follower = Follower(jobs[:-1], submitted, MadeUpCluster(), Tape())
    assert follower.run() == {
        "clone": "changed", "run": "blocked", "run/eval": "blocked", "came": "done", "done": "done",
        "came/eval": "blocked",
    }  # fmt: skip
    assert ("came/eval", "missing") in follower.display.events


def test_a_run_of_a_clone_in_the_queue_is_not_held_up(tmp_path, monkeypatch):
    cluster, _ = cluster_of(tmp_path, monkeypatch, {})
    clone = replace(run_job(tmp_path, "clone"), stage=BASE)
    run = replace(run_job(tmp_path, "run"), needs=("clone",), reads=(clone.output / "checkpoints",))
    cluster.submit([clone], threads=1, parallel=None)
    monkeypatch.setattr("cronos_lerobot.experiments.slurm.squeue", lambda: {"1_0": ("RUNNING", "None")})
    assert cluster.submit([clone, run], threads=1, parallel=None) == {"clone": "1_0", "run": "5_0"}


def test_a_damaged_note_of_the_queue_is_named(tmp_path, monkeypatch, capsys):
    cluster, _ = cluster_of(tmp_path, monkeypatch, {})
    cluster.folder.mkdir()
    for text in ("", "[]", '{"a": {"other": 1}}'):
        (cluster.folder / "submitted.json").write_text(text)
        with pytest.raises(SlurmError, match=r"submitted\.json is damaged"):
            cluster.submit([run_job(tmp_path, "a")], threads=1, parallel=None)
        with pytest.raises(SystemExit, match=r"error: .*submitted\.json is damaged"):
            print_status(tmp_path, monkeypatch, capsys)


def test_what_waits_for_a_queued_run_is_an_array_of_its_own(tmp_path, monkeypatch):
    queue = {}
    cluster, taken = cluster_of(tmp_path, monkeypatch, queue)
    old, new = (run_job(tmp_path, name) for name in ("old", "new"))
    cluster.submit([old], threads=1, parallel=None)
    queue["2_0"] = ("RUNNING", "None")
    of_old = replace(run_job(tmp_path, "old/eval"), needs=("old",), stage=EVALUATION)
    submitted = cluster.submit([old, of_old, new], threads=1, parallel=None)
    assert submitted == {"old": "2_0", "new": "5_0", "old/eval": "7_0"}
    assert taken[-4:] == [[], [["new"]], [], [["old/eval"]]]


def test_a_queue_from_before_commands_were_noted_is_followed(tmp_path, monkeypatch):
    cluster, _ = cluster_of(tmp_path, monkeypatch, {"7_0": ("RUNNING", "None")})
    cluster.folder.mkdir()
    (cluster.folder / "submitted.json").write_text(json.dumps({"a": "7_0", "b": "6_0"}))
    jobs = [run_job(tmp_path, name, "--seed=1") for name in ("a", "b")]
    assert cluster.submit(jobs, threads=1, parallel=None) == {"a": "7_0", "b": "2_0"}
    assert read_submitted(cluster.folder) == {"a": "7_0", "b": "2_0"}


def test_what_was_made_of_a_run_that_is_begun_anew_is_submitted_with_it(tmp_path, job, monkeypatch):
    """Its evaluations are removed with it, and those of others stay as they are."""
    run = Job("run", ("python",), tmp_path / "run/train", made_from_it=(tmp_path / "run/eval",))
    evaluation, other = (
        Job(name, ("python",), tmp_path / name / "eval/last", needs=(name,), stage=EVALUATION)
        for name in ("run", "other")
    )
    evaluation = replace(evaluation, name="run/eval")
    for made in (evaluation, other):
        made.output.mkdir(parents=True)
        note(made, "done")
    cluster, taken = cluster_of(tmp_path, monkeypatch, {})
    jobs = [run, evaluation, replace(other, needs=())]
    assert cluster.submit(jobs, threads=1, parallel=None) == {"run": "2_0", "run/eval": "3_0"}
    assert taken == [[], [["run"]], [["run/eval"]]]
