"""Commands that can be run again, and the pipelines that share them."""

import threading
import time

import pytest

from cronos_lerobot.experiments.pipeline import Command, CommandFailedError, Pipeline, Runner, run_here


def command(folder, code, *flags, resumes=False):
    """A command that makes `folder` and runs `code` there, with `out`, the folder."""
    lines = (
        f"import pathlib, sys, time\nout = pathlib.Path({str(folder)!r})\nout.mkdir(exist_ok={resumes})\n{code}"
    )
    return Command(("python", "-c", lines, *flags), folder, resumes=resumes)


COUNT = "n = len(list(out.glob('start*')))\n(out / f'start{n}').touch()\n"


def test_what_is_done_is_not_run_again(tmp_path):
    one = command(tmp_path / "a", COUNT, resumes=True)
    Runner(1).run([one])
    Runner(1).run([one])
    assert [path.name for path in (tmp_path / "a").glob("start*")] == ["start0"]


def test_a_folder_of_other_flags_is_an_error_that_names_them(tmp_path):
    Runner(1).run([command(tmp_path / "a", COUNT, "--steps=1")])
    with pytest.raises(ValueError, match="--steps=1 --steps=2"):
        Runner(1).run([command(tmp_path / "a", COUNT, "--steps=2")])


@pytest.mark.parametrize("resumes", [True, False])
def test_a_failed_command_is_continued_or_begun_anew(tmp_path, resumes):
    code = f"{COUNT}sys.exit(0 if (out.parent / 'good').exists() else 3)"
    one, after = command(tmp_path / "a", code, resumes=resumes), command(tmp_path / "b", COUNT)
    with pytest.raises(CommandFailedError, match="status 3"):
        Runner(1).run([one, after])
    assert not after.output.exists()
    (tmp_path / "good").touch()
    Runner(1).run([one, after])
    assert len(list(one.output.glob("start*"))) == (2 if resumes else 1)
    assert after.is_done


def test_a_folder_of_something_else_is_never_deleted(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/mine").touch()
    with pytest.raises(CommandFailedError, match="not of this command"):
        Runner(1).run([command(tmp_path / "a", COUNT)])
    assert (tmp_path / "a/mine").exists()


def test_a_folder_that_two_pipelines_need_is_made_once(tmp_path):
    base = command(tmp_path / "base", f"{COUNT}time.sleep(.3)", resumes=True)
    pipelines = [Pipeline(name, (base, command(tmp_path / name, COUNT))) for name in ("a", "b")]
    assert run_here(pipelines, 2, 1) == []
    assert len(list((tmp_path / "base").glob("start*"))) == 1
    assert all(pipeline.is_done for pipeline in pipelines)


def test_a_failed_pipeline_leaves_the_others_alone(tmp_path):
    bad, good = command(tmp_path / "bad", "sys.exit('wrong')"), command(tmp_path / "good", COUNT)
    failed = run_here([Pipeline("bad", (bad,)), Pipeline("good", (good,))], 1, 1)
    assert len(failed) == 1
    assert failed[0].startswith("bad: python")
    assert "wrong" in bad.log.read_text()
    assert good.is_done


def test_stop_lets_the_running_command_save_and_starts_no_other(tmp_path):
    save = "import signal\ndef stop(*_):\n    (out / 'saved').touch()\n    sys.exit(1)\n"
    slow = command(
        tmp_path / "a", f"{save}signal.signal(signal.SIGTERM, stop)\n(out / 'up').touch()\ntime.sleep(60)"
    )
    runner, errors = Runner(1), []

    def run():
        try:
            runner.run([slow, command(tmp_path / "b", COUNT)])
        except CommandFailedError as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    while not (slow.output / "up").exists():
        time.sleep(0.01)
    runner.stop()
    thread.join(10)
    assert (slow.output / "saved").exists()
    assert errors
    assert not (tmp_path / "b").exists()
