"""Flags that are given for every run: what becomes of the recipe's, of the base policy and of its evaluation."""

import pytest
from planned_jobs import jobs_of, options

from cronos_lerobot.experiments.command_check import check_commands
from cronos_lerobot.experiments.definitions import CheckpointEvaluation, Experiment, Row
from cronos_lerobot.experiments.plan import make_jobs
from cronos_lerobot.experiments.scales import PIXELS, STATE


@pytest.mark.parametrize(
    ("agent", "kept"),
    [("imitation", []), ("ppo_paper", []), ("ppo", ["--algorithm.policy_lr=1e-4"])],
)
def test_the_settings_of_ppo_from_pixels_go_with_it(agent, kept):
    extra = (f"--algorithm.type={agent}",)
    command = jobs_of("table1", ["t80"], scale="small", obs_type=PIXELS, extra=extra)[
        "kitchen_2x2_pixels_small/t80_307k/seed1"
    ].command
    assert sorted(flag for flag in command if flag.startswith("--algorithm.")) == sorted([*kept, *extra])
    assert "--policy.freeze_encoder=true" in command
    # Of a row's flags, too; those of the command line go before them.
    row = Row(80, tag="other", flags=extra)
    experiment = Experiment("other", "", (row,))
    runs = make_jobs([(experiment, (row,))], options("small", PIXELS))
    check_commands(runs)
    assert [flag for flag in runs[-1].command if flag.startswith("--algorithm.policy_lr")] == kept
    again = make_jobs([(experiment, (row,))], options("small", PIXELS, extra=("--algorithm.type=ppo",)))
    assert "--algorithm.policy_lr=1e-4" in again[-1].command


def test_settings_of_a_policy_of_ones_own_hold_where_its_curves_begin():
    extra = ("--policy.n_action_steps=2", "--algorithm.target_kl=0.02")
    given = jobs_of("figure4", ["t80"], policy_path="me/act", extra=extra)
    (base,) = [job for name, job in given.items() if name.startswith("base/")]
    assert [flag for flag in base.command if flag.startswith("--policy.")] == ["--policy.path=me/act", extra[0]]
    assert extra[1] not in base.command
    # What was evaluated without such flags stays the same command.
    plain = jobs_of("figure4", ["t80"], policy_path="me/act")[base.name]
    assert [flag for flag in base.command if flag != extra[0]] == list(plain.command)


def test_settings_of_a_row_hold_where_its_curve_begins():
    """The same ones in another order are one evaluation, which rows share."""
    flags = ("--policy.n_action_steps=8", "--env.benchmark=me/bench")
    rows = (Row(80), Row(80, tag="n8", flags=flags), Row(320, tag="n8", flags=flags[::-1]))
    evaluations = (CheckpointEvaluation("independent", ("held_out",), every_checkpoint=True),)
    experiment = Experiment("other", "", rows, evaluations=evaluations)
    jobs = make_jobs([(experiment, rows)], options(policy_path="me/act"))
    plain, own = [job.command for job in jobs if job.name.startswith("base/")]
    assert not set(flags) & set(plain)
    assert set(flags) < set(own)


def test_a_benchmark_of_ones_own_may_have_more_configurations():
    extra = ("--env.benchmark=me/large", "--eval.n_episodes=128")
    (run,) = [job for name, job in jobs_of("table1", ["t80"], extra=extra).items() if name.endswith("seed1")]
    assert {"--eval.n_episodes=128", "--eval.repetitions=1"} < set(run.command)
    (run,) = [job for name, job in jobs_of("table1", ["t80"], extra=extra[1:]).items() if name.endswith("seed1")]
    assert {"--eval.n_episodes=64", "--eval.repetitions=2"} < set(run.command)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--protocol.num_configurations=65"], "num_configurations=65, but kitchen_2x2 has 64 train config"),
        (["--save_checkpoint=false", "--keep_checkpoints=3"], "keep_checkpoints=3 is of checkpoints"),
        (
            ["--protocol.takeover_after=2", "--protocol.takeover_price=3", "--protocol.reset_budget=1"],
            "reset_budget=1 pays for no takeover",
        ),
        (
            ["--algorithm.type=imitation", "--algorithm.weighting=return", "--protocol.reward=level"],
            "weighting=return with --protocol.reward=level",
        ),
    ],
)
def test_what_a_run_would_be_refused_for_at_its_start_is_refused_before_the_base_is_made(extra, message):
    jobs = jobs_of("table1", ["t80"], scale="small", extra=tuple(extra))
    with pytest.raises(ValueError, match=rf"t80_307k/seed1 would not begin: .*{message}"):
        check_commands(jobs.values())
    if "num_configurations" in extra[0]:
        # A benchmark of the Hub may have as many.
        check_commands(jobs_of("table1", ["t80"], extra=(*extra, "--env.benchmark=me/large")).values())


@pytest.mark.parametrize(
    ("flag", "obs_type", "is_refused"),
    [
        ("camera_name=bridge", PIXELS, True),
        ("observation_height=64", PIXELS, True),
        ("observation_width=64", PIXELS, True),
        ("renderer=filament", PIXELS, True),
        ("task_observation=one_hot", PIXELS, True),
        ("task_observation=one_hot", STATE, True),
        # Nothing of it is seen, or it is what the base policy has seen.
        ("renderer=filament", STATE, False),
        ("camera_name=front", PIXELS, False),
        ("benchmark=me/kitchen", PIXELS, False),
    ],
)
def test_runs_that_would_see_what_their_base_policy_has_not_are_refused(flag, obs_type, is_refused):
    extra = {"extra": (f"--env.{flag}",)}
    jobs = jobs_of("table1", ["t80"], scale="small", obs_type=obs_type, **extra)
    if is_refused:
        message = rf"t80_307k/seed1 would not begin: --env\.{flag} is of the runs alone.*give --policy\.path"
        with pytest.raises(ValueError, match=message):
            check_commands(jobs.values())
    else:
        check_commands(jobs.values())
    own = jobs_of("table1", ["t80"], scale="small", obs_type=obs_type, policy_path="me/policy", **extra)
    check_commands(own.values(), None)
