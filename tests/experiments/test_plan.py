"""Experiments as lists of commands."""

from pathlib import Path

import pytest

from cronos_lerobot.experiments.definitions import EXPERIMENTS, Experiment, Row, find_rows, register_experiment
from cronos_lerobot.experiments.plan import Options, make_pipelines, make_runs
from cronos_lerobot.experiments.scales import SCALES


def plan(name, rows=(), seeds=(1,), scale="paper", **options):
    experiment = EXPERIMENTS[name]
    chosen = Options(SCALES[scale], options.pop("obs", "state"), Path("root"), **options)
    return make_pipelines(make_runs(experiment, find_rows(experiment, list(rows)), seeds, chosen))


def flags(command):
    return dict(word.split("=", 1) for word in command.words[1:])


def test_labels_say_what_the_paper_calls_a_row():
    labels = [row.label for row in EXPERIMENTS["table1"].rows]
    assert labels == [
        "T = 80",
        "T = 1280",
        "T = 1280, EER",
        "T = 1280, EER, CL",
        "T = 1280, EER, CL, LSR",
        "T = 1280, EER, CL, HSR",
        "T = 1280, EER, CL, LSR, HSR",
    ]
    assert EXPERIMENTS["figure2"].rows[1].label == "T = 1280, EER, CL, HSR, random order"
    assert EXPERIMENTS["figure4"].rows[3].label == "T = 320, EER, 1 configuration(s)"
    # What cronos-train does without a flag.
    assert Row("mine", ("--protocol.scene_reset_interval=640",)).label == "T = 640, EER"
    assert EXPERIMENTS["baselines"].rows[-1].label == "T = 4400, staggered, EER, CL, kl_decay_updates=10"


def test_table1_at_the_papers_scale_is_the_papers_setting():
    (pipeline,) = plan("table1", ["t1280_eer_cl_hsr"])
    record, clone, train, evaluate = pipeline.commands
    assert [c.words[0] for c in pipeline.commands] == [
        "cronos-record-demos",
        "lerobot-train",
        "cronos-train",
        "cronos-eval",
    ]
    given = flags(train)
    assert given["--steps"] == "1300000"
    assert given["--num_envs"] == "64"
    assert given["--protocol.scene_reset_interval"] == "1280"
    # Half of 1.3 M interaction steps, Section 6.3.
    assert given["--protocol.curriculum"] == "[[650000,320]]"
    assert given["--protocol.heuristic_reset"] == "true"
    assert given["--policy.path"].startswith(str(clone.output))
    assert flags(clone)["--dataset.root"] == str(record.output)
    assert flags(evaluate)["--policy.path"].startswith(str(train.output))


def test_a_scale_shortens_steps_and_budgets_alike():
    (pipeline,) = plan("figure3", ["t80"], scale="small")
    # 614,400 of 2.9 M steps; 1000 interventions of the paper's are 211 here.
    assert flags(pipeline.commands[2])["--steps"] == "614400"
    assert SCALES["small"].scaled(1000, EXPERIMENTS["figure3"].steps) == 211


def test_experiments_share_runs_and_base_policies():
    (one,) = [p for p in plan("table1") if p.name == "kitchen_2x2_state_paper_paper/t1280_eer_cl_hsr_1300k/seed1"]
    (other,) = [p for p in plan("figure2") if p.name == one.name]
    # The same training, or the second experiment could not use the first one's folder.
    assert one.commands[2] == other.commands[2]
    bases = {pipeline.commands[1].output for pipeline in plan("table1", seeds=(1, 2))}
    assert len(bases) == 1


@pytest.mark.parametrize(
    ("experiment", "row", "obs", "base"),
    [
        ("baselines", "t80", "state", "kitchen_2x2_state"),
        ("table1", "t80", "pixels", "kitchen_2x2_pixels"),
    ],
)
def test_runs_begin_with_the_official_base_where_there_is_one(experiment, row, obs, base):
    (pipeline,) = plan(experiment, [row], obs=obs)
    train, evaluate = pipeline.commands
    assert "_wide_" in pipeline.name
    assert flags(train)["--policy.path"] == base
    assert flags(evaluate)["--env.obs_type"] == flags(train)["--env.obs_type"]


def test_from_pixels_every_base_has_seen_the_whole_reach():
    (pipeline,) = plan("figure7", ["t80"], obs="pixels")
    record = flags(pipeline.commands[0])
    # Nine tasks, 600 demonstrations each.
    assert (record["--dataset.num_episodes"], record["--start.layouts"]) == ("5400", "reach")


def test_every_checkpoint_of_a_held_out_curve_is_evaluated():
    (pipeline,) = plan("figure2", ["t1280_eer_cl_hsr"], scale="small")
    evaluated = [int(command.output.name) for command in pipeline.commands[3:]]
    # 51,200 steps apart; 30 updates of 10,240 steps are 307,200.
    assert evaluated == [0, 51_200, 102_400, 153_600, 204_800, 256_000, 307_200]
    assert Path(flags(pipeline.commands[4])["--policy.path"]).parent.name == "051200"


def test_your_own_flags_win_over_the_rows():
    (pipeline,) = plan("table1", ["t80"], extra=("--protocol.scene_reset_interval=160",), policy_path="me/policy")
    (train, _) = pipeline.commands
    assert flags(train)["--protocol.scene_reset_interval"] == "160"
    assert flags(train)["--policy.path"] == "me/policy"


def test_your_own_experiment_is_registered_once(monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.definitions.EXPERIMENTS", {})
    mine = Experiment("mine", "Mine", (Row("a", ("--protocol.scene_reset_interval=160",)),))
    register_experiment(mine)
    with pytest.raises(ValueError, match="mine"):
        register_experiment(mine)
    with pytest.raises(ValueError, match="different names"):
        Experiment("mine", "Mine", (*mine.rows, *mine.rows))


def test_an_unknown_row_is_an_error_that_lists_the_rows():
    with pytest.raises(ValueError, match=r"--rows.*t320_eer"):
        find_rows(EXPERIMENTS["figure5"], ["t81"])
