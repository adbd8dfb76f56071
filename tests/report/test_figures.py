"""Figures of a report: what is drawn, of whom."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from synthetic_runs import read_csv, write_training_run

from cronos_lerobot.report.figures import agent_figure, draw_curve, style_of, training_figure
from cronos_lerobot.report.page import write_report
from cronos_lerobot.report.png import to_png
from cronos_lerobot.report.runs import find_runs, group_runs
from cronos_lerobot.report.series import Curve, mean_curve, segment_spans
from cronos_lerobot.report.statistics import Rate
from cronos_lerobot.scripts.report import make_report


def test_more_rows_than_colours_are_told_apart():
    """With eight rows the first and the last were once of one blue."""
    ax = Figure().subplots()
    for i in range(28):
        draw_curve(ax, Curve(np.arange(2), *np.ones((3, 2)), False), i, str(i))
    assert len({(line.get_color(), line.get_linestyle()) for line in ax.lines}) == 28
    # few_resets has 42 rows, and matplotlib calls every line with dashes of one's own `--`.
    assert len({(color, line) for color, line, _ in map(style_of, range(56))}) == 56
    assert len({(color, hatch) for color, _, hatch in map(style_of, range(56))}) == 56
    draw_curve(ax, Curve(np.arange(2), *np.ones((3, 2)), False), 28, "28")
    assert ax.lines[28].is_dashed()


def test_a_label_is_no_formula(tmp_path):
    """Two dollars began and ended one, which this is not."""
    write_training_run(tmp_path / "run")
    (group,) = group_runs(find_runs([tmp_path / "run"]).training)
    group.label = "gain$x_$"
    figure = training_figure([group, group])
    assert figure is not None
    assert to_png(figure, 100)


@pytest.mark.parametrize("intervals", [(160,), (160, 320), (160, 320, 640)])
def test_groups_of_any_number_are_drawn(tmp_path, intervals):
    # Each with another agent, and so with other diagnostics.
    for interval, agent in zip(intervals, ("ppo", "imitation", "steering"), strict=False):
        write_training_run(tmp_path / f"runs/{interval}", interval=interval, agent=agent)
    page = write_report(make_report([tmp_path / "runs"]), tmp_path / "report").read_text()
    assert page.count("<img") == 5
    updates = read_csv(tmp_path / "report/updates.csv")
    assert [row.get("agent/frames") for row in updates[8:10]] == ["300.0", "600.0"][: len(updates) - 8]
    assert [row.get("agent/alpha") for row in updates[16:18]] == ["", "0.005"][: len(updates) - 16]


def test_every_agent_has_panels_of_its_own(tmp_path):
    for agent in ("imitation", "steering"):
        write_training_run(tmp_path / agent, agent=agent)
    figure = agent_figure(group_runs(find_runs([tmp_path]).training))
    # No panel is of both agents, and the legend names both.
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["type=imitation", "type=steering"]
    drawn = {ax.get_title(loc="left"): [line.get_ydata().tolist() for line in ax.lines] for ax in figure.axes}
    eighths = range(1, 9)
    assert drawn["successful segments remembered"] == [[10.0 * i for i in eighths]]
    assert drawn["failed segments remembered"] == [[5.0 * i for i in eighths]]
    # The first update had nothing to learn from.
    assert drawn["loss"] == [[1 / i for i in eighths][1:]]
    assert drawn["loss of the critics"] == [[0.1 / i for i in eighths][1:]]
    assert drawn["value of remembered decisions"] == [[0.05 * i for i in eighths][1:]]
    assert len(drawn["alpha, the price of the entropy"][0]) == 7
    assert "KL divergence per update [nats]" not in drawn


def test_run_without_evaluations_or_finished_updates(tmp_path):
    run = write_training_run(tmp_path / "run")
    lines = (run / "metrics.jsonl").read_text().splitlines()
    (run / "metrics.jsonl").write_text("\n".join(line for line in lines if '"update"' in line))
    page = write_report(make_report([run]), tmp_path / "no_evaluation").read_text()
    assert page.count("<img") == 4
    (run / "metrics.jsonl").write_text(lines[0])
    page = write_report(make_report([run]), tmp_path / "no_update").read_text()
    assert page.count("<img") == 1


def test_segments_are_one_by_one_and_then_in_spans_that_double():
    """T = 1280 has 16; of 40, 17 to 32 go together, and what there is of 33 to 64."""
    rates = {position: Rate(1, 2) for position in range(40)}
    spans = segment_spans(rates)
    assert list(spans) == [*((n, n) for n in range(1, 17)), (17, 32), (33, 64)]
    assert [(rate.successes, rate.n) for rate in spans.values()] == [(1, 2)] * 16 + [(16, 32), (8, 16)]
    assert list(segment_spans({16: Rate(0, 1), 31: Rate(1, 1), 32: Rate(1, 1), 64: Rate(0, 3)})) == [
        (17, 32), (33, 64), (65, 128),
    ]  # fmt: skip


def test_mean_curve_goes_straight_up_where_a_run_was_evaluated_twice_at_one_place():
    """As between two interventions: a base policy's success at 0 must not be lost to later evaluations there."""
    one = ([0, 0, 64, 64, 128], [0.5, 0.3, 0.5, 0.4, 0.4])
    other = ([0, 0, 64, 128], [0.7, 0.5, 0.7, 0.6])
    curve = mean_curve([one, other])
    assert curve.x.tolist() == [0, 0, 64, 64, 128]
    assert curve.y.tolist() == pytest.approx([0.6, 0.4, 0.6, 0.55, 0.5])
    # Of one curve alone it is the curve itself, and none is longer than the shortest.
    assert mean_curve([one, one]).y.tolist() == pytest.approx(one[1])
    assert mean_curve([one, ([0, 64], [1.0, 1.0])]).x.tolist() == [0, 0, 64, 64]
