"""Streams side by side: rates and shares counted by hand, from files as `stream_evaluation` writes them."""

import csv
import sys

import numpy as np
import pytest
from lerobot_env_cronos.statistics import wilson_interval
from synthetic_runs import read_csv, write_training_run

from cronos_lerobot.report.statistics import Rate, newcombe_interval
from cronos_lerobot.studies import streams_compared
from cronos_lerobot.studies.streams_compared import (
    Start,
    draw_streams,
    make_differences,
    make_parts,
    make_table,
    read_streams,
)

FIRST = {
    ("segment", "0"): (8, 10), ("segment", "1"): (2, 10), ("segment", "all"): (10, 20),
    ("start", "complete"): (4, 4), ("start", "free"): (6, 16),
}  # fmt: skip
SECOND = {
    ("segment", "0"): (10, 10), ("segment", "1"): (4, 10), ("segment", "all"): (14, 20),
    ("start", "lost"): (0, 2), ("start", "free"): (14, 18),
}  # fmt: skip


def write_streams(path, counts):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["table", "name", "successes", "n", "ci95_low", "ci95_high"])
        writer.writerows([*key, k, n, *wilson_interval(k, n)] for key, (k, n) in counts.items())
    return path


@pytest.fixture
def files(tmp_path):
    return write_streams(tmp_path / "1.csv", FIRST), write_streams(tmp_path / "2.csv", SECOND)


def test_rates_are_those_of_both_seeds_and_intervals_are_over_them(files):
    both = read_streams("both", files)
    first, second = both.by_segment()
    assert (first.value, second.value) == (0.9, 0.3)
    # .8 and 1.0: .9 +- 12.706 (t with one degree of freedom) standard errors of .1 is more than a rate can be.
    assert first.interval == (0.0, 1.0)
    assert read_streams("one", files[:1]).by_segment()[0].interval == wilson_interval(8, 10)


def test_a_start_that_one_seed_never_had_counts_in_the_shares_of_all(files):
    both = read_streams("both", files)
    assert both.share(Start.COMPLETE) == 4 / 40
    assert both.share(Start.LOST) == 2 / 40
    assert both.share(Start.FREE) == 34 / 40
    assert both.share(Start.RECEPTACLE_OCCUPIED) == 0
    assert both.rate("start", "free").value == 20 / 34
    assert both.rate("start", "lost").seeds == read_streams("two", files[1:]).rate("start", "lost").seeds


def test_the_table_has_rates_with_their_shares(files):
    line = make_table([read_streams("first", files[:1])]).splitlines()[2]
    low, high = wilson_interval(10, 20)
    assert line == (
        f"| first | 1 | 20 | 0.500 [{low:.3f}, {high:.3f}] "
        "| 0.38 (80% of them) | 0% of them | 0% of them | 0% of them | 20% of them |"
    )


def cells_of(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_parts_of_a_stream_and_what_was_done_in_it(files):
    parts = read_streams("a", files).parts()
    # Of two segments the first half has no others; 10 - 4 of 16 and 14 of 20 were not found complete.
    assert list(parts) == ["first segment", "second half", "all", "all but those found complete"]
    assert [(rate.successes, rate.n) for rate in parts.values()] == [(18, 20), (6, 20), (24, 40), (20, 36)]
    assert parts["all but those found complete"].seeds == (Rate(6, 16), Rate(14, 20))
    head, _, line = make_parts([read_streams("a", files[:1])]).splitlines()
    assert cells_of(head) == ["policy", *parts]
    assert cells_of(line)[:2] == ["a", "0.800 [{:.3f}, {:.3f}]".format(*wilson_interval(8, 10))]


def test_seeds_are_not_paired_in_differences(tmp_path, files):
    third = write_streams(tmp_path / "3.csv", FIRST | {("segment", "0"): (7, 10)})
    fourth = write_streams(tmp_path / "4.csv", SECOND | {("segment", "0"): (9, 10)})
    line = make_differences([read_streams("a", files), read_streams("b", (third, fourth))]).splitlines()[2]
    # First segment: .8 and 1.0 against .7 and .9, each .1 less; both intervals are 0 to 1, as two seeds' are.
    below, above = (0.8**2 + 0.1**2) ** 0.5, (0.2**2 + 0.9**2) ** 0.5
    assert cells_of(line)[:3] == ["b", "a", f"-0.100 [{-0.1 - below:+.3f}, {-0.1 + above:+.3f}]"]


def test_differences_from_one_seed_take_it_as_that_policy(files):
    line = make_differences([read_streams("a", files[:1]), read_streams("b", files[1:])]).splitlines()[2]
    low, high = newcombe_interval(Rate(8, 10), Rate(10, 10))
    assert cells_of(line)[2] == f"+0.200 [{low:+.3f}, {high:+.3f}]"


def test_the_command_writes_figure_and_numbers(files, tmp_path, monkeypatch):
    run = write_training_run(tmp_path / "run")
    monkeypatch.setattr(
        sys, "argv",
        ["streams_compared", "--streams", f"T = 80={files[0]},{files[1]}", f"base={files[0]}",
         "--runs", f"T = 80={run}", "--output", str(tmp_path / "out")],
    )  # fmt: skip
    streams_compared.main()
    rows = {(row["policy"], row["table"], row["name"]): row for row in read_csv(tmp_path / "out/streams.csv")}
    assert len(rows) == 6 + 5
    free = rows["T = 80", "start", "free"]
    assert (free["successes"], free["n"], free["seeds"]) == ("20", "34", "2")
    assert (tmp_path / "out/streams.png").stat().st_size > 10_000
    assert (tmp_path / "out/streams.md").read_text().startswith("| policy |")


def test_panels_show_what_the_files_say(files):
    figure = draw_streams([read_streams("both", files), read_streams("first", files[:1])], {})
    segments, shares, starts = figure.axes
    assert segments.lines[0].get_ydata().tolist() == [0.9, 0.3]
    widths = [[bar.get_width() for bar in container] for container in shares.containers]
    # Free, occupied, on the other, lost, complete; each of both names.
    shares_of_each = [[34 / 40, 16 / 20], [0, 0], [0, 0], [2 / 40, 0], [4 / 40, 4 / 20]]
    np.testing.assert_allclose(widths, shares_of_each, atol=1e-12)
    assert starts.lines[1].get_ydata() == [20 / 34]
    assert [list(line.get_ydata()) for line in segments.lines[1:3]] == [[0.8, 0.2], [1.0, 0.4]]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--streams", "nothing"], "'nothing' is not NAME=PATH"),
        (["--streams", "a={0}", "a={0}"], "names have to differ, got a, a"),
        (["--streams", "a={0}", "--runs", "b=run"], "no streams are named b; there are a"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(files, tmp_path, monkeypatch, capsys, arguments, said):
    words = [argument.format(files[0]) for argument in arguments]
    monkeypatch.setattr(sys, "argv", ["streams_compared", *words, "--output", str(tmp_path)])
    with pytest.raises(SystemExit):
        streams_compared.main()
    assert said in capsys.readouterr().err


def test_files_that_are_no_streams_or_not_as_long_are_refused(files, tmp_path):
    other = tmp_path / "other.csv"
    other.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="is no file of python -m"):
        read_streams("other", [other])
    longer = write_streams(tmp_path / "longer.csv", {**FIRST, ("segment", "2"): (1, 10)})
    with pytest.raises(ValueError, match="streams of different lengths"):
        read_streams("both", [files[0], longer])
