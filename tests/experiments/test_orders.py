"""Which of the paper's sentences about two rows hold: by hand, and in what an experiment writes."""

import json

import pytest
from experiment_runs import make_run, results
from synthetic_evaluations import write_evaluation

from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.differences import RowDifference
from cronos_lerobot.experiments.jobs import made_by, write_record
from cronos_lerobot.experiments.orders import MARGIN, Order, paper_orders
from cronos_lerobot.experiments.outputs import write_outputs
from cronos_lerobot.experiments.plan import checkpoint_evaluations
from cronos_lerobot.experiments.results import paper_results
from cronos_lerobot.report.paired import Difference


def order(says, value, ends, p):
    difference = Difference(value, ends, p, "by hand", needed=None, detectable=None)
    found = RowDifference(None, None, difference, seeds=(3, 3), episodes=256) if ends else None
    return Order("one", "other", says, "Section 0", found=found)


@pytest.mark.parametrize(
    ("says", "value", "ends", "p", "holds"),
    [
        ("higher", 0.2, (0.1, 0.3), 0.01, "yes"),
        ("higher", -0.2, (-0.3, -0.1), 0.01, "no"),
        ("lower", -0.2, (-0.3, -0.1), 0.01, "yes"),
        ("lower", 0.2, (0.1, 0.3), 0.01, "no"),
        ("higher", 0.2, (-0.1, 0.5), 0.2, "not separated"),
        # Alike: as near as the margin, whatever p says; further apart is no only if it is certain.
        ("alike", 0.02, (0.01, 0.03), 0.01, "yes"),
        ("alike", 0.03, (0.01, 0.06), 0.01, "undecided"),
        ("alike", -0.1, (-0.2, -0.04), 0.01, "undecided"),
        ("alike", -0.2, (-0.3, -0.1), 0.01, "no"),
        ("alike", 0.02, (-MARGIN, MARGIN), 0.5, "yes"),
        ("alike", 0.2, (0.1, 0.3), 0.01, "no"),
        ("alike", 0.02, (-0.06, 0.1), 0.5, "not separated"),
        ("higher", 0.0, None, None, "not run"),
    ],
)
def test_the_word_is_that_of_the_interval(says, value, ends, p, holds):
    assert order(says, value, ends, p).holds == holds


def test_sentences_name_rows_that_the_experiments_have():
    said = paper_results()["orders"]
    for name, orders in said.items():
        if name.startswith("_"):
            continue
        rows = {row.name for row in EXPERIMENTS[name].rows}
        for told in orders:
            one = Order(**told)
            assert {one.row, one.reference} <= rows
            assert one.says in ("higher", "lower", "alike")


def test_an_experiment_says_which_sentences_hold(options, tmp_path):
    make_run(options, "table1", "t80", 1, (2, 4, 7))
    make_run(options, "table1", "t1280", 1, (2, 2, 1))
    make_run(options, "table1", "t1280_eer", 1, (2, 2, 1))
    found = {(one.row, one.reference): one for one in paper_orders(results(options, "table1"))}
    assert found["t1280", "t80"].holds == "yes"
    assert found["t1280", "t80"].found.difference.value == -0.75
    assert found["t1280_eer", "t1280"].holds == "not separated"
    assert found["t1280_eer_cl", "t1280_eer"].holds == "not run"
    page = write_outputs(EXPERIMENTS["table1"], EXPERIMENTS["table1"].rows, options, tmp_path / "out")
    (line,) = [line for line in page.splitlines() if line.startswith("| t1280 is below t80 |")]
    assert line.split(" | ")[3] == "-0.750"
    assert line.endswith("| these policies | yes |")
    summary = json.loads((tmp_path / "out/table1.json").read_text())
    told = {(one["row"], one["reference"]): one for one in summary["orders"]}
    assert (told["t1280", "t80"]["difference"], told["t1280", "t80"]["holds"]) == (-0.75, "yes")
    assert told["t1280_eer_cl", "t1280_eer"]["holds"] == "not run"
    # Each of the three took half an hour.
    assert summary["hours"] == 1.5


@pytest.mark.parametrize(("before", "holds"), [((8, 8), "not applicable"), ((8, 6), "not separated")])
def test_of_rows_whose_bases_leave_nothing_to_learn_nothing_is_said(options, tmp_path, before, holds):
    """Of eight episodes; one base that may still learn is enough."""
    for row, start in zip(("t80_1config", "t320_eer_1config"), before, strict=True):
        make_run(options, "figure4", row, 1, (start, 8, 8))
    (one, *_) = paper_orders(results(options, "figure4"))
    assert one.holds == holds
    page = write_outputs(EXPERIMENTS["figure4"], EXPERIMENTS["figure4"].rows, options, tmp_path / "out")
    reason = ": the base policy does 1.000 from the start" if holds == "not applicable" else ""
    assert f"| {holds}{reason} |" in page


def evaluate(spec, lengths):
    """What `cronos-eval` would have found at the end of a run of figure 5: held-out chains of one ordering."""
    rates = [{"success": sum(n > i for n in lengths) / len(lengths)} for i in range(4)]
    found = {"positions": rates, "average_chain_length": {"mean": sum(lengths) / len(lengths)}, "n": len(lengths)}
    for evaluation in EXPERIMENTS["figure5"].evaluations:
        for job, _ in checkpoint_evaluations(spec, evaluation):
            if "held_out" in job.name:
                results = write_evaluation(job.output, spec.row.name, chains=[lengths]) / "results.json"
                results.write_text(
                    json.dumps(json.loads(results.read_text()) | {"sequential": {"held_out": found}})
                )
                record = {"command": list(job.command), "status": "done", "seconds": 1.0, "starts": 1}
                write_record(job, record | {"made_by": made_by(job)})
                return job


def test_chains_are_compared_by_their_length(options, tmp_path):
    short = make_run(options, "figure5", "t80", 1, (2, 4, 6))
    long = make_run(options, "figure5", "t320_eer", 1, (2, 4, 6))
    evaluate(short, [0, 1, 0, 1, 0, 1, 0, 1])
    job = evaluate(long, [3, 4, 3, 4, 3, 4, 3, 4])
    by_split = {one.split: one for one in paper_orders(results(options, "figure5"))}
    assert by_split["train"].holds == "not run"
    assert (by_split["held_out"].holds, by_split["held_out"].found.difference.value) == ("yes", 3.0)
    page = write_outputs(EXPERIMENTS["figure5"], EXPERIMENTS["figure5"].rows, options, tmp_path / "out")
    assert "| sequential, held-out | +3.000 tasks |" in page
    # What the report leaves out is no evidence either.
    job.record.write_text(job.record.read_text().replace("--eval.suites=sequential", "--eval.suites=another"))
    result = results(options, "figure5")
    assert any(job.name in text for text in result.changed)
    assert {one.holds for one in paper_orders(result)} == {"not run"}
