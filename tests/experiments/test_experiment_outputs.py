"""Tables and figures say what the runs' files say, the paper's numbers beside them."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import pytest
from experiment_runs import RESETS, by_row, make_run, read_csv, results
from forked_commands import run_forked
from synthetic_runs import INSTRUCTIONS, write_training_run

from cronos_lerobot.experiments import plots, tables
from cronos_lerobot.experiments.definitions import EXPERIMENTS, Experiment, Row
from cronos_lerobot.experiments.few_resets import SCREENED
from cronos_lerobot.experiments.jobs import write_record
from cronos_lerobot.experiments.outputs import write_outputs
from cronos_lerobot.experiments.plan import train_job
from cronos_lerobot.experiments.scales import SCALES
from cronos_lerobot.experiments.specs import run_specs


# 8 streams x 8 updates x 160 steps, as the made-up runs have; evaluated at 0, 5120 and 10240.
def test_main_table(options):
    make_run(options, "table1", "t80", 1, (2, 4, 5))
    make_run(options, "table1", "t80", 2, (2, 4, 7))
    make_run(options, "table1", "t1280_eer", 1, (2, 2, 3))
    row = by_row(tables.main_rows(results(options, "table1")))
    t80 = row["t80"]
    assert (t80["success_train_mean"], t80["n_train"], t80["seeds"]) == (0.75, 32, 2)
    assert t80["success_train_std"] == pytest.approx(0.25 / 2**0.5)
    # Two seeds, .625 and .875: t with one degree of freedom is 12.706, the standard error 1 / 8, and .75 +- 1.59
    # is wider than a rate can be.
    assert (t80["success_train_ci95_low"], t80["success_train_ci95_high"]) == (0.0, 1.0)
    assert (t80["paper_mean"], t80["paper_std"]) == (0.897, 0.027)
    assert (t80["base_success_mean"], t80["interventions_mean"]) == (0.25, RESETS[80])
    # One policy that both seeds begin with: Wilson's interval of 8 successes in 32, none of two that are alike.
    assert t80["base_success_ci95_low"] == pytest.approx(0.1325, abs=1e-4)
    assert t80["base_success_ci95_high"] == pytest.approx(0.4211, abs=1e-4)
    # Gaps .75, .5, .375 and .75, .5, .125 at three evaluations equally far apart.
    assert t80["D_normalised_mean"] == pytest.approx((1.0625 + 0.9375) / 2 / 2)
    assert t80["D_mean"] == pytest.approx(10_240 * t80["D_normalised_mean"])
    # One scene reset in 80 steps of each stream: the same shape over interventions.
    assert t80["C_normalised_mean"] == pytest.approx(t80["D_normalised_mean"])
    assert t80["C_mean"] == pytest.approx(RESETS[80] * t80["C_normalised_mean"])
    # T = 1280 comes to 8 interventions; T = 80 has then gone from .25 to .25 + .25 * 8 / 64.
    assert t80["shared_budget"] == 8
    assert t80["C_normalised_shared_mean"] == pytest.approx((0.75 + 0.71875) / 2)
    one = row["t1280_eer"]
    assert (one["success_train_mean"], one["success_train_std"]) == (0.375, None)
    # One seed: Wilson's interval of 12 successes in 32 episodes.
    assert one["success_train_ci95_low"] == pytest.approx(0.2293, abs=1e-4)
    assert one["success_train_ci95_high"] == pytest.approx(0.5475, abs=1e-4)
    assert row["t1280"]["success_train_mean"] is None
    assert row["t1280"]["seeds"] == 0


def test_intervals_of_areas_end_where_areas_do(options):
    make_run(options, "table1", "t80", 1, (8, 8, 8))
    make_run(options, "table1", "t80", 2, (2, 2, 2))
    t80 = by_row(tables.main_rows(results(options, "table1")))["t80"]
    # Gaps 0 and .75: .375 +- 12.706 * .375.
    assert (t80["C_normalised_ci95_low"], t80["C_normalised_ci95_high"]) == (0.0, 1.0)
    assert (t80["D_ci95_low"], t80["C_ci95_low"]) == (0.0, 0.0)
    assert t80["D_ci95_high"] == pytest.approx(10_240 * 0.375 * 13.706, rel=1e-4)


def test_success_at_interventions_is_that_of_the_curve(options):
    make_run(options, "figure3", "t80", 1, (2, 4, 6))
    make_run(options, "figure3", "t320_eer", 1, (2, 6, 8))
    result = results(options, "figure3")
    # 1000, 2000, 4000 and 8000 of 2.9 M steps, in 10,240.
    assert tables.budgets(result) == [3, 7, 14, 28]
    rows = by_row(tables.main_rows(result))
    assert rows["t80"]["success_at_28_mean"] == pytest.approx(0.25 + 0.25 * 28 / 64)
    assert rows["t320_eer"]["success_at_28_mean"] == pytest.approx(0.75 + 0.25 * 12 / 16)
    # Two seeds: Student's interval would go from -0.8 to 2.4.
    make_run(options, "figure3", "t320_eer", 2, (2, 4, 6))
    two = by_row(tables.main_rows(results(options, "figure3")))["t320_eer"]
    assert (two["success_at_28_ci95_low"], two["success_at_28_ci95_high"]) == (0, 1)
    (claim,) = tables.claim_rows(result)
    assert claim["paper"] == 0.38
    assert claim["ours"] == pytest.approx(0.9375 - 0.359375)


def test_nothing_is_extrapolated(options):
    make_run(options, "table1", "t1280_eer", 1, (2, 2, 3))
    (row,) = [r for r in tables.main_rows(results(options, "table1")) if r["row"] == "t1280_eer"]
    # 1000, 1600, 2000, 6000 of 1.3 M: 7, 12, 15, 47; the run came to 8.
    assert row["success_at_7_mean"] is not None
    assert [row[f"success_at_{n}_mean"] for n in (12, 15, 47)] == [None] * 3


def test_interventions_to_reach(options):
    make_run(options, "table1", "t1280_eer", 1, (2, 2, 3))
    make_run(options, "table1", "t1280_eer_cl", 1, (2, 4, 6))
    claims = {claim["claim"]: claim for claim in tables.claim_rows(results(options, "table1"))}
    goal = "to reach the end of t1280_eer"
    assert (
        claims[f"interventions of t1280_eer {goal}"]["paper"],
        claims[f"interventions of t1280_eer_cl {goal}"]["paper"],
    ) == (1000, 1600)
    # 3/8 at the end of T = 1280, after all its 8 resets; half way from .25 to .5 for the other, which has none
    # before its first evaluation at 5120 steps (640 of each stream): the vertical part at 0 already passes it.
    assert claims[f"interventions of t1280_eer {goal}"]["ours"] == 8
    assert claims[f"interventions of t1280_eer_cl {goal}"]["ours"] == 0
    assert claims["interventions of t1280_eer_cl_hsr at the end"] == {
        "claim": "interventions of t1280_eer_cl_hsr at the end",
        "paper": 6000,
        "ours": None,
        "interpolated": False,
        "not_applicable": None,
    }


def test_what_says_nothing_is_not_applicable_and_says_why(options, tmp_path):
    make_run(options, "table1", "t1280_eer", 1, (4, 3, 3))
    result = results(options, "table1")
    claims = {claim["claim"]: claim for claim in tables.claim_rows(result)}
    claim = claims["interventions of t1280_eer to reach the end of t1280_eer"]
    # The base policy is at .5, the end at .375.
    assert claim["ours"] is None
    assert claim["not_applicable"] == "the base policy is there from the start: 0.500, the goal is 0.375"
    row = by_row(tables.main_rows(result))["t1280_eer"]
    # 8 streams of 1280 steps are reset once each.
    assert row["success_at_12_not_applicable"] == "the runs ended after 8 interventions"
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    assert "not applicable: the base policy is there from the start" in text
    assert "- T = 1280, EER at 12: not applicable, the runs ended after 8 interventions." in text
    assert "The learning algorithm is `ppo`" in text


def test_what_is_interpolated_is_marked_and_what_is_measured_is_not(options, tmp_path):
    spec = make_run(options, "figure3", "t80", 1, (2, 4, 6))
    make_run(options, "figure3", "t320_eer", 1, (2, 6, 8))
    metrics = spec.train_folder / "metrics.jsonl"
    lines = [json.loads(line) for line in metrics.read_text().splitlines()]
    # Evaluations at 0, 64 and 128 interventions, the second at the first update that came to 28.
    [line for line in lines if line["kind"] == "evaluation"][1]["at_interventions"] = [28]
    metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
    rows = by_row(tables.main_rows(results(options, "figure3")))
    t80, t320 = rows["t80"], rows["t320_eer"]
    assert (t80["success_at_28_mean"], t80["success_at_28_interpolated_between"]) == (0.5, None)
    assert t80["success_at_14_interpolated_between"] == "0-64"
    assert t320["success_at_28_interpolated_between"] == "16-32"
    text = write_outputs(EXPERIMENTS["figure3"], EXPERIMENTS["figure3"].rows, options, tmp_path / "out")
    # Success is .25 to .5 over 64 interventions.
    assert "| T = 80 | ~0.262 | ~0.277 | ~0.305 | 0.500 |" in text
    assert "- T = 80 at 14: a straight line between 0 and 64." in text
    assert (tmp_path / "out/figure3.csv").read_text().count("0-64") == 3


def test_unfinished_run_is_drawn_but_not_counted(options, tmp_path):
    make_run(options, "table1", "t80", 1, (2, 4, 6))
    make_run(options, "table1", "t80", 2, (2, 4, 8), status="running")
    make_run(options, "table1", "t1280", 1, (2, 4, 8), status="stopped")
    # Two ended before their first record, one of them to be resumed.
    for row, state in (("t1280_eer", "failed"), ("t1280_eer_cl_lsr", "stopped")):
        job = train_job(next(s for s in run_specs(EXPERIMENTS["table1"], options) if s.row.name == row), None)
        write_record(job, {"command": list(job.command), "status": state, "seconds": 3.0, "starts": 1})
    result = results(options, "table1")
    row = by_row(tables.main_rows(result))
    assert (row["t80"]["success_train_mean"], row["t80"]["seeds"], row["t80"]["seeds_wanted"]) == (0.75, 1, 2)
    assert row["t1280"]["success_train_mean"] is None
    # A finished seed stands for its row alone.
    assert plots.row_curve(result.rows[0], "train", "interaction_steps").y.tolist() == [0.25, 0.5, 0.75]
    curve = plots.row_curve(result.rows[1], "train", "interaction_steps")
    assert curve.y.tolist() == [0.25, 0.5, 1.0]
    assert plots.row_label(result.rows[1]) == "T = 1280 (1 seed, unfinished)"
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    assert "t80_10k/seed2: 10,240 of 10,240 steps" in text
    assert "t1280_eer_cl: 2 of 2 seeds not begun" in text
    assert re.search(r"t1280_eer_10k/seed1: no record so far \(failed, see .*/seed1/train\.log\)", text)
    assert "t1280_eer: 1 of 2 seeds not begun" in text
    assert "t1280_eer_cl_lsr_10k/seed1: no record so far (stopped)\n" in text


def test_run_without_its_last_evaluation_has_no_success_at_the_end(options):
    metrics = make_run(options, "table1", "t80", 1, (2, 4, 6)).train_folder / "metrics.jsonl"
    *lines, last = metrics.read_text().splitlines(keepends=True)
    assert json.loads(last)["kind"] == "evaluation"
    metrics.write_text("".join(lines))
    row = by_row(tables.main_rows(results(options, "table1")))["t80"]
    assert (row["seeds"], row["success_train_mean"]) == (1, None)
    # Its curve is still there.
    assert row["D_normalised_mean"] is not None


def test_run_of_another_command_is_named_and_left_out(options, tmp_path):
    make_run(options, "table1", "t80", 1, (2, 4, 6))
    other = replace(options, extra=("--algorithm.target_kl=0.02",))
    result = results(other, "table1")
    (text,) = result.changed
    assert "t80_10k/seed1" in text
    assert "none there, --algorithm.target_kl=0.02 here" in text
    row = by_row(tables.main_rows(result))["t80"]
    assert (row["seeds"], row["success_train_mean"]) == (0, None)
    # It has begun, though not for this page.
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, other, tmp_path / "out")
    assert "t80: 1 of 2 seeds not begun" in text


def test_flags_besides_those_of_the_rows_are_on_the_page(options, tmp_path):
    rows = EXPERIMENTS["table1"].rows
    plain = write_outputs(EXPERIMENTS["table1"], rows, options, tmp_path / "plain")
    assert "The learning algorithm is `ppo`" in plain
    assert "All runs have these flags" not in plain
    other = replace(options, extra=("--algorithm.type=ppo_paper", "--protocol.curriculum=[[8,320]]"))
    page = write_outputs(EXPERIMENTS["table1"], rows, other, tmp_path / "other")
    flags = "`--algorithm.type=ppo_paper '--protocol.curriculum=[[8,320]]'`"
    assert f"All runs have these flags besides, whatever a row is called: {flags}." in page
    assert "The learning algorithm is" not in page
    # That of a row is named beside the others'.
    own = Row(80, tag="cloned", flags=("--algorithm.type=imitation",))
    for chosen, has_others in (((own,), False), ((Row(80), own), True)):
        page = write_outputs(Experiment("mine", "", chosen), chosen, options, tmp_path / "own")
        assert ("The learning algorithm is `ppo`" in page) is has_others
        assert "Rows with an agent of their own: T = 80, cloned (`--algorithm.type=imitation`)." in page


def test_takeovers_are_told_apart_with_what_one_counts(options, tmp_path):
    experiment = EXPERIMENTS["few_resets"]
    for row in ("t1280_eer", "tnone_eer_takeover"):
        spec = make_run(options, "few_resets", row, 1, (2, 4, 6))
    metrics = spec.train_folder / "metrics.jsonl"
    lines = [json.loads(line) for line in metrics.read_text().splitlines()]
    for line in lines:
        line["interventions_by_kind"]["takeover"] = 3
    metrics.write_text("".join(json.dumps(line) + "\n" for line in lines))
    manifest = spec.train_folder / "manifest.json"
    content = json.loads(manifest.read_text())
    content["starts"][0]["config"]["protocol"]["takeover_price"] = 5
    manifest.write_text(json.dumps(content))
    page = write_outputs(experiment, experiment.rows, options, tmp_path / "out")
    titles, _, *rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| ")]
    # Those of the wide base come after these, by the same names.
    cells = {row[titles.index("row")]: row[titles.index("takeovers")] for row in rows[: len(SCREENED)][::-1]}
    assert (cells["takeover"], cells["staggered"]) == ("3 at 5 each", "–")


def test_run_that_its_reset_budget_ended_early_counts_and_is_named(options, tmp_path):
    make_run(options, "table1", "t80", 1, (2, 4, 6), updates=4)
    make_run(options, "table1", "t1280", 1, (2, 4, 6))
    row = by_row(tables.main_rows(results(options, "table1")))["t80"]
    assert (row["seeds"], row["success_train_mean"], row["interventions_mean"]) == (1, 0.75, RESETS[80] / 2)
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    early = text.split("## Ended by their budget of interventions\n\n")[1].split("\n\n")[0]
    assert early.strip() == "- kitchen_2x2_state_small/t80_10k/seed1: after 5,120 of 10,240 steps"


def test_a_number_of_interventions_that_some_runs_did_not_reach_has_a_reason(options):
    make_run(options, "figure3", "t80", 1, (2, 4, 6))
    make_run(options, "figure3", "t80", 2, (2, 4, 6), updates=4)
    row = results(options, "figure3").rows[0]
    found = row.success_at(100)
    assert (found.summary, found.reason) == (None, "1 of 2 runs ended after 64 interventions")
    assert row.success_at(64).summary.n == 2


def test_files_of_table1(options, tmp_path):
    for seed in (1, 2):
        make_run(options, "table1", "t80", seed, (2, 4, 4 + seed))
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    out = tmp_path / "out"
    line = next(line for line in text.splitlines() if line.startswith("| 80 |"))
    cells = [cell.strip() for cell in line.split("|")][1:-1]
    assert cells[:13] == [
        "80", "–", "–", "–", "–", "0.688 ± 0.088", "[0.000, 1.000]", "32", "0", "0", "2/2", "0.897 ± 0.027",
        "0.250",
    ]  # fmt: skip
    assert (out / "table1.md").read_text() in text
    curves = read_csv(out / "table1_curves.csv")
    # Two seeds, three evaluations, all tasks together and four single ones.
    assert len(curves) == 2 * 3 * 5
    last = [c for c in curves if (c["seed"], c["interaction_steps"], c["task"]) == ("2", "10240", "all tasks")]
    assert [(c["success"], c["n"], c["interventions"]) for c in last] == [("0.75", "32", "128")]
    data = json.loads((out / "table1.json").read_text())
    assert data["rows"][0]["success_train_mean"] == 0.6875
    assert (data["seeds"], data["steps"], data["paper_steps"]) == ([1, 2], 10_240, 1_300_000)
    assert "OpenVLA" in data["paper"]["source"]
    segments = read_csv(out / "table1_segments.csv")
    assert {(s["row"], s["segment"]) for s in segments} == {("t80", "0")}
    for name in ("table1", "table1_bars", "table1_segments"):
        picture = matplotlib.image.imread(out / f"{name}.png")
        # Something is drawn, in more than one colour.
        assert len({tuple(pixel) for pixel in picture[::7, ::7, :3].reshape(-1, 3).tolist()}) > 5


def test_tasks_and_reset_tasks_by_quarter(options, tmp_path):
    task, reset = INSTRUCTIONS[0], "put it on the table"
    for seed in (1, 2):
        spec = make_run(options, "table1", "t1280_eer_cl_lsr", seed, (2, 4, 4))
        metrics = spec.train_folder / "metrics.jsonl"
        records = [json.loads(line) for line in metrics.read_text().splitlines()]
        for number, record in enumerate(r for r in records if r["kind"] == "update"):
            # Updates 0 and 1 are the first quarter of eight.
            record["rollout"]["success_by_task"] = {task: [number, 8], reset: [8 - number, 8 * seed]}
        metrics.write_text("".join(json.dumps(record) + "\n" for record in records))
    result = results(options, "table1")
    rows = {(row["quarter"], row["is_reset_task"]): row for row in tables.task_rows(result)}
    assert {row["row"] for row in rows.values()} == {"t1280_eer_cl_lsr"}
    assert [(rows[q, False]["successes"], rows[q, False]["n"]) for q in (1, 2, 3, 4)] == [
        (2, 32), (10, 32), (18, 32), (26, 32),
    ]  # fmt: skip
    assert (rows[1, True]["task"], rows[1, True]["successes"], rows[1, True]["n"]) == (reset, 30, 48)
    text = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    assert "| T = 1280, EER, CL, LSR | 0.06 | 0.31 | 0.56 | 0.81 |" in text
    assert "| T = 1280, EER, CL, LSR, reset tasks | 0.62 |" in text
    assert len(read_csv(tmp_path / "out/table1_tasks.csv")) == 8


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_is_drawn_and_without_runs_only_says_so(name, options, tmp_path):
    experiment = EXPERIMENTS[name]
    text = write_outputs(experiment, experiment.rows, options, tmp_path / "empty")
    assert "2 of 2 seeds not begun" in text
    assert not list((tmp_path / "empty").glob("*.png"))
    for row in experiment.rows[:2]:
        make_run(options, name, row.name, 1, (2, 4, 6))
    write_outputs(experiment, experiment.rows, options, tmp_path / "out")
    assert (tmp_path / f"out/{name}.png").exists()


def test_panels(options):
    for row in EXPERIMENTS["figure12"].rows[:2]:
        make_run(options, "figure12", row.name, 1, (2, 4, 6))
    figure = plots.curves_figure(results(options, "figure12"))
    # Two splits by two axes, four tasks; held-out has no points yet.
    assert len(figure.axes) == 16
    assert [len(ax.lines) for ax in figure.axes] == [2] * 8 + [0] * 8
    assert [ax.get_title(loc="left").split(",")[0] for ax in figure.axes[:4]] == INSTRUCTIONS
    figure = plots.curves_figure(results(options, "table1"))
    labels = list(plots.AXIS_LABELS.values())
    # T = 80 has eight times the interventions of the other row.
    assert [ax.get_xlabel() for ax in figure.axes] == [labels[0], f"{labels[1]} (log scale)"]
    assert [ax.get_xscale() for ax in figure.axes] == ["linear", "symlog"]


def test_rows_with_about_as_many_interventions_share_a_linear_axis(options):
    make_run(options, "table1", "t1280", 1, (2, 4, 6))
    make_run(options, "table1", "t1280_eer", 1, (2, 4, 6))
    figure = plots.curves_figure(results(options, "table1"))
    assert [ax.get_xscale() for ax in figure.axes] == ["linear", "linear"]


def test_report_only_from_the_command_line(options, tmp_path):
    small = replace(options, scale=SCALES["small"], seeds=(1, 2, 3))
    spec = next(s for s in run_specs(EXPERIMENTS["table1"], small) if s.row.name == "t80")
    write_training_run(spec.train_folder, interval=80, successes=(2, 4, 6))
    command = [sys.executable, "-m", "cronos_lerobot.scripts.reproduce", "table1", "--report_only"]
    command += [f"--root={options.root}", f"--output_dir={tmp_path / 'out'}"]
    done = run_forked(command)
    assert done.returncode == 0, done.stderr
    assert "t80_307k/seed1: 10,240 of 307,200 steps" in done.stdout
    assert Path(tmp_path / "out/table1.png").exists()


def edit_first_start(spec, **changes):
    """As if the run had begun with these entries of its manifest; a start that resumed it has others."""
    manifest = spec.train_folder / "manifest.json"
    first = json.loads(manifest.read_text())["starts"][0]
    manifest.write_text(json.dumps({"starts": [first | changes, first | {"policy_fingerprint": "checkpoint"}]}))


def test_clones_that_differ_are_said(options, tmp_path):
    """Runs of several machines make one table; their base policies may differ in the last bits."""
    experiment = EXPERIMENTS["figure4"]
    # Rows of one configuration begin with a base policy of their own.
    for row, seed, fingerprint in (("t80", 1, "aaaa"), ("t80_1config", 1, "cccc"), ("t80", 2, "bbbb")):
        edit_first_start(make_run(options, "figure4", row, seed, (2, 4, 5)), policy_fingerprint=fingerprint)
        page = write_outputs(experiment, experiment.rows, options, tmp_path / "out")
        assert ("Not one base policy" in page) == (fingerprint == "bbbb")
    name = "kitchen_2x2_state_400demos_320steps"
    assert f"## Not one base policy: 2 policies called {name}" in page
    assert "- aaaa: t80 seed 1\n- bbbb: t80 seed 2" in page
    bases = json.loads((tmp_path / "out/figure4.json").read_text())["bases"]
    assert bases == {name: ["aaaa", "bbbb"], f"{name}_1config": ["cccc"]}


def test_other_defaults_behind_one_command_are_said(options, tmp_path):
    experiment = EXPERIMENTS["table1"]
    for row, seed, size in (("t80", 1, 2048), ("t80", 2, 512), ("t1280", 1, 512)):
        spec = make_run(options, "table1", row, seed, (2, 4, 5))
        manifest = spec.train_folder / "manifest.json"
        text = manifest.read_text()
        assert text.count('{"type": "ppo"}') == 1
        manifest.write_text(text.replace('{"type": "ppo"}', f'{{"type": "ppo", "minibatch_size": {size}}}'))
        page = write_outputs(experiment, experiment.rows, options, tmp_path / "out")
        assert ("other settings by default" in page) == ((row, seed) != ("t80", 1))
    assert "- t80: minibatch_size 2048 (seed 1), 512 (seed 2)" in page
