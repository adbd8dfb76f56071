"""What runs have gained between two evaluations, on few episodes that are worked out by hand."""

import sys

import pytest
from synthetic_evaluations import write_compared_run

from cronos_lerobot.studies import moments


def run_study(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["moments", *map(str, arguments)])
    moments.main()


def test_the_same_trainings_before_and_after(tmp_path, monkeypatch, capsys):
    for seed, tasks in ((1, ["1100"]), (2, ["1111"])):
        write_compared_run(tmp_path / f"row/seed{seed}/train", seed, tasks)
    run_study(monkeypatch, tmp_path / "row", "--steps", 0, 10240)
    # Gains .5 and 1: between them .125 / 2, with 1 degree of freedom; between the configurations, 1, 1, .5, .5, it
    # is 1/12 / 4, less the interaction of the same size. 12.706 x .25; t = 3 of 1 degree of freedom.
    line = "row: 0.000 0.000 -> 0.500 1.000: +0.750 [-2.427, +3.927], p = 0.2, of trainings like these\n"
    assert capsys.readouterr().out == line


def test_one_run_is_one_policy_and_other_moments_are_refused(tmp_path, monkeypatch, capsys):
    write_compared_run(tmp_path / "row/seed1/train", 1, ["11111111"])
    run_study(monkeypatch, tmp_path / "row/seed1", "--steps", 0, 10240)
    # All eight configurations one way: 2 / 2^8. Wilson's of 0 and of 8 of 8 are .3244 wide: 1 - sqrt(2) x .3244.
    line = "row/seed1: 0.000 -> 1.000: +1.000 [+0.541, +1.000], p = 0.0078, of this policy\n"
    assert capsys.readouterr().out == line
    with pytest.raises(SystemExit, match=r"error: .*after 5,120 steps, but after \[0, 10240\]"):
        run_study(monkeypatch, tmp_path / "row", "--steps", 0, 5120)


def test_where_nothing_changes_there_is_no_p(tmp_path, monkeypatch, capsys):
    for seed in (1, 2):
        write_compared_run(tmp_path / f"row/seed{seed}/train", seed, ["0000"])
    run_study(monkeypatch, tmp_path / "row", "--steps", 0, 10240)
    assert capsys.readouterr().out == "row: 0.000 0.000 -> 0.000 0.000: +0.000, of trainings like these\n"
