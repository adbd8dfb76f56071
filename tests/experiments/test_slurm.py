"""Pipelines on a real Slurm of one node, where Debian's slurm-wlm and munge can be had."""

import shutil
import tempfile
import time
from pathlib import Path

import pytest
from slurm_cluster import SlurmCluster, missing

from cronos_lerobot.experiments.pipeline import Command, Pipeline, await_all
from cronos_lerobot.experiments.slurm import submit

pytestmark = pytest.mark.skipif(bool(missing()), reason=f"Slurm is not installed: {', '.join(missing())}")

COUNT = """
import pathlib, sys, time
out = pathlib.Path(sys.argv[1].split('=')[1])
out.mkdir(exist_ok=True)
tape = out / 'tape'
begin = len(tape.read_text().split()) if tape.exists() else 0
(out / f'start{begin}').touch()
for n in range(begin + 1, 401):
    # Slow enough to be stopped, then quick to end.
    time.sleep(0.005 if begin else 0.15)
    new = tape.with_suffix('.new')
    new.write_text((tape.read_text() if n > 1 else '') + f'{n} ')
    new.replace(tape)
"""


@pytest.fixture(scope="module")
def cluster():
    # Sockets want a short path.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    with SlurmCluster(folder) as made:
        yield made
    shutil.rmtree(folder, ignore_errors=True)


def counting(folder):
    return Command(("python", "-c", COUNT, f"--output={folder}"), folder, resumes=True)


def test_a_run_that_is_warned_of_its_time_limit_continues_and_ends_as_an_unbroken_one(cluster, tmp_path):
    command = counting(tmp_path / "count")
    wrong = Command(("python", "-c", "import sys; sys.exit('wrong')"), tmp_path / "wrong")
    pipelines = [Pipeline("count", (command,)), Pipeline("wrong", (wrong,))]
    deadline = time.monotonic() + 240
    warned = []

    def warn():
        """As Slurm itself does, which looks at limits of whole minutes every half minute."""
        if (command.output / "tape").exists() and not warned:
            warned.extend(cluster.ask("squeue", "--noheader", "--states=RUNNING", "--format=%i").split())
            for number in warned:
                cluster.ask("scancel", "--signal=USR2", number)

    def progress():
        assert time.monotonic() < deadline, cluster.logs()

    with cluster.sparing_the_wait(warn):
        failed = await_all(pipelines, submit(pipelines, tmp_path / "slurm", {"time": 10}, 1, 5), progress)
    assert [line.split(":")[0] for line in failed] == ["wrong"], cluster.logs()
    assert command.is_done
    assert len(list(command.output.glob("start*"))) == 2
    assert (command.output / "tape").read_text().split() == [str(n) for n in range(1, 401)]


def test_what_is_in_the_queue_is_not_submitted_again(cluster, tmp_path):
    pipelines = [Pipeline("count", (counting(tmp_path / "count"),))]
    jobs = submit(pipelines, tmp_path / "slurm", {"time": 10}, 1, 5)
    try:
        with pytest.raises(ValueError, match="in the queue"):
            submit(pipelines, tmp_path / "slurm", {"time": 10}, 1, 5)
    finally:
        jobs[0].cancel()
