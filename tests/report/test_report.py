"""The report's numbers are the runs' numbers, and the intervals those of the books."""

import base64
import json
import re
import sys

import pytest
from forked_commands import run_forked
from lerobot_env_cronos.scene.scenes import SCENES
from synthetic_runs import INSTRUCTIONS, read_csv, write_evaluation, write_training_run

from cronos_lerobot.report.comparisons import compare_training
from cronos_lerobot.report.page import write_report
from cronos_lerobot.report.protocol_names import describe_protocol
from cronos_lerobot.report.runs import find_runs, group_runs
from cronos_lerobot.report.series import evaluation_curve, segment_history, segment_rates
from cronos_lerobot.report.statistics import Rate
from cronos_lerobot.report.tables import comparison_text, merge_statistics, reset_rows, seed_rows, speed_rows
from cronos_lerobot.scripts.report import main, make_report


def test_runs_are_found_below_a_folder_once(tmp_path):
    run = write_training_run(tmp_path / "all/train/a")
    write_evaluation(tmp_path / "all/eval/held_out", "independent_held_out")
    found = find_runs([tmp_path / "all", run])
    evaluations = found.evaluations
    assert [r.name for r in found.training] == ["a"]
    assert [(e.suite, e.overall) for e in evaluations] == [("independent_held_out", Rate(10, 32))]
    assert evaluations[0].tasks[INSTRUCTIONS[3]] == Rate(4, 8)
    with pytest.raises(FileNotFoundError, match="nothing"):
        find_runs([tmp_path / "nothing"])


def test_the_episodes_of_a_sequential_suite_are_named_after_their_ordering(tmp_path):
    write_evaluation(tmp_path, "sequential_held_out")
    (evaluation,) = find_runs([tmp_path]).evaluations
    assert list(evaluation.tasks) == ["ordering 0", "ordering 1", "ordering 2", "ordering 3"]


def test_what_cannot_be_read_is_left_out_and_said(tmp_path, monkeypatch, capsys):
    write_training_run(tmp_path / "whole")
    write_training_run(tmp_path / "crashed")
    (tmp_path / "crashed/metrics.jsonl").write_text("")
    write_training_run(tmp_path / "cut")
    (tmp_path / "cut/manifest.json").write_text('{"starts": [')
    manifest = write_training_run(tmp_path / "v0") / "manifest.json"
    content = json.loads(manifest.read_text())
    del content["starts"][0]["environment"]
    manifest.write_text(json.dumps(content))
    write_evaluation(tmp_path / "eval")
    (tmp_path / "eval/eval_info.json").write_text("{}")
    (tmp_path / "old").mkdir()
    old = {"format": 1, "benchmark": {"environment": "lerobot_env_cronos/kitchen_2x2-v0"}, "sequential": {}}
    (tmp_path / "old/results.json").write_text(json.dumps(old))
    monkeypatch.setattr(sys, "argv", ["cronos-report", str(tmp_path), f"--output={tmp_path / 'out'}"])
    main()
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("left out: ")]
    page = (tmp_path / "out/index.html").read_text()
    words = (
        "crashed/metrics.jsonl has no record yet",
        "cut/manifest.json is damaged",
        "eval_info.json is damaged",
    )
    for what in (*words, "kitchen_2x2-v0; this is version 1"):
        assert [what in line for line in said].count(True) == 1, what
        assert what in page
    assert len(said) == 5
    # Where nothing is left there is no report.
    with pytest.raises(ValueError, match="has no record yet"):
        find_runs([tmp_path / "crashed"])


def write_seeds(folder, policy=None, fingerprints=(None, None)):
    """Two seeds that go from 2 of 8 successes in each task to 5 and 7."""
    for seed, last, fingerprint in ((1, 5, fingerprints[0]), (2, 7, fingerprints[1])):
        manifest = write_training_run(folder / str(seed), seed=seed, successes=(2, 4, last)) / "manifest.json"
        content = json.loads(manifest.read_text())
        content["starts"][0]["config"]["policy"] = {"pretrained_path": policy}
        content["starts"][0]["policy_fingerprint"] = fingerprint
        manifest.write_text(json.dumps(content))
    (comparison,) = compare_training(group_runs(find_runs([folder]).training))
    return comparison.overall


def test_one_base_evaluation_counts_once_however_many_seeds_begin_with_it(tmp_path):
    gain = write_seeds(tmp_path, policy="base/clone")
    assert (gain.before.successes, gain.before.n, gain.after.n, gain.value) == (8, 32, 64, 0.5)
    # Seeds .625 and .875: t with one degree of freedom is 12.706, the standard error 1 / 8: wider than a rate is.
    assert gain.after.interval == (0.0, 1.0)
    # Wilson's interval of 8 in 32 is [.1325, .4211]; in quadrature as Newcombe has it.
    low, high = 0.5 - (0.75**2 + 0.1711**2) ** 0.5, 0.5 + (0.25**2 + 0.1175**2) ** 0.5
    assert gain.interval == (pytest.approx(low, abs=1e-3), pytest.approx(high, abs=1e-3))


def test_clones_of_two_machines_count_each_whatever_their_path(tmp_path):
    assert write_seeds(tmp_path / "one", "base/clone", ("a", "a")).before.n == 32
    assert write_seeds(tmp_path / "two", "base/clone", ("a", "b")).before.n == 64


def test_seeds_from_scratch_have_a_start_each_and_their_gains_an_interval(tmp_path):
    gain = write_seeds(tmp_path)
    assert (gain.before.n, gain.value) == (64, 0.5)
    # Gains .375 and .625: 0.5 +- 12.706 / 8 is more than a gain can be.
    assert gain.interval == (-1.0, 1.0)


def test_unfinished_last_line_is_skipped(tmp_path):
    run = write_training_run(tmp_path / "a")
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "upd')
    (read,) = find_runs([run]).training
    assert (len(read.updates), len(read.evaluations)) == (8, 3)


def test_groups_differ_in_more_than_the_seed_and_are_called_so(tmp_path):
    for interval in (160, 320):
        for seed in (0, 1):
            write_training_run(tmp_path / f"{interval}_{seed}", seed=seed, interval=interval)
    groups = group_runs(find_runs([tmp_path]).training)
    assert [group.label for group in groups] == ["T = 160", "T = 320"]
    assert [[run.seed for run in group.runs] for group in groups] == [[0, 1], [0, 1]]
    text = comparison_text(compare_training(groups))
    assert all(f"{group.label}: periodic evaluation, train" in text for group in groups)


def test_curve_of_seeds_is_their_mean_and_standard_deviation(tmp_path):
    write_training_run(tmp_path / "a", seed=0, successes=(2, 4, 6))
    write_training_run(tmp_path / "b", seed=1, successes=(2, 2, 2))
    (group,) = group_runs(find_runs([tmp_path]).training)
    curve = evaluation_curve(group, "interaction_steps")
    assert curve.x.tolist() == [0, 5120, 10240]
    assert curve.y.tolist() == [0.25, 0.375, 0.5]
    # Sample standard deviation of two numbers is their distance over sqrt(2).
    assert (curve.high - curve.y).tolist() == pytest.approx([0, 0.25 / 2**0.5, 0.5 / 2**0.5])
    against_resets = evaluation_curve(group, "interventions")
    assert against_resets.x.tolist() == [0, 16, 32]


def test_curve_of_one_run_has_its_wilson_interval(tmp_path):
    write_training_run(tmp_path / "a", successes=(2, 4, 6))
    (group,) = group_runs(find_runs([tmp_path]).training)
    curve = evaluation_curve(group, "interaction_steps")
    assert curve.low.tolist() == pytest.approx([Rate(8 * k, 32).interval[0] for k in (1, 2, 3)])
    assert not curve.is_band_over_seeds


def test_success_by_segment_of_the_last_part_and_over_the_run(tmp_path):
    run = write_training_run(tmp_path / "a", interval=320, updates=8)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    updates = [line["rollout"]["success_by_segment"] for line in lines if line["kind"] == "update"]
    (group,) = group_runs(find_runs([run]).training)
    # The last quarter of 8 updates is 2, one whole cycle of 320 steps.
    expected = {int(k): Rate(*v) for update in updates[-2:] for k, v in update.items()}
    assert {key: Rate(rate.successes, rate.n) for key, rate in segment_rates(group).items()} == expected
    assert sorted(expected) == [0, 1, 2, 3]
    edges, rates = segment_history(group)
    assert (edges[-1], rates.shape) == (10240, (4, 4))
    assert rates[2, 1] == updates[3]["2"][0] / updates[3]["2"][1]


def test_speed_weighs_updates_by_their_time(tmp_path):
    run = write_training_run(tmp_path / "a")
    (row,) = speed_rows(group_runs(find_runs([run]).training))
    # As many steps at 500/s as at 1000/s: the harmonic mean.
    assert row["steps_per_s"] == pytest.approx(2000 / 3)
    assert row["env share"] == pytest.approx(0.5)


def test_resets_that_values_asked_for_are_told_by_age(tmp_path):
    run = write_training_run(tmp_path / "a")
    assert reset_rows(group_runs(find_runs([run]).training)) == []
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    resets = [{"interaction_steps": 9, "stream": i, "segments": k, "value": v}
              for i, (k, v) in enumerate([(3, 0.1), (2, 0.2), (3, 0.3)])]  # fmt: skip
    lines[1]["critic"], lines[3]["critic"] = {"resets": resets[:2]}, {"resets": resets[2:]}
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    report = make_report([run])
    rows = reset_rows(group_runs(report.training))
    assert [(row["segments"], row["resets"], row["mean best value"]) for row in rows] == [
        (2, 1, 0.2),
        (3, 2, pytest.approx(0.2)),
    ]
    write_report(report, tmp_path / "report")
    assert "Resets that values asked for" in (tmp_path / "report/index.html").read_text()


@pytest.fixture
def report_folder(tmp_path):
    """A report of a training run and evaluations before and after, with its inputs."""
    write_training_run(tmp_path / "run", successes=(2, 3, 5))
    write_evaluation(tmp_path / "before", successes=(1, 2, 3, 4), video=b"old video")
    write_evaluation(tmp_path / "after", successes=(8, 6, 7, 5), video=b"new video")
    report = make_report([tmp_path / "run"], before=[tmp_path / "before"], after=[tmp_path / "after"])
    write_report(report, tmp_path / "report")
    return tmp_path / "report", report


def test_page_shows_the_inputs_numbers(report_folder):
    folder, _ = report_folder
    page = (folder / "index.html").read_text()
    # lerobot-eval: 10/32 -> 26/32; the training's own evaluation: 8/32 -> 20/32.
    assert "31.2 &rarr; 81.2 %" in page
    assert "n = 32, 32" in page
    cells = re.findall(r"<td>(.*?)</td>", page)
    row = cells[cells.index(INSTRUCTIONS[0]) :][:9]
    assert (row[1], row[3], row[4], row[6], row[7]) == ("0.125", "8", "1.000", "8", "+0.875")
    assert "scene reset" in page
    assert "&#34;mujoco&#34;: &#34;4.0.0&#34;" in page


def test_page_is_self_contained(report_folder):
    folder, _ = report_folder
    page = (folder / "index.html").read_text()
    sources = re.findall(r'(?:src|href)="(.*?)"', page)
    assert len(sources) == 5 + 8
    assert all(source.startswith("data:") for source in sources)
    videos = [base64.b64decode(s.split(",")[1]) for s in sources if s.startswith("data:video")]
    assert videos == [b"old video", b"new video"] * 4
    for name in ("evaluation", "training", "segments", "segment_history", "agent"):
        content = base64.b64encode((folder / f"{name}.png").read_bytes()).decode()
        assert f"data:image/png;base64,{content}" in page


def test_csv_files_hold_every_number(report_folder):
    folder, _ = report_folder
    gains = {(row["suite"], row["task"]): row for row in read_csv(folder / "gains.csv")}
    overall = gains["independent_train", "all tasks"]
    assert (overall["before_successes"], overall["after_successes"], overall["gain"]) == ("10", "26", "0.5")
    assert len(read_csv(folder / "evaluations.csv")) == 3 * 5
    updates = read_csv(folder / "updates.csv")
    assert [float(row["agent/approx_kl"]) for row in updates] == [0.01 * i for i in range(1, 9)]
    assert updates[0]["agent/explained_variance"] == ""
    assert sum(int(row["n"]) for row in read_csv(folder / "segments.csv")) == 8 * 16
    (interventions,) = read_csv(folder / "interventions.csv")
    assert (interventions["scene_reset"], interventions["initial"]) == ("32", "8")


def test_seeds_together_end_where_all_have_been(tmp_path):
    write_training_run(tmp_path / "a", seed=0, interval=160, successes=(2, 4, 6))
    write_training_run(tmp_path / "b", seed=1, interval=160, successes=(2, 6, 8))
    # The second run is killed half way.
    lines = (tmp_path / "b/metrics.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "b/metrics.jsonl").write_text("".join(lines[:6]))
    (row,) = seed_rows(group_runs(find_runs([tmp_path]).training))
    assert (row["seeds"], row["interaction_steps"], row["interventions"]) == (2, 5120, 32)
    # Two seeds, .5 and .75: .625 +- 12.706 / 8 (t with one degree of freedom) is more than a rate can be.
    assert row["success"] == 0.625
    assert (row["success ci95_low"], row["success ci95_high"]) == (0.0, 1.0)
    # Of the first run only what its later evaluation found is known, where the second has none.
    assert row["found_complete"] is None
    # Gaps .75 to .5 and .75 to .25: on average .625 and .5, over steps and over resets alike.
    assert row["D / steps"] == pytest.approx((0.625 + 0.5) / 2)
    assert row["C / interventions"] == pytest.approx(row["D / steps"])
    assert row["D / steps std"] == pytest.approx(0.125 / 2**0.5)
    (merged,) = merge_statistics([row])
    assert merged["success"] == "0.625 ± 0.18 [0, 1]"
    assert "success std" not in merged


def test_many_differences_of_the_protocol_are_put_as_the_paper_does(tmp_path):
    for name, interval, changes in (
        ("a", 160, {}),
        ("b", 320, {"end_effector_reset": True, "curriculum": [[640, 160]], "heuristic_reset": True}),
        ("c", 320, {"end_effector_reset": True, "task_order": "random", "num_configurations": 1}),
    ):
        manifest = write_training_run(tmp_path / name, interval=interval) / "manifest.json"
        content = json.loads(manifest.read_text())
        content["starts"][0]["config"]["protocol"] |= changes
        manifest.write_text(json.dumps(content))
    labels = [group.label for group in group_runs(find_runs([tmp_path]).training)]
    assert labels == ["T = 160", "T = 320, EER, CL, HSR", "T = 320, EER, random order, 1 configuration(s)"]


@pytest.mark.parametrize(
    ("protocol", "name"),
    [
        # The paper's T = 80 resets the arm with the scene; with a curriculum it does not at first.
        ({"scene_reset_interval": 80, "task_switch_interval": 80, "end_effector_reset": True}, "T = 80"),
        (
            {"scene_reset_interval": 80, "task_switch_interval": 80, "end_effector_reset": True,
             "curriculum": [[640, 80]]},
            "T = 80, EER, CL",
        ),
        (
            {"scene_reset_interval": 1280, "task_switch_interval": 80, "learned_reset": True,
             "end_effector_reset": True, "extra_resets": ["shelf"]},
            "T = 1280, EER, LSR, shelf",
        ),
        ({"scene_reset_interval": None, "task_switch_interval": 80}, "no scene resets"),
        (
            {"scene_reset_interval": 1280, "task_switch_interval": 80, "end_effector_reset": True,
             "reset_phase": "staggered", "reset_starts": "learnable", "task_order": "critic"},
            "T = 1280, staggered, learnable starts, EER, critic order",
        ),
        (
            {"scene_reset_interval": 80, "task_switch_interval": 80, "end_effector_reset": True,
             "scene_reset": "critic", "reset_budget": 254},
            "254 resets asked for by the critic, EER",
        ),
        (
            {"scene_reset_interval": 1280, "task_switch_interval": 80, "reset_budget": 300, "takeover_after": 2,
             "takeover_price": 3, "takeover_budget": 90},
            "T = 1280, takeovers after 2 at 3 each, at most 90 for takeovers, at most 300 interventions",
        ),
    ],
)  # fmt: skip
def test_a_protocol_is_called_as_in_table_1(protocol, name):
    assert describe_protocol(protocol) == name


def test_tasks_of_lerobot_eval_are_those_of_the_scene(tmp_path):
    write_evaluation(tmp_path / "e")
    (evaluation,) = make_report([tmp_path / "e"], scene="playroom_2x2").evaluations
    assert list(evaluation.successes) == [task.instruction for task in SCENES["playroom_2x2"].tasks]


def test_terminal_table_has_n_and_intervals(report_folder):
    _, report = report_folder
    lines = comparison_text(report.comparisons).splitlines()
    assert lines[0].split() == ["before", "after", "gain"]
    total = next(line for line in lines if "all tasks" in line)
    assert "0.312 [0.180, 0.486] n=32" in total
    assert "+0.500 [+0.260, +0.666]" in total


def test_large_videos_are_linked(tmp_path, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.report.clips.MAX_CLIP_BYTES", 4)
    write_evaluation(tmp_path / "eval #1", video=b"large")
    page = write_report(make_report([tmp_path / "eval #1"]), tmp_path / "report").read_text()
    # A browser takes what follows a bare # for a place on the page.
    assert 'href="../eval%20%231/videos/independent_train_0/eval_episode_0.mp4"' in page
    assert "data:video" not in page


def test_an_output_that_cannot_be_written_is_told_in_a_line(tmp_path, monkeypatch, capsys):
    run = write_training_run(tmp_path / "run")
    (file := tmp_path / "page").touch()
    monkeypatch.setattr(sys, "argv", ["cronos-report", str(run), f"--output={file}"])
    with monkeypatch.context() as patch:
        # Refused before anything is read.
        patch.setattr("cronos_lerobot.scripts.report.make_report", None)
        with pytest.raises(SystemExit, match="2"):
            main()
    said = f"error: --output={file} is a file; name a folder, new or of another report\n"
    assert capsys.readouterr().err.endswith(said)
    monkeypatch.setattr(sys, "argv", ["cronos-report", str(run), f"--output={file / 'below'}"])
    with pytest.raises(SystemExit, match=r"^error: the report was not written: .*Not a directory: "):
        main()


def test_command_line(tmp_path):
    write_training_run(tmp_path / "run")
    command = [sys.executable, "-m", "cronos_lerobot.scripts.report", str(tmp_path / "run")]
    done = run_forked([*command, f"--output={tmp_path / 'out'}"], check=True)
    assert f"Report: {tmp_path / 'out' / 'index.html'}" in done.stdout
    wrong = run_forked([*command[:-1], tmp_path / "no"])
    assert wrong.returncode != 0
    assert "metrics.jsonl" in wrong.stderr
