"""An experiment's page and files, from the evaluations of its runs."""

from pathlib import Path

import pandas as pd
import pytest
from synthetic_evaluations import write_evaluation
from synthetic_runs import write_training_run

from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.outputs import write_outputs
from cronos_lerobot.experiments.plan import Options, make_runs
from cronos_lerobot.experiments.scales import SCALES


def test_rows_are_means_over_finished_seeds(tmp_path):
    experiment = EXPERIMENTS["figure2"]
    runs = make_runs(experiment, experiment.rows[:1], (1, 2, 3), Options(SCALES["smoke"], "state", tmp_path))
    for run, successes in zip(runs, (4, 5, 6), strict=True):
        train = write_training_run(run.folder / "train", seed=run.seed, successes=(2, 4, successes))
        last = train / "checkpoints/0010240/pretrained_model"
        # A base policy has steps of its own: those of its cloning.
        base = Path("base/checkpoints/000320/pretrained_model")
        for step, policy, task in (("0000000", base, "1000"), ("0010240", last, "1100")):
            write_evaluation(run.folder / "eval" / step, str(policy), tasks=[task] * 4)
        if run.seed < 3:
            (train / ".done").touch()
    page = write_outputs(experiment, runs, tmp_path / "out")
    assert "Not finished: kitchen_2x2_state_paper_smoke/t1280_eer_cl_hsr_2k/seed3." in page
    (row,) = pd.read_csv(tmp_path / "out/figure2.csv").to_dict("records")
    assert (row["row"], row["seeds"], row["n"], row["interventions"]) == ("T = 1280, EER, CL, HSR", 2, 32, 32)
    # .25 at the start, .5 after half of the run, .5 and .625 at its end: gaps (.75 / 2 + .5 + .5 / 2) / 2 = .5625
    # and (.75 / 2 + .5 + .375 / 2) / 2 = .53125 over steps, and over interventions alike.
    expected = {"base": "0.250 ± 0.000", "train": "0.562 ± 0.088", "held out": "0.500 ± 0.000"}
    assert expected | {"D / steps": "0.547 ± 0.022", "C / interventions": "0.547 ± 0.022"} == {
        name: row[name] for name in (*expected, "D / steps", "C / interventions")
    }
    evaluations = pd.read_csv(tmp_path / "out/figure2_evaluations.csv")
    held_out = evaluations[evaluations["split"] == "held_out"]
    assert held_out["steps"].tolist() == [0, 10240] * 3
    assert held_out["interventions"].tolist() == [0, 32] * 3
    assert {path.name for path in (tmp_path / "out").glob("*.png")} == {
        "figure2.png", "figure2_ends.png", "figure2_by_task.png",
    }  # fmt: skip
    assert pytest.approx([0.25, 0.5]) == held_out["success"].tolist()[:2]


def test_streams_are_read_by_segment(tmp_path):
    experiment = EXPERIMENTS["baselines"]
    runs = make_runs(experiment, experiment.rows[:1], (1, 2), Options(SCALES["smoke"], "state", tmp_path))
    for run, streams in zip(runs, (("1100", "1000"), ("1111", "1000")), strict=True):
        train = write_training_run(run.folder / "train", seed=run.seed, successes=(2, 4, 4))
        policy = str(train / "checkpoints/0010240/pretrained_model")
        write_evaluation(run.folder / "eval/0010240", policy, stream=streams)
        (train / ".done").touch()
    page = write_outputs(experiment, runs, tmp_path / "out")
    # 3 and 5 of 8 segments; the first is always done, of the second half 0 and 2 of 4.
    line = "| T = 80 | held_out | 2 | 2 | 0.500 ± 0.177 | 1.000 ± 0.000 | 0.250 ± 0.354 |"
    assert line in [" ".join(one.split()) for one in page.splitlines()]
