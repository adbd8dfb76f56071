"""Which rows differ: paired on the same episodes, as `cronos-report compare` has it."""

import json

import numpy as np
import pytest
from experiment_runs import make_run, read_csv, results
from forked_commands import run_forked
from scipy import stats

from cronos_lerobot.experiments.columns import difference_columns
from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.differences import compare_rows, gains, to_first
from cronos_lerobot.experiments.outputs import write_outputs


def test_rows_are_compared_as_the_report_compares_them(options, tmp_path):
    for row, seed, successes in (("t80", 1, 6), ("t80", 2, 7), ("t1280_eer", 1, 3), ("t1280_eer", 2, 2)):
        make_run(options, "table1", row, seed, (2, 4, successes))
    make_run(options, "table1", "t1280", 1, (2, 4, 6))
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    found = {(d["row"], d["reference"]): d for d in read_csv(tmp_path / "out/table1_differences.csv")}
    assert list(found) == [("t1280", "t80"), ("t1280_eer", "t80"), ("t1280_eer", "t1280")]
    one = found["t1280_eer", "t80"]
    assert (one["difference"], one["episodes"], one["of_trainings"]) == ("-0.5", "32", "True")
    folders = [next((tmp_path / "root/runs").rglob(f"{row}_10k")) for row in ("t80", "t1280_eer")]
    said = run_forked(["cronos-report", "compare", *folders, "--json"], check=True).stdout
    compared = json.loads(said)["comparisons"][0]["rows"][0]["trainings"]
    assert [float(one[name]) for name in ("ci95_low", "ci95_high", "p")] == [*compared["ci95"], compared["p"]]
    # Two of the three pairs have the first row as their reference, and p is adjusted for as many.
    line = next(line for line in text.splitlines() if line.startswith("| T = 1280, EER | T = 80 |"))
    assert line.split(" | ")[5] == f"{2 * compared['p']:.2g}"
    assert ("worse" if 2 * compared["p"] < 0.05 else "not separated") in line
    # One seed of a row says nothing of its trainings.
    assert {pair: d["of_trainings"] for pair, d in found.items()} == {
        ("t1280", "t80"): "False", ("t1280_eer", "t80"): "True", ("t1280_eer", "t1280"): "False",
    }  # fmt: skip
    # Nothing of them stays beside a page of one row.
    write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows[:1], options, tmp_path / "out")
    assert not (tmp_path / "out/table1_differences.csv").exists()


def test_rows_are_compared_on_the_seeds_that_both_have(options):
    """Another seed may have begun with another clone: 3 of 8 is compared with the 6 of its own seed."""
    for row, seed, successes in (("t80", 1, 6), ("t80", 2, 8), ("t1280", 1, 3), ("t1280_eer", 2, 2)):
        make_run(options, "table1", row, seed, (2, 4, successes))
    found = [
        (one.row.row.name, one.reference.row.name, one.difference.value, one.seeds)
        for one in compare_rows(results(options, "table1"))
    ]
    # Without a seed in common all are taken.
    assert found == [
        ("t1280", "t80", -0.375, (1, 1)),
        ("t1280_eer", "t80", -0.75, (1, 1)),
        ("t1280_eer", "t1280", -0.125, (1, 1)),
    ]


def test_rows_from_other_bases_have_references_of_their_own(options, tmp_path):
    """p is adjusted for all lines of the table; rows of other episodes are not compared."""
    ends = {"t1280_eer": 6, "t1280_eer_critic": 2, "t80_wide": 7, "t1280_eer_wide": 1}
    specs = {row: make_run(options, "few_resets", row, 1, (2, 4, end)) for row, end in ends.items()}
    result = results(options, "few_resets")
    found = to_first(result, compare_rows(result))
    # T = 80 from the narrow base is not finished: the first that is takes its place.
    pairs = [(one.row.row.name, one.reference.row.name) for one in found]
    assert pairs == [("t1280_eer_critic", "t1280_eer"), ("t1280_eer_wide", "t80_wide")]
    assert [one.difference.value for one in found] == [-0.5, -0.75]
    experiment = EXPERIMENTS["few_resets"]
    text = write_outputs(experiment, experiment.rows, options, tmp_path / "out")
    starts = ("| T = 1280, EER, critic | T", "| T = 1280, EER, wide base | T")
    lines = [line.split(" | ") for line in text.splitlines() if line.startswith(starts)]
    ps = [one.difference.p for one in found]
    assert [line[5] for line in lines] == [f"{max(ps[0], 2 * ps[1]):.2g}", f"{2 * ps[1]:.2g}"]
    metrics = specs["t1280_eer_wide"].train_folder / "metrics.jsonl"
    metrics.write_text(metrics.read_text().replace("[1000, ", "[1001, "))
    result = results(options, "few_resets")
    assert len(to_first(result, compare_rows(result))) == 1


def test_rows_of_other_benchmarks_are_not_compared(options):
    specs = [make_run(options, "table1", row, 1, (2, 4, end)) for row, end in (("t80", 6), ("t1280", 3))]
    assert len(compare_rows(results(options, "table1"))) == 1
    manifest = specs[1].train_folder / "manifest.json"
    start = json.loads(manifest.read_text())["starts"][0]
    manifest.write_text(json.dumps({"starts": [start | {"benchmark": {"fingerprint": "f" * 16}}]}))
    assert compare_rows(results(options, "table1")) == []


def test_what_a_row_has_learned_is_of_each_run_against_its_own_base(options, tmp_path):
    make_run(options, "table1", "t80", 1, (2, 4, 6))
    make_run(options, "table1", "t80", 2, (4, 4, 7))
    make_run(options, "table1", "t1280", 1, (2, 4, 6))
    make_run(options, "table1", "t1280", 2, (2, 4, 6), status="stopped")
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    t80, t1280 = read_csv(tmp_path / "out/table1_gains.csv")
    names = ("row", "before", "after", "seeds", "episodes")
    assert [t80[name] for name in names] == ["t80", "0.375", "0.8125", "2", "32"]
    # Gains of .5 and .375, in some configurations and not in others.
    gained = np.array([[0, 0, 1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1, 1, 0]])
    by_configuration = gained.mean(axis=0).var(ddof=1) / 8
    trainings = gained.mean(axis=1).var(ddof=1) / 2
    # How the two gains differ varies by configuration with twice the interaction's variance; a mean has 16 cells.
    interaction = (gained[0] - gained[1]).var(ddof=1) / 2 / 16
    # Two trainings against one policy: Student's quantiles, weighted by the variances that they belong to.
    parts = np.array([trainings, by_configuration - interaction])
    quantiles = stats.t.ppf(0.975, [1, 7])
    half = quantiles @ parts / parts.sum() * np.sqrt(parts.sum())
    assert [float(t80[name]) for name in ("gain", "ci95_low", "ci95_high")] == pytest.approx(
        [0.4375, 0.4375 - half, 0.4375 + half]
    )
    # Of one policy: four configurations changed, all for the better, one way of 2**4 and its mirror image.
    assert (t1280["gain"], t1280["p"], t1280["of_trainings"]) == ("0.5", "0.125", "False")
    assert "| T = 1280 | 0.250 | 0.750 | 1 | +0.500 |" in text


def test_runs_of_other_benchmarks_have_no_gain_together(options):
    specs = [make_run(options, "table1", "t80", seed, (2, 4, 6)) for seed in (1, 2)]
    assert [gain.seeds for gain in gains(results(options, "table1"))] == [2]
    manifest = specs[1].train_folder / "manifest.json"
    start = json.loads(manifest.read_text())["starts"][0]
    manifest.write_text(json.dumps({"starts": [start | {"benchmark": {"fingerprint": "f" * 16}}]}))
    assert gains(results(options, "table1")) == []


def test_runs_without_a_first_evaluation_have_no_gain(options):
    spec = make_run(options, "table1", "t80", 1, (2, 4, 6))
    assert len(gains(results(options, "table1"))) == 1
    metrics = spec.train_folder / "metrics.jsonl"
    lines = metrics.read_text().splitlines(keepends=True)
    first = next(line for line in lines if '"evaluation"' in line)
    metrics.write_text("".join(line for line in lines if line != first))
    assert gains(results(options, "table1")) == []


def test_where_nothing_varies_there_is_no_p_and_no_word(options):
    for seed in (1, 2):
        make_run(options, "table1", "t80", seed, (2, 4, 8))
        make_run(options, "table1", "t1280", seed, (2, 4, 8))
        make_run(options, "table1", "t1280_eer", seed, (2, 4, 4 + seed))
    columns = difference_columns(compare_rows(results(options, "table1")))
    assert columns[""][0] == "T = 1280"
    assert [columns[name][0] for name in ("difference", "p", "p (Holm)", "verdict")] == ["+0.000", "–", "–", "–"]
    # Two numbers are left to adjust.
    p = compare_rows(results(options, "table1"))[1].difference.p
    assert columns["p (Holm)"][1] == f"{min(1, 2 * p):.2g}"
