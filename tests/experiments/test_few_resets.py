"""The experiments of few resets: what their rows do, and the figure of success against interventions."""

from dataclasses import replace

import numpy as np
import pytest
from experiment_runs import TINY, make_run, results
from flags import parse_flags

from cronos_lerobot.experiments.definitions import EXPERIMENTS, Base
from cronos_lerobot.experiments.few_resets import BUDGET, METHOD_BY_BUDGET, PLUGS, plugged, wide
from cronos_lerobot.experiments.intervention_plots import (
    find_end,
    interventions_figure,
    row_styles,
    side_by_side,
)
from cronos_lerobot.experiments.outputs import write_outputs
from cronos_lerobot.experiments.plan import make_jobs
from cronos_lerobot.experiments.plots import AXIS_LABELS
from cronos_lerobot.experiments.results import collect
from cronos_lerobot.experiments.scales import BASE_KINDS, SCALES, STATE, base_recipe
from cronos_lerobot.experiments.specs import Options
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.resets import PeriodicSceneReset
from cronos_lerobot.scripts import reproduce
from cronos_lerobot.training.config import CronosTrainConfig

NAMES = [name for name in EXPERIMENTS if name.startswith("few_resets")]
FOLDERS = ("--policy.path", "--output_dir")


def options_of(name, root, scale=TINY):
    experiment = EXPERIMENTS[name]
    bases = {row.begins_with(experiment.scene) for row in experiment.rows}
    recipes = {base.recipe: base_recipe(scale, base.scene, STATE, kind=base.kind) for base in bases}
    return Options(scale, STATE, (1, 2), root, recipes=recipes)


def jobs_of(name, root, scale="small"):
    experiment = EXPERIMENTS[name]
    return {
        job.name: job for job in make_jobs([(experiment, experiment.rows)], options_of(name, root, SCALES[scale]))
    }


def test_every_run_is_one_that_cronos_train_takes(tmp_path):
    """Its flags are parsed and checked as the command does, the plugs' among them."""
    commands = set()
    for name in NAMES:
        jobs = jobs_of(name, tmp_path)
        runs = [job for job in jobs.values() if job.command[0] == "cronos-train" and job.name.endswith("seed1")]
        assert len(runs) == len(EXPERIMENTS[name].rows)
        # Rows that differ in their base policy alone, or that experiments share, are parsed once.
        commands |= {tuple(flag for flag in job.command[1:] if not flag.startswith(FOLDERS)) for job in runs}
    for flags in commands:
        parse_flags(CronosTrainConfig, [*flags, f"--output_dir={tmp_path / 'run'}"])


def test_each_plug_stands_alone_and_together_on_both_bases():
    names = [row.name for row in EXPERIMENTS["few_resets"].rows]
    assert len(set(names)) == len(names)
    narrow = [name for name in names if "wide" not in name]
    assert narrow[:5] == ["t80", "t1280_eer", "t1280_eer_cl", "t1280_eer_cl_lsr", "t1280_eer_cl_hsr"]
    assert [name.split("_")[-1] for name in narrow[5:-7]] == list(PLUGS)
    assert narrow[-7:] == [
        "tnone_eer_takeover_memory", "t1280_eer_critic_staggered", "t1280_eer_staggered_decay",
        "tnone_eer_asked_decay", "t4400_eer_staggered_early_decay", "t80_decay",
        "t1280_eer_cl_hsr_decay",
    ]  # fmt: skip
    wides = [f"{name}_wide" for name in narrow if "lsr" not in name]
    # What learned resets add is told beside the same without them, from the base that was shown reset tasks.
    shown = ("t80", "t1280_eer_cl", "t4400_eer_staggered_early_decay", "t1280_eer_cl_lsr")
    resets = [f"{name}_wide_resets" for name in shown]
    assert names == [*narrow, *wides, *resets]
    # The narrow rows of the paper are Table 1's own runs.
    assert set(EXPERIMENTS["few_resets"].rows[:5]) < set(EXPERIMENTS["table1"].rows)


def test_commands(tmp_path):
    jobs = jobs_of("few_resets", tmp_path)
    base = "base/kitchen_2x2_state_1200widedemos_1920steps"
    wanted = {
        "--start.layouts=reach",
        "--start.arm_pose=after_task",
        "--start.misplaced_objects=true",
        "--start.earlier_tasks=3",
        "--start.share=0.5",
        "--noise.share=0.75",
    }
    assert wanted < set(jobs[f"{base}/demos"].command)
    with_resets = "base/kitchen_2x2_state_3600wide_resetsdemos_3840steps"
    assert wanted | {"--reset_tasks=true"} < set(jobs[f"{with_resets}/demos"].command)
    run = jobs["kitchen_2x2_state_small/t4400_eer_staggered_early_decay_wide_307k/seed1"]
    assert run.needs == (f"{base}/clone",)
    # 768 x 320 x 307,200 / 1,300,000
    early = {"--protocol.curriculum=[[58074, 320]]", "--protocol.scene_reset_interval=4400"}
    assert early | {"--protocol.reset_phase=staggered", "--algorithm.kl_decay_updates=10"} < set(run.command)
    critic = jobs["kitchen_2x2_state_small/t1280_eer_critic_wide_307k/seed1"].command
    assert "--protocol.task_order=critic" in critic
    assert sum(flag.startswith("--protocol.task_order") for flag in critic) == 1
    asked = jobs["kitchen_2x2_state_small/tnone_eer_asked_307k/seed1"].command
    # 1,016 x 307,200 / 1,300,000
    assert {"--protocol.scene_reset_interval=null", "--protocol.reset_budget=240"} < set(asked)
    smoke = jobs_of("few_resets", tmp_path, "smoke")["kitchen_2x2_state_smoke/tnone_eer_asked_3k/seed1"].command
    assert "--protocol.reset_budget=2" in smoke


def test_budgets_of_a_plug_need_no_interval_and_one_cannot_have_one():
    assert plugged("asked", interval=1280).interval is None
    assert plugged("critic", interval=5120).interval == 5120
    assert plugged("staggered", "early").interval == 4400
    assert wide(plugged("critic")).name == "t1280_eer_critic_wide"


def test_one_policy_cannot_stand_for_two_bases():
    rows = EXPERIMENTS["few_resets"].rows
    args = reproduce.make_parser().parse_args(["few_resets", "--policy.path=me/policy"])
    with pytest.raises(ValueError, match="begin with 3 kinds \\(narrow, wide, wide_resets\\): choose with --rows"):
        reproduce.make_options(args, [], [row.begins_with("kitchen_2x2") for row in rows])
    assert reproduce.make_options(args, [], [Base("kitchen_2x2")]).recipes == {}


@pytest.fixture
def drawn(tmp_path):
    """Made-up runs of 8 streams: two seeds of T = 80 and T = 1280 on one base, one seed on the other."""
    options = options_of("few_resets", tmp_path / "root")
    for seed, wins in ((1, 6), (2, 8)):
        make_run(options, "few_resets", "t80", seed, (2, 4, wins))
        make_run(options, "few_resets", "t1280_eer", seed, (2, 3, 4))
    make_run(options, "few_resets", "t1280_eer_staggered_wide", 1, (2, 3, 6))
    return options, collect(EXPERIMENTS["few_resets"], EXPERIMENTS["few_resets"].rows, options)


def test_ends_of_the_rows(drawn):
    rows = {row.row.name: find_end(row) for row in drawn[1].rows}
    t80 = rows["t80"]
    # 8 streams in 1280 steps: 16 resets of each; .75 and 1.0 of two seeds.
    assert (t80.interventions, t80.steps, t80.success.mean) == (128, 10_240, 0.875)
    # Student's of two seeds, 12.706 / 8 to each side, is wider than a rate can be: none.
    assert t80.success.ci95 is None
    wide_end = rows["t1280_eer_staggered_wide"]
    # One seed: Wilson's interval of 24 of 32.
    assert (wide_end.interventions, wide_end.success.mean) == (8, 0.75)
    assert wide_end.success.ci95 == pytest.approx((0.579, 0.867), abs=1e-3)
    assert rows["t1280_eer_cl"] is None
    options = replace(drawn[0], seeds=(1, 2, 3))
    make_run(options, "few_resets", "t80", 3, (2, 4, 7))
    (t80,) = (row for row in results(options, "few_resets").rows if row.row.name == "t80")
    # Of three, .75, .875 and 1: 4.303 times their .125 / sqrt(3) to each side.
    assert find_end(t80).success.ci95 == pytest.approx((0.875 - 4.303 * 0.125 / 3**0.5, 1.0), abs=1e-4)


def test_figure_has_a_line_of_panels_for_each_base_and_marks_at_the_ends(drawn):
    figure = interventions_figure(drawn[1])
    narrow, by_steps, reach, _ = figure.axes
    assert [ax.get_title(loc="left") for ax in (narrow, reach)] == ["narrow base policy", "wide base policy"]
    assert (narrow.get_xscale(), by_steps.get_xscale()) == ("symlog", "linear")
    marks = sorted((box[0].get_xdata()[0], box[0].get_ydata()[0]) for box in narrow.containers)
    assert marks == [(8, 0.5), (128, 0.875)]
    assert narrow.get_xlim() == reach.get_xlim()
    # The linear part ends at the decade below the fewest interventions, 8: at 1.
    assert (narrow.get_xlabel(), reach.get_xlabel()) == (
        "",
        f"{AXIS_LABELS['interventions']} (logarithmic beyond 1)",
    )
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["T = 80 (2 seeds)", "T = 1280, EER (2 seeds)", "T = 1280, EER, staggered (1 seed)"]


def test_one_way_of_training_from_two_wide_bases_has_a_line_of_panels_for_each(tmp_path):
    options, experiment = options_of("few_resets_best", tmp_path / "root"), EXPERIMENTS["few_resets_best"]
    for row, wins in (("t80_decay_wide", 6), ("t80_decay_wide_resets", 4)):
        make_run(options, "few_resets_best", row, 1, (2, 3, wins))
    first, _, second, _ = interventions_figure(collect(experiment, experiment.rows, options)).axes
    assert [ax.get_title(loc="left") for ax in (first, second)] == ["wide base policy", "wide resets base policy"]
    assert [box[0].get_ydata()[0] for ax in (first, second) for box in ax.containers] == [0.75, 0.5]


def test_many_rows_are_listed_by_name_beside_their_interventions(options):
    experiment = EXPERIMENTS["few_resets"]
    narrow = [row for row in experiment.rows if "wide" not in row.name]
    for number, row in enumerate(narrow):
        make_run(options, "few_resets", row.name, 1, (2, 4, number % 8))
    figure = interventions_figure(collect(experiment, experiment.rows, options))
    assert not figure.legends
    by_interventions, ends = figure.axes
    assert len(by_interventions.containers) == len(narrow)
    # From above, as in the experiment: place and success.
    listed = [(mark[0].get_ydata()[0], mark[0].get_xdata()[0]) for mark in ends.containers]
    assert listed == [(number, number % 8 / 8) for number in range(len(narrow))]
    labels = [text.get_text() for text in ends.get_yticklabels()]
    assert labels == [f"{row.label} (1 seed)" for row in narrow]
    assert ends.yaxis_inverted()
    (begin,) = [line for line in ends.lines if line.get_linestyle() == ":"]
    assert begin.get_xdata()[0] == 2 / 8


def test_marks_at_one_place_stand_side_by_side():
    assert side_by_side([960.0, 16_000.0, 1016.0, 960.0]) == [-7.0, 0.0, 7.0, 0.0]
    assert side_by_side([0.0, 64.0, 0.0]) == [-3.5, 0.0, 3.5]


def test_rows_of_the_paper_are_grey_and_the_same_on_both_bases(drawn):
    styles = row_styles(drawn[1])
    for name, style in styles.items():
        if "wide" not in name and "lsr" not in name:
            assert styles[f"{name}_wide"] == style
    red, green, blue = (int(styles["t1280_eer"].color[i : i + 2], 16) for i in (1, 3, 5))
    assert red == green == blue
    assert len({(style.color, style.marker) for style in styles.values()}) == len(
        [name for name in styles if "wide" not in name]
    )


@pytest.mark.parametrize("name", NAMES)
def test_no_two_rows_look_alike(name, tmp_path):
    """Once five greys and five markers began anew together, and the sixth row looked as the first."""
    experiment = EXPERIMENTS[name]
    styles = set(row_styles(collect(experiment, experiment.rows, options_of(name, tmp_path))).values())
    assert len({(style.color, style.marker) for style in styles}) == len(styles)


def test_ends_are_joined_by_budget(tmp_path):
    options = options_of("few_resets_budgets", tmp_path / "root")
    for interval, wins in ((1280, 7), (5120, 5)):
        row = f"t{interval}_eer_hsr_wide"
        make_run(options, "few_resets_budgets", row, 1, (2, 4, wins))
    experiment = EXPERIMENTS["few_resets_budgets"]
    (ax, _) = interventions_figure(collect(experiment, experiment.rows, options)).axes
    (line,) = [line for line in ax.lines if line.get_label() == "EER, HSR, by budget"]
    # Made-up runs of T = 5120 have no reset in 1280 steps of each stream.
    np.testing.assert_allclose(line.get_xdata(), [0, 8])
    np.testing.assert_allclose(line.get_ydata(), [5 / 8, 7 / 8])


def test_page_names_the_demonstrations_and_has_the_figure_first(drawn, tmp_path):
    options, _ = drawn
    experiment = EXPERIMENTS["few_resets"]
    page = write_outputs(experiment, experiment.rows, options, tmp_path / "out")
    assert "| T | EER | CL | LSR | HSR | demonstrations |" in page
    assert (tmp_path / "out/few_resets.png").stat().st_size > 10_000
    assert page.index("![few_resets.png]") < page.index("![few_resets_segments.png]")


def test_only_the_papers_experiments_are_all(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("sys.argv", ["cronos-reproduce", "all", "--dry_run", "--seeds=1", f"--root={tmp_path}"])
    reproduce.main()
    out = capsys.readouterr().out
    assert "t80_307k" in out
    assert "wide" not in out


def test_the_method_spends_what_its_budgets_allow():
    """Counted by the strategy itself, switch by switch, over 1.3 M steps of 64 streams."""
    counts = []
    for row in METHOD_BY_BUDGET:
        protocol = ProtocolConfig(
            scene_reset_interval=row.interval,
            curriculum=list(row.stages),
            reset_phase="staggered" if "staggered" in row.name else "together",
        )
        reset, loop = PeriodicSceneReset(np.random.default_rng(0), protocol), LoopState(64, 4)
        counts.append(0)
        while loop.n < 1_300_480:
            loop.t += 80
            counts[-1] += len(reset.due(None, loop))
    assert counts == [1008, 254, 64, 0]
    assert counts[0] <= BUDGET


def test_a_kind_of_demonstrations_keeps_its_flags():
    """A base policy's folder tells no more of them than its name: other flags are a kind with another name."""
    wide_flags = (
        "--start.layouts=reach", "--start.arm_pose=after_task", "--start.occupied_receptacles=true",
        "--start.misplaced_objects=true", "--start.earlier_tasks=3", "--start.share=0.5",
    )  # fmt: skip
    assert {"narrow": (), "wide": wide_flags, "wide_resets": (*wide_flags, "--reset_tasks=true")} == BASE_KINDS
