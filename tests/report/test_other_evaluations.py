"""Evaluations of a run that are no part of its curve, runs that are no seeds of the others: left out, and said."""

import json
import sys

import pytest
from synthetic_runs import read_csv, write_training_run

from cronos_lerobot.report.comparisons import compare_training
from cronos_lerobot.report.runs import find_runs, group_runs
from cronos_lerobot.report.series import evaluation_curve
from cronos_lerobot.report.tables import seed_rows
from cronos_lerobot.scripts.report import main, make_report


def evaluated_otherwise(run, changes):
    """Give evaluations, by their places, other settings: as if the run had been resumed with other --eval.*."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    evaluations = [line for line in lines if line["kind"] == "evaluation"]
    for place, settings in changes.items():
        evaluations[place] |= settings
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_evaluations_made_otherwise_than_the_last_are_left_out_and_said(tmp_path, monkeypatch, capsys):
    run = write_training_run(tmp_path / "run", successes=(2, 2, 6))
    evaluated_otherwise(run, {1: {"temperature": 0.0}})
    monkeypatch.setattr(sys, "argv", ["cronos-report", str(run), f"--output={tmp_path / 'out'}"])
    main()
    said = (
        f"left out: 1 of 3 evaluations of {run}: they are of train, n=32, temperature 0.0, the last one is of"
        " train, n=32, temperature 0.6\n"
    )
    captured = capsys.readouterr()
    assert captured.err == said
    assert said.removeprefix("left out: ").strip() in (tmp_path / "out/index.html").read_text()
    assert "+0.500 [" in captured.out
    (group,) = group_runs(find_runs([run]).training)
    assert evaluation_curve(group, "interaction_steps").x.tolist() == [0, 10240]
    (row,) = seed_rows([group])
    # A straight line from .25 to .75; with the one between, at .25, the area would be .625.
    assert (row["success"], row["D / steps"]) == (0.75, pytest.approx(0.5))
    assert [r["temperature"] for r in read_csv(tmp_path / "out/evaluations.csv")[::5]] == ["0.6", "0.0", "0.6"]


@pytest.mark.parametrize("settings", [{"split": "held_out"}, {"temperature": 0.0}, {"n": 64}])
def test_a_run_whose_first_evaluation_was_made_otherwise_has_no_before_and_no_areas(tmp_path, settings):
    run = write_training_run(tmp_path / "run", successes=(2, 4, 6))
    evaluated_otherwise(run, {0: settings})
    found = find_runs([run])
    (said,) = found.left_out
    assert said.endswith("; what is left has no before, D or C")
    groups = group_runs(found.training)
    assert compare_training(groups) == []
    assert evaluation_curve(groups[0], "interaction_steps").y.tolist() == [0.5, 0.75]
    (row,) = seed_rows(groups)
    assert (row["success"], row["interventions"], row["split"]) == (0.75, 32, "train")
    assert (row["D / steps"], row["C / interventions"]) == (None, None)


@pytest.mark.parametrize("settings", [{}, {"split": "held_out"}])
def test_a_run_that_was_first_evaluated_midway_has_no_before_and_no_areas(tmp_path, settings):
    run = write_training_run(tmp_path / "run", successes=(1, 2, 6))
    evaluated_otherwise(run, {0: settings})
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    # As of --eval_freq=0, until it was resumed with another one.
    (run / "metrics.jsonl").write_text("".join(lines[1:]))
    found = find_runs([run])
    assert found.left_out == [f"the first evaluation of {run} is after 5,120 steps: no before, D or C"]
    groups = group_runs(found.training)
    assert compare_training(groups) == []
    (row,) = seed_rows(groups)
    assert (row["success"], row["D / steps"], row["C / interventions"]) == (0.75, None, None)


def test_a_seed_that_did_not_come_as_far_is_left_out_of_the_gains_and_said(tmp_path):
    for seed, updates in ((1, 8), (2, 8), (3, 8)):
        write_training_run(tmp_path / str(seed), seed=seed, successes=(2, 4, 5 + seed), updates=updates)
    killed = tmp_path / "3/metrics.jsonl"
    lines = killed.read_text().splitlines(keepends=True)
    killed.write_text("".join(lines[:-2]))
    report = make_report([tmp_path])
    (comparison,) = report.comparisons
    # Seeds 1 and 2 end at 6 and 7 of 8 successes in each of four tasks.
    assert (comparison.overall.after.successes, comparison.overall.after.n) == (52, 64)
    (said,) = report.left_out
    assert said.endswith("/3: the last is after 5,120 steps, another's after 10,240")


def test_a_run_that_was_resumed_with_another_protocol_is_no_seed_of_the_others(tmp_path):
    for seed in (1, 2):
        write_training_run(tmp_path / str(seed), seed=seed)
    manifest = tmp_path / "2/manifest.json"
    (start,) = json.loads(manifest.read_text())["starts"]
    before = json.loads(json.dumps(start))
    before["config"]["protocol"]["scene_reset_interval"] = 80
    before["config"]["algorithm"]["old"] = 1
    manifest.write_text(json.dumps({"starts": [before, start]}))
    groups = group_runs(find_runs([tmp_path]).training)
    assert [group.label for group in groups] == ["1", "2 (resumed with scene_reset_interval=80, then 320)"]
