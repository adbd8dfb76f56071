"""The declared runs are the paper's, written down here a second time by hand."""

import json
from dataclasses import replace

import pytest
from planned_jobs import jobs_of, options

from cronos_lerobot.experiments.command_check import check_commands
from cronos_lerobot.experiments.definitions import EXPERIMENTS, CheckpointEvaluation, Experiment, Row, find_rows
from cronos_lerobot.experiments.plan import make_jobs, train_flags
from cronos_lerobot.experiments.results import paper_results
from cronos_lerobot.experiments.scales import PIXELS, SCALES, STATE, base_recipe
from cronos_lerobot.experiments.specs import run_specs
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.task_orders import TASK_ORDERS

TABLE1 = [
    # T, EER, CL, LSR, HSR: the ticks of Table 1.
    (80, 0, 0, 0, 0),
    (1280, 0, 0, 0, 0),
    (1280, 1, 0, 0, 0),
    (1280, 1, 1, 0, 0),
    (1280, 1, 1, 1, 0),
    (1280, 1, 1, 0, 1),
    (1280, 1, 1, 1, 1),
]
FIGURE3 = [(80, 0, 0, 0, 0), (320, 1, 0, 0, 0), (1280, 1, 1, 0, 1), (2560, 1, 1, 0, 1)]
PAPER = {
    # S in M, scene, rows, splits of the curves.
    "table1": (1.3, "kitchen_2x2", TABLE1, ["train"]),
    "figure2": (1.3, "kitchen_2x2", [(1280, 1, 1, 0, 1)] * 2, ["train"]),
    "figure3": (2.9, "kitchen_2x2", FIGURE3, ["train"]),
    "figure4": (1.3, "kitchen_2x2", [(80, 0, 0, 0, 0), (320, 1, 0, 0, 0)] * 2, ["train", "held_out"]),
    "figure5": (1.3, "kitchen_2x2", [(80, 0, 0, 0, 0), (320, 1, 0, 0, 0)], ["train"]),
    "figure7": (2.9, "kitchen_3x3", [(80, 0, 0, 0, 0), (320, 1, 0, 0, 0)], ["train"]),
    "figure8": (2.9, "playroom_2x2", [(80, 0, 0, 0, 0), (320, 1, 0, 0, 0)], ["train"]),
    "figure11": (2.9, "kitchen_2x2", FIGURE3, ["train"]),
    "figure12": (1.3, "kitchen_2x2", TABLE1, ["train", "held_out"]),
    "figure13": (1.3, "kitchen_2x2", [(80, 0, 0, 0, 0), (320, 1, 0, 0, 0)] * 2, ["train", "held_out"]),
    "figure14": (1.3, "kitchen_2x2", [(1280, 1, 1, 0, 1)] * 2, ["train", "held_out"]),
}


def test_every_table_and_figure_with_results_is_there():
    # Figures 1, 6, 9 and 10 are pictures.
    assert [name for name, experiment in EXPERIMENTS.items() if experiment.source] == list(PAPER)


@pytest.mark.parametrize("name", PAPER)
def test_rows_are_the_papers(name):
    million, scene, rows, splits = PAPER[name]
    experiment = EXPERIMENTS[name]
    assert (experiment.steps, experiment.scene, list(experiment.splits)) == (round(million * 1e6), scene, splits)
    found = [
        (row.interval, row.end_effector_reset, row.curriculum, row.learned_reset, row.heuristic_reset)
        for row in experiment.rows
    ]
    assert found == rows


def test_what_differs_beyond_the_resets():
    assert [row.task_order for row in EXPERIMENTS["figure2"].rows] == ["heuristic", "random"]
    assert [row.num_configurations for row in EXPERIMENTS["figure4"].rows] == [64, 64, 1, 1]
    for figure, same in (
        ("figure11", "figure3"),
        ("figure12", "table1"),
        ("figure13", "figure4"),
        ("figure14", "figure2"),
    ):
        assert EXPERIMENTS[figure].rows == EXPERIMENTS[same].rows
        assert EXPERIMENTS[figure].by_task
    sequential = [(e.suite, e.splits, e.every_checkpoint) for e in EXPERIMENTS["figure5"].evaluations]
    assert sequential == [("sequential", ("train", "held_out"), False)]


@pytest.mark.parametrize("name", PAPER)
def test_names_of_rows_are_unique(name):
    names = [row.name for row in EXPERIMENTS[name].rows]
    assert len(set(names)) == len(names)


def test_paper_scale_is_the_papers():
    scale = SCALES["paper"]
    assert scale.steps == {1_300_000: 1_300_000, 2_900_000: 2_900_000}
    assert (scale.seeds, scale.num_envs, scale.eval_episodes) == (5, 64, 64)


def test_commands_of_table1():
    jobs = jobs_of("table1")
    assert len(jobs) == 2 + 7 * 5
    base = "base/kitchen_2x2_state_400demos_320steps"
    assert list(jobs)[:2] == [f"{base}/demos", f"{base}/clone"]
    # One seed of every row before the second of any.
    assert list(jobs)[2:10:7] == [f"kitchen_2x2_state_paper/t80_1300k/seed{seed}" for seed in (1, 2)]
    hsr = jobs["kitchen_2x2_state_paper/t1280_eer_cl_hsr_1300k/seed3"]
    assert hsr.needs == (f"{base}/clone",)
    assert {
        "cronos-train",
        "--env.scene=kitchen_2x2",
        "--seed=3",
        "--steps=1300000",
        "--num_envs=64",
        "--protocol.scene_reset_interval=1280",
        "--protocol.end_effector_reset=true",
        "--protocol.update_interval=160",
        "--protocol.curriculum=[[650000, 320]]",
        "--protocol.heuristic_reset=true",
        "--eval.n_episodes=64",
        "--eval.temperature=0.6",
        "--eval_freq=102400",
        "--torch_threads=1",
        "--env.num_threads=1",
        f"--policy.path=out/{base}/clone/checkpoints/000320/pretrained_model",
    } <= set(hsr.command)
    assert not any("learned_reset" in flag for flag in hsr.command)
    t80 = jobs["kitchen_2x2_state_paper/t80_1300k/seed1"]
    assert "--protocol.end_effector_reset=false" in t80.command
    assert not any("curriculum" in flag for flag in t80.command)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", PAPER)
def test_protocols_are_valid_and_mean_what_the_row_says(name, scale):
    for spec in run_specs(EXPERIMENTS[name], options(scale)):
        flags = dict(flag.removeprefix("--").split("=", 1) for flag in train_flags(spec))
        values = {key.split(".")[1]: value for key, value in flags.items() if key.startswith("protocol.")}
        assert values.pop("task_order") in TASK_ORDERS
        protocol = ProtocolConfig(**{key: json.loads(value) for key, value in values.items()})
        row, steps = spec.row, int(flags["steps"])
        assert protocol.scene_reset_interval_at(steps) == row.interval
        early = protocol.scene_reset_interval_at(steps // 5)
        assert early == (320 if row.curriculum else row.interval)


@pytest.mark.parametrize("scale", ["smoke", "paper"])
def test_every_run_of_every_experiment_takes_its_flags(scale):
    bases = {row.begins_with(experiment.scene) for experiment in EXPERIMENTS.values() for row in experiment.rows}
    recipes = {base.recipe: base_recipe(SCALES[scale], base.scene, STATE, kind=base.kind) for base in bases}
    chosen = [(experiment, experiment.rows) for experiment in EXPERIMENTS.values()]
    check_commands(make_jobs(chosen, replace(options(scale), recipes=recipes)))


def test_curriculum_ends_at_half_of_every_run():
    for name, scale, until in (
        ("table1", "paper", 650_000),
        ("table1", "small", 153_600),
        ("figure3", "paper", 1_450_000),
    ):
        spec = next(s for s in run_specs(EXPERIMENTS[name], options(scale)) if s.row.curriculum)
        assert f"--protocol.curriculum=[[{until}, 320]]" in train_flags(spec)


def test_runs_are_shared_between_experiments():
    everything = make_jobs([(e, e.rows) for e in EXPERIMENTS.values() if e.source], options())
    trains = [job for job in everything if job.command[0] == "cronos-train"]
    # 1.3 M: seven of Table 1, random order, T = 320, two with one configuration; 2.9 M: four, and two in each of
    # two other scenes.
    assert len(trains) == 5 * (7 + 1 + 1 + 2 + 4 + 2 + 2)
    assert len({job.name for job in everything}) == len(everything)
    assert len({job.output for job in everything}) == len(everything)
    # Three scenes, each with demonstrations and their cloning, and the evaluation where held-out curves begin; the
    # three of the base policy from one configuration.
    assert len([job for job in everything if job.name.startswith("base/")]) == 6 + 1 + 3


@pytest.mark.parametrize("scale", SCALES)
def test_no_two_commands_share_a_folder(scale):
    everything = [(experiment, experiment.rows) for experiment in EXPERIMENTS.values()]
    kinds = {row.begins_with(experiment.scene) for experiment, rows in everything for row in rows}
    recipes = {base.recipe: base_recipe(SCALES[scale], base.scene, STATE, kind=base.kind) for base in kinds}
    make_jobs(everything, replace(options(scale), recipes=recipes))
    table1 = EXPERIMENTS["table1"]
    other = replace(table1, name="mine", rows=(replace(table1.rows[0], flags=("--algorithm.gamma=0.9",)),))
    with pytest.raises(ValueError, match=r"two commands would share the folder of kitchen_2x2_state_.*/t80_"):
        make_jobs([(table1, table1.rows), (other, other.rows)], options(scale))


def test_rows_of_one_configuration_begin_with_a_policy_of_that_one_and_repeat_their_episodes():
    jobs = jobs_of("figure4", rows=["t80", "t80_1config"])
    one = "base/kitchen_2x2_state_400demos_320steps_1config"
    assert "--start.num_configurations=1" in jobs[f"{one}/demos"].command
    run = jobs["kitchen_2x2_state_paper/t80_1config_1300k/seed1"]
    assert run.needs == (f"{one}/clone",)
    # 64 episodes of each task, as of the rows with 64 configurations.
    wanted = {
        f"--policy.path=out/{one}/clone/checkpoints/000320/pretrained_model", "--eval.n_episodes=1",
        "--eval.repetitions=64",
    }  # fmt: skip
    assert wanted <= set(run.command)
    assert {"--eval.n_episodes=64", "--eval.repetitions=1"} <= set(
        jobs["kitchen_2x2_state_paper/t80_1300k/seed1"].command
    )
    base = jobs[f"{one}/independent_held_out"]
    assert f"--policy.path=out/{one}/clone/checkpoints/000320/pretrained_model" in base.command


def test_given_numbers_of_episodes_hold_for_rows_with_one_configuration():
    jobs = jobs_of("figure4", extra=("--eval.n_episodes=16", "--algorithm.target_kl=0.02"))
    flags = {name: jobs[f"kitchen_2x2_state_paper/{name}_1300k/seed1"].command for name in ("t80", "t80_1config")}
    assert {"--eval.n_episodes=16", "--eval.repetitions=1", "--algorithm.target_kl=0.02"} <= set(flags["t80"])
    assert {"--eval.n_episodes=1", "--eval.repetitions=16"} <= set(flags["t80_1config"])
    # Three times each are three times as many of a single one, too.
    jobs = jobs_of("figure4", extra=("--eval.repetitions=3",))
    flags = {name: jobs[f"kitchen_2x2_state_paper/{name}_1300k/seed1"].command for name in ("t80", "t80_1config")}
    assert {"--eval.n_episodes=64", "--eval.repetitions=3"} <= set(flags["t80"])
    assert {"--eval.n_episodes=1", "--eval.repetitions=192"} <= set(flags["t80_1config"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"curriculum": True, "stages": ((245760, 640),), "tag": "s"}, "curriculum or stages of its own"),
        ({"num_configurations": 1, "base": "wide"}, "1 configuration has a base of its own, not 'wide'"),
    ],
)
def test_rows_that_would_do_less_than_they_say_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Row(1280, **options)


def test_runs_are_evaluated_at_the_budgets_of_all_tables_that_share_them():
    at = "--eval_at_interventions=[1000, 1600, 2000, 4000, 6000, 8000]"
    for name in ("table1", "figure4"):
        assert at in jobs_of(name, rows=["t80"])["kitchen_2x2_state_paper/t80_1300k/seed1"].command
    # 307,200 of 1.3 M steps.
    small = jobs_of("table1", rows=["t80"], scale="small")["kitchen_2x2_state_small/t80_307k/seed1"].command
    assert "--eval_at_interventions=[236, 378, 472, 945, 1417, 1890]" in small


def test_own_policy_needs_no_base():
    jobs = jobs_of("figure5", policy_path="me/policy")
    assert not any(name.startswith("base/") for name in jobs)
    assert "--policy.path=me/policy" in jobs["kitchen_2x2_state_paper/t320_eer_1300k/seed5"].command


def test_evaluations_have_the_environment_of_their_training():
    extra = ("--env.benchmark=me/kitchen", "--env.discover_packages_path=mine", "--algorithm.target_kl=0.02")
    jobs = jobs_of("figure4", scale="small", extra=extra)
    evaluations = [job for job in jobs.values() if job.command[0] == "cronos-eval"]
    assert any(job.name.startswith("base/") for job in evaluations)
    assert len(evaluations) > 12
    for job in evaluations:
        assert set(extra[:2]) < set(job.command)
        assert extra[2] not in job.command
    train = jobs["kitchen_2x2_state_small/t80_307k/seed1"]
    assert set(extra) < set(train.command)
    assert train.made_from_it == (train.output.parent / "eval",)
    assert {job.output.parent for job in evaluations if train.name in job.needs} == set(train.made_from_it)


def test_pixels():
    jobs = jobs_of("figure7", rows=["t320_eer"], scale="small", obs_type=PIXELS)
    demos, clone, *trains = jobs.values()
    assert {
        "--dataset.num_episodes=7200",
        "--dataset.video=false",
        "--env.privileged_state=true",
        "--env.scene=kitchen_3x3",
    } <= set(demos.command)
    assert {"--policy.observation=image", "--policy.critic_observation=environment_state"} <= set(clone.command)
    assert len(trains) == 3
    assert {
        "--policy.freeze_encoder=true",
        "--algorithm.policy_lr=1e-4",
        "--env.obs_type=pixels_agent_pos",
    } <= set(trains[0].command)
    # Of a policy of one's own, ACT say, nothing is known.
    trains = jobs_of("figure7", rows=["t320_eer"], scale="small", obs_type=PIXELS, policy_path="me/act").values()
    assert not [flag for job in trains for flag in job.command if flag.startswith("--policy.freeze")]


def test_evaluations_of_checkpoints(tmp_path):
    figure4 = jobs_of("figure4", rows=["t80"])
    evals = [job for job in figure4.values() if job.command[0] == "cronos-eval" and "/seed2/" in job.name]
    # Every multiple of 102,400 up to 1,300,480, 1.3 M rounded up to whole updates, and that itself.
    assert len(evals) == 13
    run = "out/runs/kitchen_2x2_state_paper/t80_1300k/seed2"
    assert evals[0].command[0] == "cronos-eval"
    assert {
        f"--policy.path={run}/train/checkpoints/0102400/pretrained_model",
        "--env.scene=kitchen_2x2",
        "--eval.suites=independent",
        "--eval.splits=held_out",
        "--eval.temperature=0.6",
    } <= set(evals[0].command)
    base = "base/kitchen_2x2_state_400demos_320steps"
    assert figure4[f"{base}/independent_held_out"].needs == (f"{base}/clone",)
    # It goes with the clone that it is of.
    assert figure4[f"{base}/independent_held_out"].output in figure4[f"{base}/clone"].made_from_it
    # An experiment of one's own may look at the clone's chains.
    made = {path.name for path in figure4[f"{base}/clone"].made_from_it}
    assert made == {
        f"{suite}_{split}" for suite in ("independent", "sequential") for split in ("train", "held_out")
    }
    # And what a row with an environment of its own has there.
    own = tmp_path / base / "independent_held_out_1234abcd"
    own.mkdir(parents=True)
    assert own in jobs_of("figure4", rows=["t80"], root=tmp_path)[f"{base}/clone"].made_from_it
    assert f"--policy.path={run}/train/checkpoints/1300480/pretrained_model" in evals[-1].command
    assert evals[0].needs == ("kitchen_2x2_state_paper/t80_1300k/seed2",)
    figure5 = [job for job in jobs_of("figure5", rows=["t80"]).values() if job.command[0] == "cronos-eval"]
    assert len(figure5) == 2 * 5


def test_a_run_that_a_budget_may_end_is_evaluated_where_it_ended():
    row = Row(320, tag="short", budgets=(("--protocol.reset_budget", 1000),))
    chains = CheckpointEvaluation("sequential", ("held_out",))
    experiment = Experiment("short", "", (row, Row(320)), evaluations=(chains,))
    jobs = {job.name: job for job in make_jobs([(experiment, experiment.rows)], options())}
    run = "kitchen_2x2_state_paper/{}_1300k/seed1"
    name = run + "/sequential_held_out_1300480"
    policy = "--policy.path=out/runs/" + run + "/train/checkpoints/{}/pretrained_model"
    assert policy.format("t320_short", "last") in jobs[name.format("t320_short")].command
    assert policy.format("t320", "1300480") in jobs[name.format("t320")].command
    with pytest.raises(ValueError, match=r"short: a budget may end runs of t320_short at any checkpoint"):
        replace(experiment, evaluations=(replace(chains, every_checkpoint=True),))


def test_checkpoints_lie_where_updates_pass_a_multiple():
    """`cronos-train` saves after the first update at or past each multiple of `save_freq`, and at the end."""
    scale = replace(
        SCALES["small"], steps=dict.fromkeys(SCALES["small"].steps, 10_000), num_envs=8, eval_freq=3_000
    )
    spec = run_specs(EXPERIMENTS["table1"], replace(options("small"), scale=scale))[0]
    # Updates every 8 x 160 = 1280 steps: 3840 is the first past 3000, 6400 past 6000, 10240 past 9000.
    assert (spec.steps, spec.checkpoints) == (10_240, [3_840, 6_400, 10_240])


def test_flags_given_last_replace_the_experiments():
    jobs = jobs_of("table1", extra=("--eval.temperature=0", "--algorithm.target_kl=0.02"))
    command = jobs["kitchen_2x2_state_paper/t80_1300k/seed1"].command
    assert [flag for flag in command if flag.startswith("--eval.temperature")] == ["--eval.temperature=0"]
    assert command[-1] == "--algorithm.target_kl=0.02"


def test_unknown_row():
    with pytest.raises(ValueError, match=r"table1 has no row 't81'; it has t80, t1280,"):
        find_rows(EXPERIMENTS["table1"], ["t81"])


def test_a_row_that_is_named_twice_is_one():
    assert [row.name for row in find_rows(EXPERIMENTS["table1"], ["t1280", "t80", "t1280"])] == ["t1280", "t80"]


def test_papers_numbers():
    means = [paper_results()["final_success"]["table1"][row.name][0] for row in EXPERIMENTS["table1"].rows]
    assert means == [0.897, 0.023, 0.326, 0.578, 0.580, 0.649, 0.631]
    assert "Table 1" in paper_results()["_source"]
