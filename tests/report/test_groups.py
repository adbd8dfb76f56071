"""Which runs are seeds of one experiment, and which of two of one seed counts."""

import json

import pytest
from synthetic_runs import write_training_run

from cronos_lerobot.report.runs import find_runs, group_runs
from cronos_lerobot.report.tables import seed_rows
from cronos_lerobot.scripts.report import make_report


def test_seeds_of_one_protocol_are_called_by_it_and_a_run_by_its_name(tmp_path):
    for seed in (0, 1):
        write_training_run(tmp_path / f"mine_{seed}", seed=seed, interval=160)
    assert [group.label for group in group_runs(find_runs([tmp_path]).training)] == ["T = 160"]
    assert [group.label for group in group_runs(find_runs([tmp_path / "mine_1"]).training)] == ["mine_1"]


def test_resumed_run_stays_in_its_group(tmp_path):
    for name in "ab":
        manifest = write_training_run(tmp_path / name, seed=ord(name)) / "manifest.json"
        content = json.loads(manifest.read_text())
        (first,) = content["starts"]
        first["config"]["policy"] = {"pretrained_path": "base"}
        resumed = json.loads(json.dumps(first))
        resumed["config"]["policy"]["pretrained_path"] = "a/checkpoints/last"
        content["starts"] += [resumed] if name == "b" else []
        manifest.write_text(json.dumps(content))
    assert len(group_runs(find_runs([tmp_path]).training)) == 1


def test_where_a_policy_is_pushed_to_is_not_the_experiment(tmp_path):
    for seed, pushed in enumerate((None, "me/first")):
        manifest = write_training_run(tmp_path / str(seed), seed=seed) / "manifest.json"
        content = json.loads(manifest.read_text())
        content["starts"][0]["config"]["policy"] = {"repo_id": pushed, "push_to_hub": bool(pushed), "hidden": 8}
        manifest.write_text(json.dumps(content))
    (group,) = group_runs(find_runs([tmp_path]).training)
    assert len(group.runs) == 2


def test_a_run_from_before_a_flag_is_a_seed_of_those_that_have_its_default(tmp_path):
    for seed, starts in enumerate((None, "random", "learnable")):
        manifest = write_training_run(tmp_path / str(seed), seed=seed, interval=160) / "manifest.json"
        content = json.loads(manifest.read_text())
        protocol = content["starts"][0]["config"]["protocol"]
        protocol.pop("reset_starts", None)
        protocol |= {} if starts is None else {"reset_starts": starts}
        manifest.write_text(json.dumps(content))
    groups = group_runs(find_runs([tmp_path]).training)
    assert [sorted(run.seed for run in group.runs) for group in groups] == [[0, 1], [2]]


def test_a_resume_that_was_undone_leaves_nothing(tmp_path):
    """Of a run that went on with another T, and then once more from an earlier checkpoint with its own."""
    for name in "ab":
        manifest = write_training_run(tmp_path / name, seed=ord(name), interval=320) / "manifest.json"
        content = json.loads(manifest.read_text())
        starts = [json.loads(json.dumps(content["starts"][0])) for _ in range(3)]
        for start, steps, interval in zip(starts, (0, 5120, 2560), (320, 1280, 320), strict=True):
            start["interaction_steps"] = steps
            start["config"]["protocol"]["scene_reset_interval"] = interval
        content["starts"] = starts[:1] if name == "a" else starts
        manifest.write_text(json.dumps(content))
    runs = find_runs([tmp_path]).training
    assert [(run.changed, [start["interaction_steps"] for start in run.starts]) for run in runs] == [
        ({}, [0]), ({}, [0, 2560])
    ]  # fmt: skip
    assert len(group_runs(runs)) == 1


def test_seeds_below_other_roots_are_of_one_experiment(tmp_path):
    """As `cronos-reproduce` has it: a root may be moved. Another base policy is another experiment, and the demo's
    in two folders may be two."""
    clones = ("a/base/x/clone/last", "/home/me/base/x/clone/last", "a/base/y/clone/last")
    for seed, path in enumerate((*clones, "a/base/last", "b/base/last")):
        manifest = write_training_run(tmp_path / str(seed), seed=seed) / "manifest.json"
        content = json.loads(manifest.read_text())
        content["starts"][0]["config"]["policy"] = {"pretrained_path": path}
        manifest.write_text(json.dumps(content))
    groups = group_runs(find_runs([tmp_path]).training)
    assert sorted(sorted(run.seed for run in group.runs) for group in groups) == [[0, 1], [2], [3], [4]]


@pytest.mark.parametrize(
    ("changes", "labels"),
    [
        (
            {"curriculum": [[100, 80]]},
            {"T = 320, CL (curriculum=[[50, 80]])", "T = 320, CL (curriculum=[[100, 80]])"},
        ),
        ({"curriculum": None}, {"T = 320, CL", "T = 320"}),
    ],
)
def test_no_two_groups_have_one_label(tmp_path, changes, labels):
    for seed, name in enumerate("abcd"):
        manifest = write_training_run(tmp_path / name, seed=seed, interval=320) / "manifest.json"
        content = json.loads(manifest.read_text())
        protocol = content["starts"][0]["config"]["protocol"]
        protocol |= {"curriculum": [[50, 80]]} | (changes if name in "cd" else {})
        manifest.write_text(json.dumps(content))
    assert {group.label for group in group_runs(find_runs([tmp_path]).training)} == labels


def test_what_differs_in_too_much_is_told_by_its_folder(tmp_path):
    for root in "ab":
        manifest = write_training_run(tmp_path / root / "t80/seed1", interval=80) / "manifest.json"
        content = json.loads(manifest.read_text())
        content["starts"][0]["config"]["algorithm"] = dict.fromkeys("vwxyz", root)
        manifest.write_text(json.dumps(content))
    labels = [group.label for group in group_runs(find_runs([tmp_path]).training)]
    assert len(set(labels)) == 2
    assert all(str(tmp_path / root) in label for root, label in zip("ab", sorted(labels), strict=True))


def test_of_two_runs_of_one_seed_the_longer_counts(tmp_path):
    write_training_run(tmp_path / "short", seed=1, successes=(2, 3, 4), updates=4)
    write_training_run(tmp_path / "long", seed=1, successes=(2, 4, 6))
    write_training_run(tmp_path / "other", seed=2, successes=(2, 4, 4))
    (group,) = group_runs(find_runs([tmp_path]).training)
    assert sorted(run.name for run in group.runs) == ["long", "other"]
    assert make_report([tmp_path]).left_out == [
        f"the run {tmp_path / 'short'}, of 5,120 steps: {tmp_path / 'long'} is of the same settings and seed and"
        " has 10,240"
    ]
    (row,) = seed_rows([group])
    assert row["seeds"] == 2
    # From another machine's clone the same seed is another run, where both say what they began with.
    for name, fingerprint, count in (("short", "a", 2), ("long", "b", 3), ("short", "b", 2)):
        manifest = tmp_path / name / "manifest.json"
        content = json.loads(manifest.read_text())
        content["starts"][0]["policy_fingerprint"] = fingerprint
        manifest.write_text(json.dumps(content))
        (group,) = group_runs(find_runs([tmp_path]).training)
        assert len(group.runs) == count


def edit_config(run, protocol=None, **changes):
    manifest = run / "manifest.json"
    content = json.loads(manifest.read_text())
    config = content["starts"][0]["config"]
    config |= changes
    config["protocol"] |= protocol or {}
    manifest.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("protocol", "labels"),
    [
        ({}, ["T = 320"]),
        ({"scene_reset": "critic", "reset_budget": 9}, ["steps=5120", "steps=10240"]),
        ({"takeover_after": 2, "takeover_price": 1, "takeover_budget": 9}, ["steps=5120", "steps=10240"]),
    ],
    ids=["no pace", "resets", "takeovers"],
)
def test_a_budget_that_is_paced_over_the_steps_makes_a_longer_run_another_experiment(tmp_path, protocol, labels):
    for seed in (1, 2):
        for updates, steps in ((4, 5120), (8, 10240)):
            run = write_training_run(tmp_path / f"{steps}/seed{seed}", seed=seed, interval=320, updates=updates)
            edit_config(run, protocol, steps=steps)
    found, notes = find_runs([tmp_path / "5120", tmp_path / "10240"]), []
    assert [group.label for group in group_runs(found.training, notes)] == labels
    assert len(notes) == (0 if protocol else 2)
    # What has no such budget is called as it would be without them.
    edit_config(write_training_run(tmp_path / "80/seed1", interval=80), steps=10240)
    groups = group_runs(find_runs([tmp_path]).training)
    assert [group.label for group in groups if "steps=" not in group.label][-1] == "T = 80"


def test_seeds_that_differ_from_others_in_too_much_are_called_by_what_their_names_share(tmp_path):
    for row in ("t80_307k", "t1280_307k"):
        for seed in (1, 2):
            run = write_training_run(tmp_path / f"{row}/seed{seed}/train", seed=seed)
            edit_config(run, algorithm=dict.fromkeys("vwxyz", row))
    groups = group_runs(find_runs([tmp_path]).training)
    assert sorted(group.label for group in groups) == ["t1280_307k", "t80_307k"]


@pytest.mark.parametrize(
    ("names", "label"),
    [
        (("eer_1", "eer_10"), "eer"),
        (("eer", "eer_2"), "eer"),
        (("seed1", "seed2"), "seed1, seed2"),
        (("eer_1",), "eer_1"),
    ],
)
def test_a_groups_name_is_whole_words_of_its_runs(tmp_path, names, label):
    for seed, name in enumerate(names):
        edit_config(write_training_run(tmp_path / name, seed=seed), algorithm=dict.fromkeys("vwxyz", 1))
    write_training_run(tmp_path / "zzz")
    assert [group.label for group in group_runs(find_runs([tmp_path]).training)] == [label, "zzz"]
