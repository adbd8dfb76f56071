"""Jobs on a real Slurm of one node, where Debian's slurm-wlm and munge can be had."""

import json
import shutil
import signal
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
from slurm_cluster import SlurmCluster, missing

from cronos_lerobot.experiments.arrays import behind_runs, plan_arrays
from cronos_lerobot.experiments.follow import Follower
from cronos_lerobot.experiments.jobs import BASE, EVALUATION, RUN, Job, read_record, write_record
from cronos_lerobot.experiments.runner import ENDING_SIGNALS
from cronos_lerobot.experiments.slurm import Cluster, SlurmOptions, Task
from cronos_lerobot.experiments.submitted import SlurmError, read_submitted

needs_slurm = pytest.mark.skipif(
    bool(missing()), reason=f"no Slurm here ({', '.join(missing())}): Debian has it in slurm-wlm and munge"
)


class Tape:
    """A display that remembers."""

    def __init__(self):
        self.events = []

    def event(self, job, what):
        self.events.append((job.name, what))

    def update(self, states, running):
        pass


def job(folder, name, code="", **options):
    """`code` runs with `out`, the job's folder, which it finds made."""
    out = f"out = pathlib.Path({str(folder / name)!r})"
    lines = ("import pathlib, time, sys", out, "out.mkdir(parents=True, exist_ok=True)", code)
    return Job(name, ("python", "-c", "\n".join(lines)), folder / name, **options)


@pytest.fixture(scope="module")
def cluster():
    # Sockets want a short path.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    with SlurmCluster(folder) as made:
        yield made
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.follow.POLL_S", 0.2)
    # A job that is being requeued is not in the queue for a moment; 4 s, where a user's run gives it 90.
    for module in ("follow", "slurm"):
        monkeypatch.setattr(f"cronos_lerobot.experiments.{module}.LATE_S", 4.0)
    monkeypatch.setattr("cronos_lerobot.experiments.runner.POLL_S", 0.05)


def follow(jobs, folder, **options):
    cluster, tape = Cluster(folder / "slurm", SlurmOptions(**options)), Tape()
    submitted = cluster.submit(jobs, threads=1, parallel=None)
    return Follower(jobs, submitted, cluster, tape).run(), submitted, tape


@pytest.mark.parametrize(
    ("text", "minutes"), [("90", 90), ("1:00:00", 60), ("0:00:30", 1), ("2-03:10:00", 2 * 1440 + 190)]
)
def test_a_time_limit_is_read_as_slurm_does(text, minutes):
    assert SlurmOptions(time=text, warning_s=1).minutes == minutes


@pytest.mark.parametrize("text", ["", "1h", "1:2", "-3", "0"])
def test_no_time_limit(text):
    with pytest.raises(ValueError, match=r"slurm\.time"):
        SlurmOptions(time=text)


def test_arrays_have_bases_then_runs_then_their_evaluations(tmp_path):
    names = ("base/a/demos", "base/a/clone", "base/b/demos")
    bases = [job(tmp_path, name, stage=BASE) for name in names]
    base_eval = job(tmp_path, "base/a/eval", stage=EVALUATION, needs=("base/a/clone",))
    r1, r2, r3 = (job(tmp_path, f"r{n}", stage=RUN, needs=("base/a/clone",)) for n in (1, 2, 3))
    of = {"e2": "r2", "f2": "r2", "e3": "r3"}
    e2, f2, e3 = (job(tmp_path, name, stage=EVALUATION, needs=(run,)) for name, run in of.items())
    jobs = [*bases, base_eval, r1, r2, e2, f2, r3, e3]
    made = plan_arrays(jobs, jobs)
    assert [[[job.name for job in element] for element in array] for array in made] == [
        [["base/a/demos", "base/a/clone"], ["base/b/demos"]],
        [["r2"], ["r3"], ["r1"], ["base/a/eval"]],
        [["e2", "f2"], ["e3"]],
    ]
    # r3 is done: its evaluation waits for nothing of these.
    made = plan_arrays(jobs, [r1, r2, e2, f2, e3])
    assert [[[job.name for job in element] for element in array] for array in made] == [
        [], [["r2"], ["r1"], ["e3"]], [["e2", "f2"]],
    ]  # fmt: skip


def test_what_waits_for_a_queued_run_keeps_no_other_waiting(tmp_path):
    clone = job(tmp_path, "clone", stage=BASE)
    r1, r2 = (job(tmp_path, f"r{n}", stage=RUN, needs=("clone",)) for n in (1, 2))
    e1 = job(tmp_path, "e1", stage=EVALUATION, needs=("r1",))
    made = {one.name: one for one in (clone, r1, r2, e1)}
    assert behind_runs([[r2], [e1]], {"clone", "r1"}, made) == ([[e1]], [[r2]])
    assert behind_runs([[r2], [e1]], {"clone"}, made) == ([], [[r2], [e1]])


def test_a_time_limit_that_leaves_nothing_to_go_on_with_ends_the_job(tmp_path, capsys):
    anew = job(tmp_path, "anew")
    resumable = Job(anew.name, anew.command, anew.output, resume=lambda: list(anew.command))
    assert Task([anew], [], 1, limit_s=0, grace_s=1).checkpoint() is None
    assert "anew came to its time limit before its first checkpoint" in capsys.readouterr().out
    # It was preempted before, or goes on from where it was.
    for again in (Task([anew], [], 1, 3600, 1), Task([resumable], [], 1, 0, 1)):
        assert [j.name for j in again.checkpoint().function.jobs] == ["anew"]


def test_time_limits_are_counted_whatever_the_warning(tmp_path, capsys):
    """Submitit takes a warning of a quarter of an hour before an hour is over for a preemption."""
    again = job(tmp_path, "a")
    task = Task([replace(again, resume=lambda: list(again.command))], [], 1, limit_s=0, grace_s=1, requeues=1)
    following = task.checkpoint().function
    assert following.requeues == 0
    assert following.checkpoint() is None
    assert "more often than --slurm.requeues allows" in capsys.readouterr().out
    # A preemption is none.
    preempted = Task(task.jobs, [], 1, limit_s=3600, grace_s=1, requeues=0)
    assert preempted.checkpoint().function.requeues == 0


@pytest.fixture
def signals_as_before():
    """A runner that is stopped ignores what would end its process, which is about to end; this one goes on."""
    before = {number: signal.getsignal(number) for number in ENDING_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("signals_as_before")
@pytest.mark.parametrize(("demos_done_before", "is_requeued"), [(False, True), (True, False)])
def test_a_time_limit_that_finished_the_demonstrations_leaves_the_cloning(
    tmp_path, demos_done_before, is_requeued
):
    """A next start that only has to clone may come to its end; another one that does only that would not."""
    demos = job(tmp_path, "base/a/demos", stage=BASE)
    clone = job(tmp_path, "base/a/clone", "sys.exit('stopped')", needs=(demos.name,), stage=BASE)
    if demos_done_before:
        Task([demos], [], 1, 60, 1)()
    task = Task([demos, clone], [], 1, limit_s=0, grace_s=1)
    with pytest.raises(RuntimeError, match="not done"):
        task()
    assert (task.checkpoint() is not None) == is_requeued


def test_an_old_interruption_of_what_is_blocked_is_not_taken_for_a_signal(tmp_path):
    """It would wait for Slurm to end it, for all of its time limit."""
    bad = job(tmp_path, "bad", "sys.exit('wrong')")
    blocked = job(tmp_path, "blocked", needs=("bad",))
    write_record(
        blocked, {"command": [], "status": "stopped", "seconds": 1.0, "starts": 1, "returncode": -signal.SIGTERM}
    )
    with pytest.raises(RuntimeError, match="'bad': 'failed', 'blocked': 'blocked'"):
        Task([bad, blocked], [], 1, limit_s=60, grace_s=1)()


def test_a_note_of_another_node_that_comes_late_is_waited_for(tmp_path, monkeypatch):
    clone, run = job(tmp_path, "clone"), job(tmp_path, "run", "(out / 'x').touch()", needs=("clone",))
    task = Task([run], [clone], 1, limit_s=60, grace_s=1)
    looked = []

    def sleep(seconds):
        looked.append(seconds)
        if len(looked) == 3:
            monkeypatch.undo()
            Task([clone], [], 1, limit_s=60, grace_s=1)()

    monkeypatch.setattr("cronos_lerobot.experiments.slurm.time.sleep", sleep)
    assert task() == {"run": "done"}
    assert len(looked) == 3


def test_a_path_that_slurm_would_read_as_its_own_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda program: program)
    with pytest.raises(SlurmError, match=r"a % in a path as its own: choose another --root than .*/a%j$"):
        Cluster(tmp_path / "a%j/slurm", SlurmOptions())


@needs_slurm
def test_arrays_wait_for_each_other_and_a_failure_blocks_only_its_own(cluster, tmp_path):
    base = job(tmp_path, "base/a/demos", "time.sleep(1); (out / 'x').write_text('2')", stage=BASE)
    read = f"x = int(pathlib.Path({str(tmp_path)!r}, 'base/a/demos/x').read_text())\n"
    good = job(tmp_path, "good", read + "(out / 'x').write_text(str(3 * x))", needs=(base.name,))
    bad = job(tmp_path, "bad", read + "sys.exit('wrong')", needs=(base.name,))
    after = [
        job(tmp_path, f"after_{run.name}", "(out / 'x').write_text('seen')", needs=(run.name,), stage=EVALUATION)
        for run in (good, bad)
    ]
    jobs = [base, good, bad, *after]
    states, submitted, tape = follow(jobs, tmp_path)
    assert [states[made.name] for made in jobs] == ["done", "done", "failed", "done", "failed"]
    assert (tmp_path / "good/x").read_text() == "6"
    assert (tmp_path / "after_good/x").read_text() == "seen"
    assert not (tmp_path / "after_bad").exists()
    arrays = [int(submitted[made.name].split("_")[0]) for made in jobs]
    assert [array - arrays[0] for array in arrays] == [0, 1, 1, 2, 2]
    assert ("good", "done") in tape.events
    # Once more: what is done is not submitted again, also by one who has never submitted anything.
    for remembered in (tmp_path, tmp_path / "elsewhere"):
        states, again, _ = follow([base, good], remembered)
        assert (states, again) == ({base.name: "done", "good": "done"}, {})


COUNT = """
tape = out / 'tape'
done = len(tape.read_text().split()) if tape.exists() else 0
for n in range(done + 1, int(sys.argv[1]) + 1):
    # Slow enough to be stopped, and then quick to end.
    time.sleep(0.005 if done else 0.15)
    # In one step: a kill leaves the old or the new.
    new = tape.with_suffix('.new')
    new.write_text((tape.read_text() if n > 1 else '') + f'{n} ')
    new.replace(tape)
"""


def counting_job(folder, number):
    """Counts to `number`, 7 a second, and goes on, faster, from where it was stopped."""
    counting = job(folder, "count", COUNT)
    command = (*counting.command, str(number))
    return Job(counting.name, command, counting.output, resume=lambda: list(command))


@needs_slurm
def test_a_job_that_its_time_limit_stops_goes_on_and_ends_as_an_unbroken_one(cluster, tmp_path):
    counting = counting_job(tmp_path, 400)
    with cluster.sparing_the_wait():
        # Slurm looks at limits every half minute and warns as much earlier: 10 to 40 s after the start, when the
        # element's Python is there to be warned.
        states, _, tape = follow([counting], tmp_path, time="1", warning_s=20)
    said = [path.read_text() for path in sorted((tmp_path / "slurm/logs").rglob("*.out"))]
    assert states == {"count": "done"}, "\n".join([*said, cluster.logs()])
    record = read_record(counting)
    assert record["starts"] >= 2, json.dumps(record)
    assert (tmp_path / "count/tape").read_text().split() == [str(n) for n in range(1, 401)]
    assert [what for _, what in tape.events if "start 2" in what]


@needs_slurm
def test_a_preempted_job_waits_to_be_requeued_and_goes_on(cluster, tmp_path):
    """As Slurm does it: first SIGTERM, and at the end of the grace time it requeues what has not ended itself."""
    counting, sent = counting_job(tmp_path, 100), []

    def preempt():
        tape = tmp_path / "count/tape"
        number = read_submitted(tmp_path / "slurm").get("count")
        if number and not sent and tape.exists() and len(tape.read_text().split()) > 5:
            sent.append(number)
            cluster.ask("scancel", "--signal=TERM", number)
        elif sent == [number] and read_record(counting)["status"] != "running":
            sent.append("requeued")
            cluster.ask("scontrol", "requeue", number)

    with cluster.sparing_the_wait(preempt):
        states, _, _ = follow([counting], tmp_path, time="10")
    assert (states, sent[1:]) == ({"count": "done"}, ["requeued"])
    assert read_record(counting)["starts"] == 2
    assert (tmp_path / "count/tape").read_text().split() == [str(n) for n in range(1, 101)]
