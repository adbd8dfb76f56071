"""What `cronos-report` makes of the folders that it is given, and of the one that it writes into."""

import pytest
from synthetic_runs import write_evaluation, write_training_run

from cronos_lerobot.report.page import write_report
from cronos_lerobot.scripts.report import make_report


def test_nothing_of_another_report_stays_in_its_folder(tmp_path):
    write_training_run(tmp_path / "run")
    out = tmp_path / "out"
    write_report(make_report([tmp_path / "run"]), out)
    assert {"seeds.csv", "updates.csv"} <= (first := {path.name for path in out.iterdir()})
    write_evaluation(tmp_path / "eval")
    write_report(make_report([tmp_path / "eval"]), out)
    assert {path.name for path in out.iterdir()} == {"index.html", "lerobot_eval.csv"}
    assert [name for name in first if name.endswith(".png")]


def test_folders_of_one_suite_are_trainings(tmp_path):
    write_evaluation(tmp_path / "before", successes=(4,) * 4)
    for seed, successes in enumerate((8, 4, 1)):
        write_evaluation(tmp_path / f"after/{seed}", successes=(successes,) * 4)
    report = make_report([], before=[tmp_path / "before"], after=[tmp_path / "after"])
    (comparison,) = report.comparisons
    after = comparison.overall.after
    # Three rates, 1, .5 and .125, not 96 episodes: .5417 +- 4.3027 x .4391 / sqrt(3), to the ends.
    assert (after.n, after.interval) == (96, (0.0, 1.0))


def test_what_is_paired_by_task_is_of_lerobot_eval(tmp_path):
    write_training_run(tmp_path / "run")
    write_evaluation(tmp_path / "eval")
    with pytest.raises(ValueError, match=r"--after=.*run: nothing of lerobot-eval there.* cronos-report compare"):
        make_report([], before=[tmp_path / "eval"], after=[tmp_path / "run"])
