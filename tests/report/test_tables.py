"""The report's numbers are the runs' numbers, by hand."""

import numpy as np
import pandas as pd
import pytest
from synthetic_evaluations import write_evaluation
from synthetic_runs import edit_lines, write_training_run

from cronos_lerobot.report.figures import evaluation_curve, mean_curve, segment_curve
from cronos_lerobot.report.load import EVALUATIONS, load, load_evaluations
from cronos_lerobot.report.tables import (
    chain_table,
    gain_table,
    merged,
    part_table,
    seed_table,
    training_curves,
)
from cronos_lerobot.statistics import wilson_interval

NOTHING = pd.DataFrame(columns=EVALUATIONS)


def test_seeds_together_end_where_all_have_been(tmp_path):
    write_training_run(tmp_path / "a", seed=0, interval=160, successes=(2, 4, 6))
    killed = write_training_run(tmp_path / "b", seed=1, interval=160, successes=(2, 6, 8))
    edit_lines(killed, lambda lines: lines.__delitem__(slice(6, None)))
    (row,) = seed_table(load_evaluations([tmp_path])).to_dict("records")
    assert (row["runs"], row["seeds"], row["steps"], row["interventions"]) == ("T = 160", 2, 5120, 32)
    # .5 and .75. Two seeds have no interval.
    assert (row["success"], row["success ci95_low"]) == (0.625, None)
    # Gaps .75 to .5 and .75 to .25: on average .625 and .5, over steps and over resets alike.
    assert row["D / steps"] == pytest.approx((0.625 + 0.5) / 2)
    assert row["C / interventions"] == pytest.approx(row["D / steps"])
    assert row["D / steps std"] == pytest.approx(0.125 / 2**0.5)


def test_areas_need_a_first_evaluation_at_step_0(tmp_path):
    run = write_training_run(tmp_path / "run", successes=(2, 4, 6))
    edit_lines(run, lambda lines: lines.pop(0))
    assert "D and C" in load([run]).left_out[0]
    (row,) = seed_table(load_evaluations([run])).to_dict("records")
    assert row["success"] == 0.75
    assert np.isnan(row["D / steps"])
    assert len(gain_table(load_evaluations([run]), NOTHING, NOTHING)) == 0


def test_numbers_are_merged_to_read(tmp_path):
    for seed, last in enumerate((4, 5, 6)):
        write_training_run(tmp_path / str(seed), seed=seed, successes=(2, 4, last))
    table = merged(seed_table(load_evaluations([tmp_path])))
    # .5, .625, .75: t with two degrees of freedom is 4.303, the standard error .125 / sqrt(3).
    assert table["success"].tolist() == ["0.625 ± 0.12 [0.3145, 0.9355]"]
    assert not any(name.endswith(("std", "low", "high")) for name in table)


def test_gain_of_one_run_is_paired_by_episode(tmp_path):
    run = write_training_run(tmp_path / "run", tasks=["1" * 6 + "00"] * 4)
    overall, *tasks = gain_table(load_evaluations([run]), NOTHING, NOTHING).to_dict("records")
    assert (overall["suite"], overall["n"], overall["seeds"]) == ("periodic evaluation, train", 32, 1)
    assert (overall["before"], overall["after"], overall["gain"]) == (0, 0.75, 0.75)
    # Six of eight configurations gain in all four tasks: 2 / 2^6.
    assert overall["p"] == 2 / 64
    assert overall["gain ci95_low"] > 0
    assert len(tasks) == 4
    assert tasks[0]["after ci95_low"] == pytest.approx(wilson_interval(6, 8)[0])


def test_gain_of_three_seeds_is_over_the_trainings(tmp_path):
    for seed, last in enumerate((4, 5, 6)):
        write_training_run(tmp_path / str(seed), seed=seed, successes=(2, 4, last))
    row = gain_table(load_evaluations([tmp_path]), NOTHING, NOTHING).iloc[0]
    assert (row["seeds"], row["before"], row["after"], row["gain"]) == (3, 0.25, 0.625, 0.375)
    assert row["gain ci95_low"] < 0.25 < 0.5 < row["gain ci95_high"]
    # A run that did not come as far is not compared, and two seeds have no interval.
    edit_lines(tmp_path / "2", lambda lines: lines.__delitem__(slice(6, None)))
    row = gain_table(load_evaluations([tmp_path]), NOTHING, NOTHING).iloc[0]
    assert (row["seeds"], row["gain"]) == (2, 0.3125)
    assert pd.isna(row["gain ci95_low"])


def test_the_tasks_of_evaluations(tmp_path):
    write_evaluation(tmp_path / "a", "me/a", chains=[[0, 1, 4], [2, 4, 4]])
    write_evaluation(tmp_path / "b", "me/a", stream=["1101", "0001"])
    table = load_evaluations([tmp_path])
    chains = part_table(table[table["suite"] == "sequential"], ["policy", "split"], with_all=False)
    everything = chains[chains["orderings"] == "all"].set_index("task")["success"]
    assert everything.to_dict() == {
        "SEQ 0": 5 / 6, "SEQ 1": 4 / 6, "SEQ 2": 0.5, "SEQ 3": 0.5, "chain length": 2.5
    }  # fmt: skip
    assert chain_table(chains)["SEQ 2"].str.startswith("0.5 ± 0.1 [").all()
    # The success of a whole chain stands for it.
    assert table["success"].tolist() == [0.5, 0.5]
    stream = part_table(table[table["suite"] == "stream"], ["policy"]).set_index("task")["success"]
    assert stream.tolist() == [0.5, 0.5, 0.5, 0.0, 1.0]


def test_curve_of_seeds_is_their_mean_and_standard_deviation(tmp_path):
    write_training_run(tmp_path / "a", seed=0, successes=(2, 4, 6))
    write_training_run(tmp_path / "b", seed=1, successes=(2, 2, 2))
    (curves,) = training_curves(load_evaluations([tmp_path])).values()
    curve = evaluation_curve(curves, "steps")
    assert curve.x[::2].tolist() == [0, 5120, 10240]
    assert curve.y[::2].tolist() == [0.25, 0.375, 0.5]
    # Sample standard deviation of two numbers is their distance over sqrt(2).
    assert (curve.high - curve.y)[::2].tolist() == pytest.approx([0, 0.25 / 2**0.5, 0.5 / 2**0.5])
    assert evaluation_curve(curves, "interventions").x[::2].tolist() == [0, 16, 32]
    assert evaluation_curve(curves[:1], "steps").low.tolist() == curves[0]["ci95_low"].tolist()


def test_a_mean_curve_is_vertical_where_a_curve_is():
    curve = mean_curve([([0, 0, 10], [0.2, 0.4, 0.6]), ([0, 10, 20], [0.4, 0.4, 0.8])])
    assert curve.x.tolist() == [0, 0, 10, 10]
    assert curve.y.tolist() == pytest.approx([0.3, 0.4, 0.5, 0.5])


def test_success_by_segment_at_the_end(tmp_path):
    run = write_training_run(tmp_path / "a", interval=320, updates=8)
    (read,) = load([run]).runs
    counts = [update["rollout"]["success_by_segment"] for update in read.updates]
    segments = load([run]).segments
    # The last quarter of 8 updates is 2, one whole cycle of 320 steps.
    expected = {int(k) + 1: s / n for update in counts[-2:] for k, (s, n) in update.items()}
    curve = segment_curve(segments)
    assert dict(zip(curve.x, curve.y, strict=True)) == expected


def test_late_segments_are_joined_in_spans_that_double():
    numbers = np.array([1, 16, 17, 32, 33, 64, 65])
    table = pd.DataFrame({"part": numbers - 1, "successes": 1, "n": 2, "folder": "a"})
    curve = segment_curve(table.assign(kind="segment", is_late=True))
    assert curve.x.tolist() == [1, 16, 24.5, 48.5, 96.5]
