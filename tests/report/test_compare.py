"""`cronos-report compare`: evaluations and runs, paired episode by episode."""

import json
import sys

import pytest
from synthetic_evaluations import write_evaluation
from synthetic_runs import INSTRUCTIONS, write_training_run

from cronos_lerobot.scripts import report


def compare(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-report", "compare", *map(str, arguments)])
    report.main()


@pytest.fixture
def compared(monkeypatch, capsys):
    def run(*arguments):
        compare(monkeypatch, *arguments, "--json")
        return json.loads(capsys.readouterr().out)

    return run


def write_run(folder, seed, tasks, **options):
    return write_training_run(folder, seed=seed, tasks=tasks, **options)


def test_two_policies_task_by_task(tmp_path, compared, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1100000000", "0000000000"])
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["1011111111", "0000000000"])
    (suite,) = compared(a, b)["comparisons"]
    assert (suite["suite"], suite["split"], suite["left_out"]) == ("independent", "held_out", 0)
    assert (suite["a"], suite["b"], suite["differs"]) == (["me/a"], ["me/b"], [])
    assert (suite["pairs"], suite["clusters"]) == (20, 10)
    overall, one, other = suite["rows"]
    assert [row["what"] for row in suite["rows"]] == ["all tasks", *INSTRUCTIONS[:2]]
    assert (overall["a"], overall["b"], overall["trainings"]) == (0.1, 0.45, None)
    # By configuration as by episode: 8 of 9 that differ, 2 (1 + 9) / 2^9.
    assert overall["policies"]["p"] == one["policies"]["p"] == 20 / 512
    assert (one["p_holm"], other["policies"]["p"], other["p_holm"]) == (40 / 512, 1, 1)
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "20 pairs of episodes from 10 configurations" in text
    assert "B is better, of these policies (p = 0.039 < 0.05)." in text
    compare(monkeypatch, b, a)
    assert "A is better" in capsys.readouterr().out


def test_a_difference_that_is_not_significant_says_what_would_be(tmp_path, monkeypatch, capsys):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1100000000", "0000000000"])
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["1011000000", "0000000000"])
    compare(monkeypatch, a, b)
    text = capsys.readouterr().out
    assert "No significant difference of these policies (p = 1)" in text
    # Means of two episodes: -.5, .5, .5 and seven 0, standard deviation .2838. (2.262 + .883) .2838 / sqrt(10).
    assert "A difference of about 0.282 would have been found" in text


def test_chains_are_paired_by_ordering_and_configuration(tmp_path, compared):
    a = write_evaluation(tmp_path / "a", "me/a", chains=[[0, 1, 2], [0, 1, 4]])
    b = write_evaluation(tmp_path / "b", "me/b", chains=[[1, 1, 4], [2, 2, 4]])
    rows = compared(a, b)["comparisons"][0]["rows"]
    assert [row["what"] for row in rows] == ["chain length", "SEQ 0", "SEQ 1", "SEQ 2", "SEQ 3"]
    assert (rows[0]["a"], rows[0]["b"]) == (8 / 6, 14 / 6)
    # Sums of the differences by configuration: 1 + 2, 0 + 1, 2 + 0; all of one sign, 2 of 8 ways.
    assert rows[0]["policies"]["value"] == 1
    assert rows[0]["policies"]["p"] == 2 / 8
    # SEQ 2 is success of the third task: only B's first chain of the last configuration is new.
    assert (rows[3]["a"], rows[3]["b"]) == (pytest.approx(1 / 6), pytest.approx(2 / 6))


def test_streams_are_compared_by_the_tasks_done(tmp_path, compared):
    a = write_evaluation(tmp_path / "a", "me/a", stream=["1000", "0000"])
    b = write_evaluation(tmp_path / "b", "me/b", stream=["1100", "1011"])
    (row,) = compared(a, b)["comparisons"][0]["rows"]
    assert (row["what"], row["a"], row["b"]) == ("tasks done", 0.5, 2.5)


def test_three_seeds_on_each_side_speak_of_trainings_and_two_do_not(tmp_path, compared, monkeypatch, capsys):
    for side, per_seed in (("a", ("1000", "0010", "0100")), ("b", ("1110", "1011", "1111"))):
        for seed, line in enumerate(per_seed):
            policy = f"runs/{side}/seed{seed}/train/checkpoints/0010240/pretrained_model"
            write_evaluation(tmp_path / side / f"seed{seed}/eval", policy, tasks=[line])
    (suite,) = compared(tmp_path / "a", tmp_path / "b")["comparisons"]
    row = suite["rows"][0]
    assert suite["b"] == ["b/seed0 0010240", "b/seed1 0010240", "b/seed2 0010240"]
    assert (row["a"], row["b"]) == (pytest.approx(0.25), pytest.approx(10 / 12))
    # Configurations: 3 of B against 1, 1, 1, 0 of A: sums 2, 1, 2, 2 of three, all of one sign: 2 of 16 ways.
    assert row["policies"]["p"] == 2 / 16
    assert "3 against 3 trainings" in row["trainings"]["method"]
    compare(monkeypatch, tmp_path / "a", tmp_path / "b")
    assert "B is better, of trainings like these" in capsys.readouterr().out
    compare(monkeypatch, tmp_path / "a/seed0", tmp_path / "b")
    assert "The side of one policy" in capsys.readouterr().out
    (tmp_path / "b/seed2/eval/independent_held_out/results.json").unlink()
    assert compared(tmp_path / "a", tmp_path / "b")["comparisons"][0]["rows"][0]["trainings"] is None
    compare(monkeypatch, tmp_path / "a", tmp_path / "b")
    assert "nothing about other trainings" in capsys.readouterr().out


def test_run_folders_have_their_last_evaluation(tmp_path, compared, monkeypatch):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for seed, tasks in ((1, ["1110", "0001"]), (2, ["1111", "0000"])):
        write_run(tmp_path / f"b/seed{seed}", seed, tasks)
    (suite,) = compared(a, tmp_path / "b")["comparisons"]
    assert (suite["suite"], suite["split"], suite["pairs"]) == ("independent", "train", 8)
    assert (suite["rows"][0]["a"], suite["rows"][0]["b"]) == (0.125, 0.5)
    assert suite["b"] == ["seed1", "seed2"]
    write_run(tmp_path / "b/other", 1, ["1111", "0000"], interval=1280)
    with pytest.raises(SystemExit, match=r"runs of 2 experiments, not seeds of one: .*1280"):
        compare(monkeypatch, a, tmp_path / "b")


def test_a_run_that_did_not_come_as_far_is_left_out_unless_its_budget_ended_it(tmp_path, compared):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for side, protocol in (("b", {}), ("c", {"reset_budget": 16})):
        for seed, updates in ((1, 8), (2, 4), (3, 8)):
            write_run(tmp_path / side / str(seed), seed, ["1111", "0000"], updates=updates, **protocol)
    found = compared(a, tmp_path / "b")
    assert found["comparisons"][0]["b"] == ["1", "3"]
    assert ["b/2" in note for note in found["left_out"]] == [True]
    found = compared(a, tmp_path / "c")
    assert (len(found["comparisons"][0]["b"]), found["left_out"]) == (3, [])


def test_runs_without_a_cronos_eval_are_not_dropped_for_those_that_have_one(tmp_path, compared):
    a = write_run(tmp_path / "a", 1, ["1000", "0000"])
    for seed in (1, 2):
        write_run(tmp_path / f"b/seed{seed}/train", seed, ["1110", "0001"])
        policy = tmp_path / f"b/seed{seed}/train/checkpoints/0010240/pretrained_model"
        write_evaluation(tmp_path / f"b/seed{seed}/eval", str(policy), tasks=["1111", "1111"], split="train")
        (suite,) = compared(a, tmp_path / "b")["comparisons"]
        # The second run is not written yet, or it is, and both have an evaluation of cronos-eval.
        assert (len(suite["b"]), suite["rows"][0]["b"]) == (seed, 1)
    (tmp_path / "b/seed2/eval/independent_train/results.json").unlink()
    (suite,) = compared(a, tmp_path / "b")["comparisons"]
    assert (len(suite["b"]), suite["rows"][0]["b"]) == (2, 0.5)


def test_episodes_that_not_all_ran_are_left_out_and_counted(tmp_path, compared):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["110000", "00"])
    b = write_evaluation(tmp_path / "b", "me/b", tasks=["1111"])
    (suite,) = compared(a, b)["comparisons"]
    assert (suite["pairs"], suite["left_out"]) == (4, 4)


def test_settings_in_which_the_sides_differ_are_said(tmp_path, compared):
    a = write_evaluation(tmp_path / "a", "me/a", tasks=["1100"])
    b = write_evaluation(tmp_path / "b", "me/a", tasks=["1111"], temperature=0.0)
    assert compared(a, b)["comparisons"][0]["differs"] == ["temperature: 0.6 in A, 0.0 in B"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"benchmark": {"source": "", "fingerprint": "other"}}, "benchmark"),
        ({"scene": "playroom_2x2"}, "scene"),
        ({"seed": 7}, "sampling seed"),
        ({"split": "train"}, "no suite and split is in both"),
        ({"policy": "me/a"}, "nothing to compare"),
    ],
)
def test_what_cannot_be_paired_is_an_error(tmp_path, monkeypatch, changes, said):
    write_evaluation(tmp_path / "a", "me/a", tasks=["1100"])
    write_evaluation(tmp_path / "b", **({"policy": "me/b", "tasks": ["1111"]} | changes))
    with pytest.raises(SystemExit, match=said):
        compare(monkeypatch, tmp_path / "a", tmp_path / "b")


def test_chains_by_other_rules_cannot_be_paired(tmp_path, monkeypatch):
    write_evaluation(tmp_path / "a", "me/a", chains=[[1, 2]])
    write_evaluation(tmp_path / "b", "me/b", chains=[[1, 2]], advance="success")
    with pytest.raises(SystemExit, match="advance"):
        compare(monkeypatch, tmp_path / "a", tmp_path / "b")


def test_one_training_counts_once(tmp_path, monkeypatch):
    write_evaluation(tmp_path / "a", "me/a", tasks=["1100"])
    for step in ("0005120", "0010240"):
        policy = f"runs/x/checkpoints/{step}/pretrained_model"
        write_evaluation(tmp_path / "b" / step, policy, tasks=["1111"])
    with pytest.raises(SystemExit, match="several checkpoints"):
        compare(monkeypatch, tmp_path / "a", tmp_path / "b")
    for name in "xy":
        write_evaluation(tmp_path / "c" / name, "me/c", tasks=["1111"])
    with pytest.raises(SystemExit, match="two evaluations of the same episodes"):
        compare(monkeypatch, tmp_path / "a", tmp_path / "c")
