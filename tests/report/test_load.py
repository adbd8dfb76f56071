"""Runs and evaluations as tables; what is damaged is left out and said."""

import json

import numpy as np
import pytest
from synthetic_evaluations import write_evaluation
from synthetic_runs import INSTRUCTIONS, edit_lines, edit_starts, write_training_run

from cronos_lerobot.report.load import load, load_evaluations, load_metrics
from cronos_lerobot.report.runs import describe_protocol
from cronos_lerobot.statistics import wilson_interval


def rows_of(folder):
    """Seeds by row."""
    evaluations = load_evaluations([folder])
    return {row: sorted(some["seed"].unique()) for row, some in evaluations.groupby("row")}


def test_one_row_per_evaluation(tmp_path):
    run = write_training_run(tmp_path / "runs/eer", seed=7, successes=(2, 3, 5))
    policy = f"{run}/checkpoints/0010240/pretrained_model"
    write_evaluation(tmp_path / "eval", policy, tasks=["11000000", "10000000"])
    # Each once, however often it is named.
    table = load_evaluations([tmp_path, run])
    columns = ["source", "experiment", "row", "seed", "steps", "interventions", "split", "suite", "n", "success"]
    (*own, cronos) = table[columns].itertuples(index=False, name=None)
    head = ("cronos-train", "kitchen", "eer", 7)
    assert own == [
        (*head, 0, 0, "train", "independent", 32, 0.25),
        (*head, 5120, 16, "train", "independent", 32, 0.375),
        (*head, 10240, 32, "train", "independent", 32, 0.625),
    ]
    # The checkpoint is that run's: its row, seed and interventions.
    assert cronos == ("cronos-eval", *head[1:], 10240, 32, "held_out", "independent", 16, 3 / 16)
    assert table["parts"].iloc[3][0] | {"n": 8, "success": 0.25} == table["parts"].iloc[3][0]
    assert [part["part"] for part in table["parts"].iloc[3]] == INSTRUCTIONS[:2]
    ends = [table["parts"].iloc[3][0][name] for name in ("ci95_low", "ci95_high")]
    assert ends == pytest.approx(wilson_interval(2, 8))
    assert table["episodes"].iloc[0].shape == (32, 4)


def test_one_row_per_update_without_an_unfinished_last_line(tmp_path):
    run = write_training_run(tmp_path / "a", agent="imitation")
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "upd')
    table = load_metrics([tmp_path])
    assert table["steps"].tolist() == [1280 * i for i in range(1, 9)]
    assert table["agent/loss"].iloc[1:].tolist() == [1 / i for i in range(2, 9)]
    assert np.isnan(table["agent/loss"].iloc[0])


def test_two_evaluations_of_one_policy_are_told_apart_by_their_folders(tmp_path):
    for name in ("cold", "hot"):
        write_evaluation(tmp_path / name, "me/a", tasks=["1100"])
    write_evaluation(tmp_path / "hot", "me/a", tasks=["1100"], split="train")
    assert sorted(load_evaluations([tmp_path])["policy"]) == ["me/a", "me/a (cold)", "me/a (hot)"]


def change(name, value):
    """An edit of the third line, an update, or of the last, an evaluation; `name` is a path of keys."""

    def edit(lines):
        first, *rest = name.split("/")
        record = lines[2] if first == "update" else lines[-1]
        for key in rest[:-1]:
            record = record[key]
        record[rest[-1]] = value

    return lambda run: edit_lines(run, edit)


DAMAGES = {
    "bytes": lambda run: (run / "metrics.jsonl").write_bytes(b"\xff\xfe\x00"),
    "of another tool": lambda run: (run / "metrics.jsonl").write_text('{"step": 1, "loss": 0.3}\n'),
    "manifest cut": lambda run: (run / "manifest.json").write_text('{"starts": ['),
    "config is a list": lambda run: edit_starts(run, lambda starts: starts[0].update(config=[1])),
    "another version": lambda run: edit_starts(run, lambda starts: starts[0].update(environment="x-v0")),
    "no rollout": change("update/rollout", None),
    "text for a number": change("update/rollout/success", "high"),
    "impossible counts": change("update/rollout/success_by_segment", {"0": [9, 8]}),
    "a segment beyond the run": change("update/rollout/success_by_segment", {"999999999": [1, 8]}),
    "no interval": change("evaluation/ci95", None),
    "success of 7": change("evaluation/success", 7),
    "no episodes": change("evaluation/n", 0),
    "steps fall": change("evaluation/interaction_steps", -1),
    "steps without end": change("evaluation/interaction_steps", float("inf")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_left_out_and_said(tmp_path, damage):
    write_training_run(tmp_path / "whole")
    DAMAGES[damage](write_training_run(tmp_path / "damaged"))
    loaded = load([tmp_path])
    assert [run.name for run in loaded.runs] == ["whole"]
    (said,) = loaded.left_out
    assert "damaged" in said
    assert len(said) <= 300
    with pytest.raises(ValueError, match="damaged"):
        load([tmp_path / "damaged"])


@pytest.mark.parametrize(
    "content", ["{", '{"suite": "independent"}', {"success": "x"}, {"episodes": [1]}], ids=str
)
def test_damaged_results_are_left_out_and_said(tmp_path, content):
    write_training_run(tmp_path / "whole")
    folder = write_evaluation(tmp_path / "eval", "me/a", tasks=["1100"]) / "independent_held_out"
    if isinstance(content, dict):
        content = json.dumps(json.loads((folder / "results.json").read_text()) | content)
    (folder / "results.json").write_text(content)
    loaded = load([tmp_path])
    assert [str(folder) in text for text in loaded.left_out] == [True]
    assert set(loaded.evaluations["source"]) == {"cronos-train"}


def test_a_folder_without_anything_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing"):
        load([tmp_path / "nothing"])


def test_runs_are_named_by_the_settings_in_which_they_differ(tmp_path):
    for seed in (0, 1):
        write_training_run(tmp_path / f"a/{seed}", seed=seed, interval=160)
        write_training_run(tmp_path / f"b/{seed}", seed=seed, end_effector_reset=True, curriculum=[[640, 160]])
        write_training_run(tmp_path / f"c/{seed}", seed=seed, config={"lr": 0.1})
    assert rows_of(tmp_path) == {"T = 160": [0, 1], "T = 320, EER, CL": [0, 1], "T = 320, lr=0.1": [0, 1]}
    # Seeds alone have the protocol's name, and one run its folder's.
    assert rows_of(tmp_path / "a") == {"T = 160": [0, 1]}
    assert rows_of(tmp_path / "a/1") == {"1": [1]}


def test_runs_that_differ_in_many_settings_are_named_by_their_folders(tmp_path):
    for row in ("t80", "t1280"):
        for seed in (1, 2):
            config = {"algorithm": dict.fromkeys("vwxyz", row)}
            write_training_run(tmp_path / f"{row}/seed{seed}/train", seed=seed, config=config)
    assert rows_of(tmp_path) == {"t1280": [1, 2], "t80": [1, 2]}


def test_where_a_policy_is_pushed_to_is_not_the_experiment(tmp_path):
    for seed, pushed in enumerate((None, "me/first")):
        policy = {"repo_id": pushed, "push_to_hub": bool(pushed), "hidden": 8}
        write_training_run(tmp_path / str(seed), seed=seed, config={"policy": policy})
    assert list(rows_of(tmp_path).values()) == [[0, 1]]


def test_of_two_runs_of_one_seed_the_longer_counts(tmp_path):
    write_training_run(tmp_path / "short", seed=1, updates=4)
    write_training_run(tmp_path / "long", seed=1)
    write_training_run(tmp_path / "other", seed=2)
    loaded = load([tmp_path])
    assert sorted(run.name for run in loaded.runs) == ["long", "other"]
    (said,) = loaded.left_out
    assert f"{tmp_path / 'short'}: " in said
    # From another base policy the same seed is another run.
    for name in ("short", "long"):
        edit_starts(tmp_path / name, lambda starts, name=name: starts[0].update(policy_fingerprint=name))
    assert len(load([tmp_path]).runs) == 3


def test_a_resumed_run_is_a_seed_of_the_others(tmp_path):
    for seed in (1, 2):
        config = {"policy": {"pretrained_path": "base"}}
        write_training_run(tmp_path / str(seed), seed=seed, interval=320, config=config)

    def resume(starts):
        start = json.loads(json.dumps(starts[0])) | {"interaction_steps": 2560}
        start["config"]["policy"] = {"pretrained_path": "its own checkpoint"}
        starts.append(start)

    edit_starts(tmp_path / "2", resume)
    assert rows_of(tmp_path) == {"T = 320": [1, 2]}


@pytest.mark.parametrize(
    ("protocol", "name"),
    [
        # The paper's T = 80 resets the arm with the scene; with a curriculum it does not at first.
        ({"scene_reset_interval": 80, "end_effector_reset": True}, "T = 80"),
        ({"scene_reset_interval": 80, "end_effector_reset": True, "curriculum": [[640, 80]]}, "T = 80, EER, CL"),
        (
            {"scene_reset_interval": 1280, "learned_reset": True, "heuristic_reset": True, "extra_resets": ["x"]},
            "T = 1280, LSR, HSR, x",
        ),
        ({"scene_reset_interval": None, "task_order": "random"}, "no scene resets, random order"),
        (
            {
                "scene_reset_interval": 640,
                "reset_phase": "staggered",
                "reset_budget": 9,
                "num_configurations": 1,
            },
            "T = 640, staggered, 1 configuration(s), at most 9 interventions",
        ),
    ],
)
def test_a_protocol_is_named_as_in_table_1(protocol, name):
    assert describe_protocol({"task_switch_interval": 80} | protocol) == name
