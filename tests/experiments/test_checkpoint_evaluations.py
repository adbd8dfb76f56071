"""What cronos-eval found of an experiment's checkpoints: curves, chains, and what is missing of it."""

import json
from dataclasses import replace

import pytest
from experiment_runs import by_row, evaluation, make_run, results, write_results
from synthetic_runs import INSTRUCTIONS, write_training_run

from cronos_lerobot.experiments import plots, tables
from cronos_lerobot.experiments.columns import main_columns
from cronos_lerobot.experiments.definitions import EXPERIMENTS, Base, CheckpointEvaluation, Row
from cronos_lerobot.experiments.jobs import made_by, write_record
from cronos_lerobot.experiments.outputs import write_outputs
from cronos_lerobot.experiments.plan import base_evaluation_jobs, train_job
from cronos_lerobot.experiments.results import collect
from cronos_lerobot.experiments.specs import base_evaluation_folder, run_specs


def test_held_out_curve_is_cronos_evals(options, tmp_path):
    spec = make_run(options, "figure4", "t320_eer", 1, (2, 4, 6))
    for checkpoint, success in ((5_120, 0.5), (10_240, 0.625)):
        write_results(
            spec.evaluation_folder("independent", "held_out", checkpoint),
            "independent", "held_out", evaluation(success),
        )  # fmt: skip
    base = base_evaluation_folder(Base("kitchen_2x2"), "independent", "held_out", options)
    write_results(base, "independent", "held_out", evaluation(0.125))
    result = results(options, "figure4")
    (seed,) = result.rows[1].seeds
    points = [(p.interaction_steps, p.interventions, p.success) for p in seed.curve("held_out", INSTRUCTIONS[0])]
    assert points == [(0, 0, 0.125), (5_120, 16, 0.5), (10_240, 32, 0.625)]
    row = by_row(tables.main_rows(result))["t320_eer"]
    assert (row["success_train_mean"], row["success_held_out_mean"]) == (0.75, 0.625)
    text = write_outputs(EXPERIMENTS["figure4"], EXPERIMENTS["figure4"].rows, options, tmp_path / "out")
    assert "success, held-out" in text


def test_a_row_of_its_own_environment_begins_where_the_base_stands_there(options, monkeypatch):
    """Its curve's first point is of the same episodes as the others."""
    there = Row(80, tag="there", flags=("--env.benchmark=me/bench",))
    curves = (CheckpointEvaluation("independent", ("held_out",), every_checkpoint=True),)
    experiment = replace(EXPERIMENTS["figure4"], rows=(Row(80), there), evaluations=curves)
    here, own = run_specs(experiment, options)[:2]
    jobs = [base_evaluation_jobs(spec, curves[0])[0] for spec in (here, own)]
    assert [("--env.benchmark=me/bench" in job.command) for job in jobs] == [False, True]
    assert jobs[0].output == base_evaluation_folder(here.base, "independent", "held_out", options)
    write_results(jobs[1].output, "independent", "held_out", evaluation(0.25))
    monkeypatch.setitem(EXPERIMENTS, "there", experiment)
    make_run(options, "there", there.name, 1, (2, 4, 6))
    (seed,) = results(options, "there").rows[1].seeds
    assert [(p.interaction_steps, p.success) for p in seed.curve("held_out")] == [(0, 0.25)]


def test_one_split_that_is_not_the_curves_is_named(options):
    experiment = replace(EXPERIMENTS["figure4"], splits=("held_out",))
    make_run(options, "figure4", "t320_eer", 1, (2, 4, 6))
    titles = main_columns(collect(experiment, experiment.rows, options)).keys()
    assert {"success, held-out", "base, train", "D / steps, train", "C / interventions, train"} <= titles


def test_seeds_without_an_evaluation_are_not_counted_as_if_they_had_one(options, tmp_path):
    first, _ = (make_run(options, "figure4", "t320_eer", seed, (2, 4, 6)) for seed in (1, 2))
    for checkpoint in (5_120, 10_240):
        folder = first.evaluation_folder("independent", "held_out", checkpoint)
        write_results(folder, "independent", "held_out", evaluation(0.5))
    result = results(options, "figure4")
    row = by_row(tables.main_rows(result))["t320_eer"]
    assert (row["seeds"], row["seeds_train"], row["seeds_held_out"]) == (2, 2, 1)
    text = write_outputs(EXPERIMENTS["figure4"], EXPERIMENTS["figure4"].rows, options, tmp_path / "out")
    assert "| seeds, held-out |" in text
    assert "| 1/2 |" in text
    unfinished = text.split("## Not finished")[1]
    assert "- base/kitchen_2x2_state_400demos_320steps/independent_held_out: not evaluated" in unfinished
    assert "t320_eer_10k/seed2/independent_held_out_0010240: not evaluated" in unfinished
    assert "t320_eer_10k/seed1/independent_held_out" not in unfinished
    labels = [text.get_text() for text in plots.curves_figure(result).legends[0].get_texts()]
    assert labels == ["T = 320, EER (2 seeds)", "T = 320, EER (1 seed)"]


def test_evaluation_of_a_run_that_its_own_budget_ended_counts(options):
    budgets = (("--protocol.reset_budget", 1000),)
    short = Row(320, end_effector_reset=True, budgets=budgets, tag="short")
    evaluations = (CheckpointEvaluation("independent", ("held_out",)),)
    experiment = replace(EXPERIMENTS["figure4"], rows=(short,), evaluations=evaluations)
    (spec,) = [spec for spec in run_specs(experiment, options) if spec.seed == 1]
    write_training_run(spec.train_folder, seed=1, interval=320, successes=(2, 4, 6), updates=4)
    job = train_job(spec, None)
    record = {"command": list(job.command), "status": "done", "seconds": 3.0, "starts": 1}
    write_record(job, record | {"made_by": made_by(job)})
    folder = spec.evaluation_folder("independent", "held_out", 10_240)
    write_results(folder, "independent", "held_out", evaluation(0.5))
    (row,) = tables.main_rows(collect(experiment, (short,), options))
    assert (row["success_train_mean"], row["success_held_out_mean"]) == (0.75, 0.5)


def test_sequences(options, tmp_path):
    apart = {"found_complete": 1, "never_grasped": 2}
    rates = {1: [0.75, 0.5, 0.25, 0.0], 2: [0.25, 0.5, 0.25, 0.0]}
    for seed, successes in rates.items():
        spec = make_run(options, "figure5", "t320_eer", seed, (2, 4, 6))
        content = {
            "n": 640,
            "positions": [{"success": s, "std": 0.1, "n": 640, "ci95": [0, 1]} | apart for s in successes],
            "seen": {"n": 64, "positions": [{"success": 1.0}] * 4, "average_chain_length": {"mean": 4.0}},
            "unseen": None,
            "average_chain_length": {"mean": sum(successes), "std": 0.1, "ci95": [0, 4]},
        }
        write_results(spec.evaluation_folder("sequential", "held_out", 10_240), "sequential", "held_out", content)
    row, seen = tables.sequential_rows(results(options, "figure5"))
    assert (seen["orderings"], seen["n"], seen["SEQ 0_mean"], seen["chain_length_mean"]) == ("seen", 64, 1.0, 4.0)
    assert (row["row"], row["split"], row["n"], row["seeds"]) == ("t320_eer", "held_out", 640, 2)
    assert [row[f"SEQ {i}_mean"] for i in range(4)] == [0.5, 0.5, 0.25, 0.0]
    assert row["SEQ 0_std"] == pytest.approx(0.5 / 2**0.5)
    assert row["chain_length_mean"] == 1.25
    text = write_outputs(EXPERIMENTS["figure5"], EXPERIMENTS["figure5"].rows, options, tmp_path / "out")
    assert "| T = 320, EER | held_out | all |" in text
    assert (
        "| 0.500 ± 0.354 | 0.500 ± 0.000 | 0.250 ± 0.000 | 0.000 ± 0.000 | 1.250 ± 0.354 | 640 | 8 | 16 | 2 |"
        in text
    )
    assert (tmp_path / "out/figure5_sequential.png").exists()


def test_results_of_version_0_are_named_and_left_out(options):
    spec = make_run(options, "figure4", "t80", 1, (2, 4, 6))
    folder = spec.evaluation_folder("independent", "held_out", 10_240)
    write_results(folder, "independent", "held_out", evaluation(0.5))
    old = {"format": 1, "benchmark": {"environment": "lerobot_env_cronos/kitchen_2x2-v0"}}
    (folder / "results.json").write_text(json.dumps(old))
    result = results(options, "figure4")
    (text,) = result.changed
    assert "kitchen_2x2-v0; this is version 1" in text
    row = by_row(tables.main_rows(result))["t80"]
    assert (row["success_train_mean"], row["success_held_out_mean"]) == (0.75, None)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"interaction_steps": 20_480}, "it was gone on with to 20,480 steps, of 10,240"),
        ({"temperature": 0.0}, "its evaluations were not all made alike"),
    ],
)
def test_a_run_that_was_gone_on_with_by_hand_is_named_and_left_out(options, changes, why):
    metrics = make_run(options, "table1", "t80", 1, (2, 4, 6)).train_folder / "metrics.jsonl"
    lines = [json.loads(line) for line in metrics.read_text().splitlines()]
    metrics.write_text("".join(json.dumps(line) + "\n" for line in [*lines, lines[-1] | changes]))
    result = results(options, "table1")
    assert result.changed == [f"kitchen_2x2_state_small/t80_10k/seed1: {why}"]
    assert by_row(tables.main_rows(result))["t80"]["seeds"] == 0


def test_a_run_that_was_resumed_with_other_flags_is_named_and_left_out(options):
    manifest = make_run(options, "table1", "t80", 1, (2, 4, 6)).train_folder / "manifest.json"
    content = json.loads(manifest.read_text())
    (start,) = content["starts"]
    other = start | {"interaction_steps": 5_120}
    other["config"] = start["config"] | {"protocol": start["config"]["protocol"] | {"scene_reset_interval": 40}}
    manifest.write_text(json.dumps({"starts": [start, other]}))
    (text,) = results(options, "table1").changed
    assert "it was gone on with other flags: protocol.scene_reset_interval 80, then 40" in text


@pytest.mark.parametrize(("files", "taken"), [("1f", True), ("2e", False), (None, True)])
def test_an_evaluation_of_another_clone_is_not_the_start_of_a_curve(options, files, taken):
    """An archive's runs began with another machine's clone than the one that was evaluated here."""
    spec = make_run(options, "figure4", "t80", 1, (2, 4, 6))
    manifest = spec.train_folder / "manifest.json"
    content = json.loads(manifest.read_text())
    content["starts"][0]["policy_fingerprint"] = "1f"
    manifest.write_text(json.dumps(content))
    folder = base_evaluation_folder(spec.base, "independent", "held_out", options)
    write_results(folder, "independent", "held_out", evaluation(0.5))
    told = json.loads((folder / "results.json").read_text()) | ({"policy_files": files} if files else {})
    (folder / "results.json").write_text(json.dumps(told))
    (job,) = base_evaluation_jobs(spec, EXPERIMENTS["figure4"].evaluations[0])
    write_record(
        job, {"command": list(job.command), "status": "done", "seconds": 1, "starts": 1, "made_by": made_by(job)}
    )
    result = results(options, "figure4")
    (seed,) = next(row for row in result.rows if row.row.name == "t80").seeds
    assert (0 in seed.evaluations.get(("independent", "held_out"), {})) == taken
    assert any("another base policy than the one that" in text for text in result.changed) != taken
