"""`cronos-report compare`: folders of evaluations and runs, paired episode by episode."""

import json
import os
import re
import shutil
import sys

import pytest
from synthetic_evaluations import write_compared_run as write_run
from synthetic_evaluations import write_evaluation
from synthetic_runs import INSTRUCTIONS

from cronos_lerobot.scripts import report


def compare(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-report", "compare", *map(str, arguments)])
    report.main()


def compared(monkeypatch, capsys, *arguments):
    compare(monkeypatch, *arguments, "--json")
    return json.loads(capsys.readouterr().out)


def test_two_policies_task_by_task(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1100000000", "0000000000"])
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["1011111111", "0000000000"])
    (suite,) = compared(monkeypatch, capsys, a, b)["comparisons"]
    assert (suite["suite"], suite["split"], suite["seeds"]) == ("independent", "held_out", [1000])
    assert (suite["a"], suite["b"], suite["left_out"], suite["differs"]) == (["me/a"], ["me/b"], 0, [])
    overall, one, other = suite["rows"]
    assert [row["what"] for row in suite["rows"]] == ["all tasks", *INSTRUCTIONS[:2]]
    assert (overall["pairs"], overall["configurations"], overall["a"], overall["b"]) == (20, 10, 0.1, 0.45)
    assert (overall["only_a"], overall["only_b"], overall["trainings"]) == (1, 8, None)
    # By configuration as by episode: 8 of 9 that differ, 2 (1 + 9) / 2^9.
    assert overall["policies"]["p"] == one["policies"]["p"] == 20 / 512
    assert (one["p_holm"], other["policies"]["p"], other["p_holm"]) == (40 / 512, 1, 1)
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "independent held_out: 20 pairs of episodes from 10 configurations, sampling seed 1000" in text
    assert "B is better, of these policies (p = 0.039 < 0.05)." in text
    assert "One training each: this says nothing of how they were trained." in text
    compare(monkeypatch, b, a)
    assert "A is better, of these policies (p = 0.039 < 0.05)." in capsys.readouterr().out


def test_a_decision_would_need_more_episodes(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1100000000", "0000000000"])
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["1011000000", "0000000000"])
    row = compared(monkeypatch, capsys, a, b)["comparisons"][0]["rows"][0]
    assert row["policies"]["p"] == 1
    # Means of two episodes: -.5, .5, .5 and seven 0, mean .05, standard deviation .2838. (1.976 + .844) .2838 /
    # sqrt(n) <= .05 at n = 255: 245 more configurations of two episodes.
    assert row["policies"]["needed"] == 255
    assert row["more_episodes"] == 490
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "Not separated, of these policies (p = 1): this is no sign that they do alike." in text
    assert "One of 0.050 takes about 490 more episodes of each policy, from 255 configurations in all." in text


def test_episodes_of_one_configuration_are_counted_by_repetition(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["11000000"])
    b = write_run(tmp_path / "b", 1, ["10110000"])
    for folder in (a, b):
        lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        for line in lines:
            line["episodes"] = [[seed + c, number, 0, x] for seed, number, c, x in line["episodes"]]
        (folder / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (suite,) = compared(monkeypatch, capsys, a, b)["comparisons"]
    assert (suite["rows"][0]["configurations"], suite["rows"][0]["units"]) == (
        8,
        "repetitions of one configuration",
    )
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "8 pairs of episodes from 8 repetitions of one configuration, sampling seed 1000, 1001" in text
    assert re.search(r"takes about \d+ more episodes of each policy, from \d+ repetitions of one config", text)


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_a_comparison_into_a_closed_pipe_ends_without_a_traceback(more, tmp_path, monkeypatch):
    a, b = (write_evaluation(tmp_path / name, f"me/{name}", tasks=["01010101"]) for name in "ab")
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        with pytest.raises(SystemExit) as ended:
            compare(monkeypatch, a, b, *more)
    assert ended.value.code == 1


def test_from_five_configurations_nothing_can_be_decided(tmp_path, monkeypatch, capsys):
    """B is better from all five: 2 of 2^5 ways are as far from even, p = .0625; six would give 2 of 2^6, .031."""
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["00000"])
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["11111"])
    policies = compared(monkeypatch, capsys, a, b)["comparisons"][0]["rows"][0]["policies"]
    assert (policies["p"], policies["detectable"]) == (2 / 32, None)
    c = write_evaluation(tmp_path / "c", "me/c", tasks=["11101"])
    row = compared(monkeypatch, capsys, a, c)["comparisons"][0]["rows"][0]
    assert (row["policies"]["needed"], row["more_episodes"]) == (6, 1)


def test_chains_are_paired_by_ordering_and_configuration(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", chains=[[0, 1, 2], [0, 1, 4]])
    b = write_evaluation(tmp_path / "b", "me/b", chains=[[1, 1, 4], [2, 2, 4]])
    rows = compared(monkeypatch, capsys, a, b)["comparisons"][0]["rows"]
    assert [row["what"] for row in rows] == ["chain length", "SEQ 0", "SEQ 1", "SEQ 2", "SEQ 3"]
    length = rows[0]
    assert (length["a"], length["b"], length["only_a"]) == (8 / 6, 14 / 6, None)
    # Sums of the differences by configuration: 1 + 2, 0 + 1, 2 + 0; all of one sign, 2 of 8 ways.
    assert length["policies"]["value"] == 1
    assert length["policies"]["p"] == 2 / 8
    # SEQ 2 is success of the third task: only B's first chain of the last configuration is new.
    assert (rows[3]["a"], rows[3]["b"], rows[3]["only_b"]) == (pytest.approx(1 / 6), pytest.approx(2 / 6), 1)


def test_trainings_of_several_seeds(tmp_path, monkeypatch, capsys):
    path = "runs/{}/seed{}/train/checkpoints/{}/pretrained_model"
    for side, per_seed in (("a", ("1000", "0010", "0100")), ("b", ("1110", "1011", "1111"))):
        for seed, line in enumerate(per_seed):
            policy = path.format(side, seed, "0010240")
            write_evaluation(tmp_path / side / f"seed{seed}/eval/x", policy, tasks=[line])
    # An earlier checkpoint of one of them is not another training.
    write_evaluation(tmp_path / "b/seed0/eval/w", path.format("b", 0, "0005120"), tasks=["0000"])
    (suite,) = compared(monkeypatch, capsys, tmp_path / "a", tmp_path / "b")["comparisons"]
    (row, _) = suite["rows"]
    assert suite["b"] == ["b/seed0 0010240", "b/seed1 0010240", "b/seed2 0010240"]
    assert (row["a"], row["b"]) == (pytest.approx(0.25), pytest.approx(10 / 12))
    # Configurations: 3 of B against 1, 1, 1, 0 of A: sums 2, 1, 2, 2 of three, all of one sign: 2 of 16 ways.
    assert row["policies"]["p"] == 2 / 16
    assert "3 against 3 trainings" in row["trainings"]["method"]
    assert row["trainings"]["value"] == pytest.approx(7 / 12)
    compare(monkeypatch, *sorted(tmp_path.glob("a/seed*")), "--with", *sorted(tmp_path.glob("b/seed*")))
    text = capsys.readouterr().out
    assert re.search(r"trainings like these +\+0\.583 \[", text)
    assert "B is better, of trainings like these" in text
    assert "One training each" not in text


def test_run_folders_have_their_last_evaluation(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for seed, tasks in ((1, ["1110", "0001"]), (2, ["1111", "0000"])):
        write_run(tmp_path / f"b/seed{seed}", seed, tasks)
    (suite,) = compared(monkeypatch, capsys, a, tmp_path / "b")["comparisons"]
    assert (suite["suite"], suite["split"], suite["rows"][0]["pairs"]) == ("independent", "train", 8)
    assert (suite["rows"][0]["a"], suite["rows"][0]["b"]) == (0.125, 0.5)
    assert suite["b"] == ["seed1 0010240", "seed2 0010240"]
    write_run(tmp_path / "b/other", 1, ["1111", "0000"], scene_reset_interval=1280)
    with pytest.raises(SystemExit, match=r"runs of 2 experiments, not seeds of one: .*1280"):
        compare(monkeypatch, a, tmp_path / "b")


def test_runs_of_one_name_below_several_roots_are_told_apart(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    runs = [
        write_run(tmp_path / root / "t80/seed1/train", seed, ["1110", "0001"])
        for seed, root in ((1, "x"), (2, "y"))
    ]
    (suite,) = compared(monkeypatch, capsys, a, "--with", *runs)["comparisons"]
    assert suite["b"] == ["t80/seed1 0010240 (x)", "t80/seed1 0010240 (y)"]
    assert suite["a"] == ["a 0010240"]


def test_several_trainings_against_one_policy_speak_of_the_several(tmp_path, monkeypatch, capsys):
    write_run(tmp_path / "a", 1, ["10001000"])
    for seed, tasks in ((1, ["11101110"]), (2, ["11111111"]), (3, ["11110111"])):
        write_run(tmp_path / f"b/seed{seed}", seed, tasks)
    compare(monkeypatch, tmp_path / "a", tmp_path / "b")
    text = capsys.readouterr().out
    assert re.search(r"trainings like those of B +\+0\.625 \[", text)
    assert "B is better, of trainings like those of B against this one policy of A" in text
    assert "Of other trainings of the single policy this says nothing." in text
    compare(monkeypatch, tmp_path / "b", tmp_path / "a")
    text = capsys.readouterr().out
    assert "A is better, of trainings like those of A against this one policy of B" in text


def test_a_run_that_did_not_come_as_far_is_left_out(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for seed, steps in ((1, 10240), (2, 5120), (3, 10240)):
        write_run(tmp_path / f"b/seed{seed}", seed, ["1111", "0000"], steps=steps)
    found = compared(monkeypatch, capsys, a, tmp_path / "b")
    assert found["comparisons"][0]["b"] == ["seed1 0010240", "seed3 0010240"]
    (note,) = found["left_out"]
    assert note.endswith("b/seed2: the last is after 5,120 steps, another's after 10,240")
    # Runs that their budget ended are at their end.
    for seed, steps in ((1, 10240), (2, 5120)):
        write_run(tmp_path / f"c/seed{seed}", seed, ["1111", "0000"], steps=steps, reset_budget=0)
    found = compared(monkeypatch, capsys, a, tmp_path / "c")
    assert (len(found["comparisons"][0]["b"]), found["left_out"]) == (2, [])


def test_of_two_runs_of_one_seed_the_shorter_is_said(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for name, steps in (("short", 5120), ("long", 10240)):
        write_run(tmp_path / "b" / name, 1, ["1111", "0000"], steps=steps)
    found = compared(monkeypatch, capsys, a, tmp_path / "b")
    assert found["comparisons"][0]["b"] == ["long 0010240"]
    (note,) = found["left_out"]
    assert "b/short, of 5,120 steps: " in note
    assert note.endswith("b/long is of the same settings and seed and has 10,240")


def test_runs_without_a_cronos_eval_are_not_dropped_for_those_that_have_one(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for seed in (1, 2):
        write_run(tmp_path / f"b/seed{seed}/train", seed, ["1110", "0001"])
    of_one = {"policy": "b/seed1/train/checkpoints/last/pretrained_model", "tasks": ["1111", "1111"]}
    write_evaluation(tmp_path / "b/seed1/eval", **of_one, split="train")
    (suite,) = compared(monkeypatch, capsys, a, tmp_path / "b")["comparisons"]
    assert (len(suite["b"]), suite["rows"][0]["b"]) == (2, 0.5)
    assert suite["passed_over"] == [
        "B: cronos-eval has been run of 1 of 2 policies: all have their runs' own evaluations here"
    ]
    compare(monkeypatch, a, tmp_path / "b")
    assert "passed over: B: cronos-eval has been run of 1 of 2 policies" in capsys.readouterr().out
    of_other = {"policy": "b/seed2/train/checkpoints/last/pretrained_model", "tasks": ["1111", "0000"]}
    write_evaluation(tmp_path / "b/seed2/eval", **of_other, split="train")
    (suite,) = compared(monkeypatch, capsys, a, tmp_path / "b")["comparisons"]
    assert (suite["rows"][0]["b"], suite["passed_over"]) == (0.75, [])


def test_an_evaluation_before_the_end_of_a_run_does_not_stand_for_it(tmp_path, monkeypatch, capsys):
    a = write_run(tmp_path / "a", 1, ["1110", "0000"])
    b = write_run(tmp_path / "b", 1, ["1111", "1111"])
    for step, found, said in ((5120, 0.375, 1), (10240, 0.125, 0)):
        policy = f"{a}/checkpoints/{step:07d}/pretrained_model"
        shutil.rmtree(a / "evaluation", ignore_errors=True)
        write_evaluation(a / "evaluation", policy, tasks=["1000", "0000"], split="train")
        (suite,) = compared(monkeypatch, capsys, a, b)["comparisons"]
        assert suite["rows"][0]["a"] == found
        words = "A: cronos-eval of checkpoint 5120, the runs' own evaluations go to 10240"
        assert suite["passed_over"] == [words][:said]


def test_another_tool_s_metrics_are_left_out_and_said(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1000"])
    write_evaluation(tmp_path / "b/eval", "me/b", tasks=["1111"])
    (tmp_path / "b/other").mkdir()
    (tmp_path / "b/other/metrics.jsonl").write_text('{"step": 1, "loss": 0.3}\n')
    (note,) = compared(monkeypatch, capsys, a, tmp_path / "b")["left_out"]
    assert note.endswith("other/metrics.jsonl is not of cronos-train: it has the record {'step': 1, 'loss': 0.3}")


def test_checkpoints_of_several_ages_are_said_and_a_run_of_two_names_is_refused(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1100", "0000"])
    for seed, step in ((1, "0307200"), (2, "0051200")):
        policy = f"runs/seed{seed}/checkpoints/{step}/pretrained_model"
        write_evaluation(tmp_path / f"b/{seed}", policy, tasks=["1110", f"000{seed - 1}"])
    (suite,) = compared(monkeypatch, capsys, a, tmp_path / "b")["comparisons"]
    assert suite["differs"] == ["checkpoints of B: 0051200, 0307200"]
    policy = "/elsewhere/runs/seed1/checkpoints/0102400/pretrained_model"
    write_evaluation(tmp_path / "b/3", policy, tasks=["1110", "1001"])
    with pytest.raises(SystemExit, match=r"runs/seed1 and /elsewhere/runs/seed1 may be one training"):
        compare(monkeypatch, a, tmp_path / "b")
    # As it was called while it trained, which may have been before the other or after.
    shutil.rmtree(tmp_path / "b/3")
    write_evaluation(tmp_path / "b/3", "runs/seed1/checkpoints/last/pretrained_model", tasks=["1110", "1001"])
    with pytest.raises(SystemExit, match=r"runs/seed1 has evaluations of last and of 0307200, and which is"):
        compare(monkeypatch, a, tmp_path / "b")


def test_policies_are_told_apart_by_what_they_are_not_by_their_names(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1000"])
    last = "out/checkpoints/last/pretrained_model"
    for seed, fingerprint in ((1000, "1f"), (1001, "2e")):
        write_evaluation(tmp_path / f"b/{seed}", last, tasks=["1111"], seed=seed, policy_fingerprint=fingerprint)
    with pytest.raises(SystemExit, match=r"was evaluated as two different policies \(1f and 2e\)"):
        compare(monkeypatch, a, tmp_path / "b")
    # The same one by two names, with a seed each, is one policy.
    for seed, name in ((1000, "x"), (1001, "y")):
        write_evaluation(tmp_path / f"c/{seed}", name, tasks=["1111"], seed=seed, policy_fingerprint="3d")
        write_evaluation(tmp_path / f"d/{seed}", "d", tasks=["1000"], seed=seed)
    (suite,) = compared(monkeypatch, capsys, tmp_path / "c", tmp_path / "d")["comparisons"]
    assert (suite["rows"][0]["pairs"], suite["rows"][0]["trainings"], len(suite["a"])) == (8, None, 1)
    with pytest.raises(SystemExit, match=r"A and B both have x, evaluated alike"):
        compare(monkeypatch, tmp_path / "c", tmp_path / "c")


def test_a_runs_own_evaluation_is_that_of_its_last_checkpoint(tmp_path, monkeypatch):
    run = write_run(tmp_path / "run", 1, ["1000"])
    (run / "checkpoints/0010240").mkdir(parents=True)
    (run / "checkpoints/last").symlink_to("0010240")
    settings = {"obs_type": None, "renderer": None, "versions": None}
    for number, name in enumerate(("last", "0010240", "0005120")):
        policy = f"{run}/checkpoints/{name}/pretrained_model"
        write_evaluation(
            tmp_path / str(number), policy, tasks=["1000"], split="train", policy_fingerprint="1f", **settings
        )
    for folder in (tmp_path / "0", tmp_path / "1"):
        with pytest.raises(SystemExit, match=r"A and B both have .*pretrained_model, evaluated alike"):
            compare(monkeypatch, folder, run)
    compare(monkeypatch, tmp_path / "2", run)


def test_what_was_left_out_and_what_is_not_alike_is_said(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["110"], temperature=0)
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["11010"], versions={"mujoco": "5"})
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "3 pairs of episodes" in text
    assert "left out: 2 that not all of them ran" in text
    assert "not alike: temperature: 0 in A, 0.6 in B" in text
    assert "mujoco 4" in text


def test_a_policy_that_was_shown_more_is_told(tmp_path, monkeypatch, capsys):
    pixels = {"obs_type": "pixels_agent_pos"}
    seen = {"reads_privileged_state": True, "identity": {"task_observation": "one_hot"}}
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["110"], **pixels, **seen)
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["110"], **pixels)
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "privileged_state: True in A, None in B" in text
    assert "task_observation: one_hot in A, None in B" in text


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"scene": "playroom_2x2"}, "they differ in scene: kitchen_2x2 and playroom_2x2"),
        ({"benchmark": {"fingerprint": "77aa"}}, r"benchmark \(configurations, .*\): [0-9a-f]{16} and 77aa"),
        ({"seed": 7}, r"their action sampling has other seeds: \[1000\] and \[7\]"),
        (
            {"split": "train"},
            "no suite and split is in both: A has independent held_out, .* B has independent train",
        ),
        (
            {"advance": "on_success"},
            "on sequential held_out: they differ in advance: window and on_success",
        ),
        ({"benchmark": {"environment": "lerobot_env_cronos/kitchen_2x2-v0"}}, "v0"),
        ({"format": 1}, "is in format 1"),
    ],
)
def test_evaluations_that_cannot_be_paired_are_refused(tmp_path, monkeypatch, changes, sentence):
    what = {"tasks": ["10"]} if "advance" not in changes else {}
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["10"], chains=[[1, 2]])
    b = write_evaluation(tmp_path / "b", "me/b", **what, chains=[[1, 2]], **changes)
    with pytest.raises(SystemExit, match=sentence):
        compare(monkeypatch, a, b)


def test_folders_that_say_nothing_are_refused(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["10"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match=r"empty has no results.json of cronos-eval and no metrics.jsonl"):
        compare(monkeypatch, a, tmp_path / "empty")
    again = write_evaluation(tmp_path / "two/1", "me/a", tasks=["10"])
    write_evaluation(tmp_path / "two/2", "me/a", tasks=["11"], temperature=0)
    with pytest.raises(SystemExit, match=r"two evaluations of the same episodes \(temperature: 0.6 and 0\)"):
        compare(monkeypatch, a, tmp_path / "two")
    write_evaluation(tmp_path / "other/1", "me/a", tasks=["10"])
    write_evaluation(tmp_path / "other/2", "me/a", tasks=["11"], temperature=0, seed=2000)
    with pytest.raises(SystemExit, match=r"evaluations that were not made alike \(temperature: 0.6 and 0\)"):
        compare(monkeypatch, a, tmp_path / "other")
    (again / "parts/independent_held_out.json").unlink()
    with pytest.raises(SystemExit, match=r"has no parts/independent_held_out.json"):
        compare(monkeypatch, a, again)
    with pytest.raises(SystemExit, match="2"):
        compare(monkeypatch, a)
    assert "name two folders, A and B, or --with: got 1" in capsys.readouterr().err
