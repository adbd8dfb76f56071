"""`cronos-reproduce` as one types it: two rows of Table 1 at their smallest, and its command line."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
import types

import pytest
from forked_commands import ForkedPopen

from cronos_lerobot.experiments import definitions, runner
from cronos_lerobot.experiments.definitions import Base
from cronos_lerobot.experiments.jobs import made_by, write_record
from cronos_lerobot.experiments.plan import base_jobs, make_jobs
from cronos_lerobot.experiments.specs import base_policy
from cronos_lerobot.protocol import resets
from cronos_lerobot.scripts import reproduce as script

ROWS = ("t80", "t1280_eer_cl_hsr")


def test_two_rows_of_table1_end_to_end(tmp_path, monkeypatch, capsys):
    # How a runner starts, stops and asks its children is tested with real ones, of a line each.
    monkeypatch.setattr(runner, "subprocess", types.SimpleNamespace(**vars(subprocess) | {"Popen": ForkedPopen}))
    flags = ["table1", "--scale=smoke", f"--root={tmp_path}", "--rows", *ROWS, "--jobs=2"]
    call(monkeypatch, *flags)
    assert "jobs: 4 done" in capsys.readouterr().out
    data = json.loads((tmp_path / "table1_smoke_state/table1.json").read_text())
    evaluations = {}
    for row, cells in zip(ROWS, data["rows"], strict=True):
        metrics = tmp_path / f"runs/kitchen_2x2_state_smoke/{row}_3k/seed1/train/metrics.jsonl"
        records = [json.loads(line) for line in metrics.read_text().splitlines()]
        evaluations[row] = [record for record in records if record["kind"] == "evaluation"]
        last = evaluations[row][-1]
        assert (cells["row"], cells["success_train_mean"], cells["n_train"]) == (row, last["success"], last["n"])
        assert cells["interventions_mean"] == last["interventions"]
        assert last["interaction_steps"] == 2_560
    # 4 streams of 640 steps, every scene reset in each 80.
    assert data["rows"][0]["interventions_mean"] == 32
    text = (tmp_path / "table1_smoke_state/table1.md").read_text()
    assert "0.897 ± 0.027" in text
    assert "0.649 ± 0.090" in text

    call(monkeypatch, "status", f"--root={tmp_path}")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    base, run = "base/kitchen_2x2_state_8demos_5steps/clone", "kitchen_2x2_state_smoke/t80_3k/seed1"
    assert [line[:2] for line in lines if line[0] == base] == [[base, "done"]]
    assert [line[:5] for line in lines if line[0] == run] == [[run, "done", "2,560", "/", "2,560"]]

    # As a kill after the first checkpoint leaves it.
    train = tmp_path / "runs/kitchen_2x2_state_smoke/t80_3k/seed1/train"
    shutil.rmtree(train / "checkpoints/002560")
    (train / "checkpoints/last").unlink()
    (train / "checkpoints/last").symlink_to("001280")
    record = train.with_name("train.job.json")
    record.write_text(json.dumps(json.loads(record.read_text()) | {"status": "running"}))
    call(monkeypatch, *flags)
    printed = capsys.readouterr().out.splitlines()
    happened = [line for line in printed if line.startswith(("base/", "kitchen_2x2_"))]
    assert happened == [f"kitchen_2x2_state_smoke/t80_3k/seed1: {what}" for what in ("resumed", "done")]
    records = [json.loads(line) for line in (train / "metrics.jsonl").read_text().splitlines()]
    resumed = [record for record in records if record["kind"] == "evaluation"]
    assert [r["per_task"] for r in resumed] == [r["per_task"] for r in evaluations["t80"]]


def call(monkeypatch, *flags):
    """The same in this process, which has PyTorch at hand."""
    monkeypatch.setattr(sys, "argv", ["cronos-reproduce", *map(str, flags)])
    script.main()


def test_dry_run_prints_commands_that_can_be_copied(tmp_path, monkeypatch, capsys):
    root = tmp_path / "root"
    flags = ["figure5", "--scale=paper", f"--root={root}", "--seeds=4,", "--rows", "t80", "--dry_run"]
    call(monkeypatch, *flags, "--", "--algorithm.target_kl=0.02")
    shell = capsys.readouterr().out
    for program in ("cronos-record-demos", "lerobot-train", "cronos-train", "cronos-eval"):
        shell = shell.replace(f"\n{program} ", f"\necho {program} ")
    listing = subprocess.run(["bash"], input=shell, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [line.split()[0] for line in listing] == [
        "cronos-record-demos", "lerobot-train", "cronos-train", "cronos-eval", "cronos-eval",
    ]  # fmt: skip
    assert "--seed=4 --steps=1300000" in listing[2]
    assert listing[2].endswith("--algorithm.target_kl=0.02")
    assert not root.exists()


def test_dry_run_tells_what_came_without_its_checkpoints(tmp_path, monkeypatch, capsys):
    experiment = definitions.EXPERIMENTS["figure5"]
    flags = ["figure5", f"--root={tmp_path}", "--seeds=1", "--rows", "t80"]
    args = script.make_parser().parse_args(flags)
    rows = definitions.find_rows(experiment, args.rows)
    options = script.make_options(args, [], [rows[0].begins_with(experiment.scene)])
    for job in make_jobs([(experiment, rows)], options):
        if "/sequential" not in job.name:
            job.output.mkdir(parents=True)
            note = {"command": list(job.command), "status": "done", "seconds": 1.0, "starts": 1}
            write_record(job, note | {"made_by": made_by(job)})
    call(monkeypatch, *flags, "--dry_run")
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert [line.split(":")[1].split(",")[0].split(" (")[0] for line in lines] == 3 * [" done"] + 2 * [" blocked"]
    run = "kitchen_2x2_state_small/t80_307k/seed1"
    assert f"checkpoints/307200/pretrained_model is not there: {run} came without checkpoints" in lines[-1]


def test_list_names_every_row(monkeypatch, capsys):
    call(monkeypatch, "list")
    out = capsys.readouterr().out
    assert "t1280_eer_cl_lsr_hsr" in out
    assert "figure14: Robustness to OOD task sequences, by task (Figure 14, Appendix G)" in out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["table1", "--rows", "t81"], "no row 't81'; it has t80, t1280"),
        (
            ["table1", "--seeds=x"],
            "--seeds must be how many, from 1 on, or a list such as 1,4 (0, is seed 0 alone), got 'x'",
        ),
        (["table1", "--seeds=1,-2"], "(0, is seed 0 alone), got '1,-2'"),
        (["table1", "--seeds=0"], "how many, from 1 on, or a list such as 1,4 (0, is seed 0 alone), got '0'"),
        (["table1", "--threads=0"], "--threads must be at least 1, got 0"),
        (["table1", "--jobs=0"], "--jobs must be at least 1, got 0"),
        (["table1", "--jobs=-2"], "--jobs must be at least 1, got -2"),
        (["table1", "--base.demos=0"], "--base.demos must be at least 1, got 0"),
        (["table1", "--base.demos=9", "--policy.path=me/policy"], "--base.demos is of a base policy that is made"),
        (["table1", "--base.clean", "--policy.path=me/policy"], "--base.clean is of a base policy that is made"),
        (["table1", "--root=exp #2"], "--root=exp #2 is YAML to the commands that it is given to"),
        (["table1", "--temperature=-1"], "--temperature must be at least 0, got -1.0"),
        (["table1", "--import=no_module"], "--import=no_module cannot be imported (No module named 'no_module')"),
        (["table1", "--base.checkpoint=400"], "base.checkpoint must be one of [80, 160, 240, 320], got 400"),
        (["table1", "--", "--steps=3"], "--steps=3 is set by the experiment"),
        (
            ["table1", "--", "--eval.n_episodes=100"],
            "--eval.n_episodes=100 must be at most 64, the conf",
        ),
        (["table1", "--", "--save_freq=3"], "--save_freq=3 is set by the experiment"),
        (["table1", "--", "--algorithm.target_kl"], "--algorithm.target_kl needs a value"),
        (["table1", "--", "target_kl"], "flags begin with --, got 'target_kl'"),
        (["table1", "--", "--save_freq", "3"], "--save_freq=3 is set by the experiment"),
        (["table1", "--", "--env.obs_type=pixels_agent_pos"], "is of the runs alone: give --obs_type, before it"),
        (["table1", "--", "--eval.split=held_out"], "--eval.split=held_out is set by the experiment"),
        (["figure4", "--", "--eval.temperature=1"], "--eval.temperature=1 after -- is of the runs alone: give"),
        (["figure5", "--", "--protocol.reset_budget=100"], "figure5 evaluates their checkpoints at fixed steps"),
        (
            ["figure4", "--", "--keep_checkpoints=1"],
            "--keep_checkpoints=1 drops checkpoints, and figure4",
        ),
        (["table1", "--slurm.time=60"], "--slurm.time needs --launcher=slurm"),
        (["table1", "--launcher=slurm", "--slurm.time=2h"], "--slurm.time must be minutes, H:MM:SS or D-HH:MM:SS"),
        (["table1", "--launcher=slurm", "--slurm.cpus=0"], "--slurm.cpus must be at least 1, got 0"),
        (
            ["table1", "--launcher=slurm", "--slurm.time=2"],
            "--slurm.warning_s=120 must be less than",
        ),
        (["status", "--root=nowhere"], "nothing was started in nowhere yet"),
        (["table2"], "invalid choice: 'table2'"),
        (["all", "--rows", "t80"], "for one experiment"),
    ],
)
def test_mistakes_are_explained(flags, message, monkeypatch, capsys):
    with pytest.raises(SystemExit) as stopped:
        # Were one not refused, its hours of training are not begun.
        call(monkeypatch, flags[0], "--dry_run", *flags[1:])
    assert stopped.value.code
    assert message in f"{stopped.value} {capsys.readouterr().err}"


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", (1, 2, 3)), ("3,", (3,)), ("2,5", (2, 5)), (None, (1, 2)), ("4,4", (4,))]
)
def test_seeds(text, seeds):
    assert script.parse_seeds(text, default=2) == seeds


def test_own_recipe_of_the_base_policy():
    args = script.make_parser().parse_args(["table1", "--base.demos=200", "--base.clone_steps=600"])
    recipe = script.make_options(args, [], [Base("kitchen_2x2")]).recipes["kitchen_2x2"]
    assert (recipe.demos, recipe.clone_steps, recipe.checkpoint, recipe.save_freq) == (200, 600, 600, 150)
    args = script.make_parser().parse_args(["table1", "--base.checkpoint=160"])
    recipe = script.make_options(args, [], [Base("kitchen_2x2")]).recipes["kitchen_2x2"]
    assert (recipe.demos, recipe.clone_steps, recipe.checkpoint, recipe.save_freq) == (400, 320, 160, 80)


def test_flags_after_two_dashes_may_be_written_with_a_space(monkeypatch, capsys, tmp_path):
    flags = ["figure4", f"--root={tmp_path}", "--seeds=1", "--dry_run", "--rows", "t80_1config", "--"]
    printed = []
    for given in (["--env.renderer", "filament", "--eval.n_episodes", "16"],
                  ["--env.renderer=filament", "--eval.n_episodes=16"]):  # fmt: skip
        call(monkeypatch, *flags, *given)
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    assert "--eval.repetitions=16" in printed[0]
    with pytest.raises(ValueError, match=r"flags of a row are --name=value, one word each, got '--a'"):
        definitions.Row(80, flags=("--a", "1"), tag="a")


def test_a_clean_base_policy_has_a_recipe_and_a_folder_of_its_own(tmp_path):
    args = script.make_parser().parse_args(["table1", "--base.clean=true", f"--root={tmp_path}"])
    options = script.make_options(args, [], [Base("kitchen_2x2")])
    demos, clone = base_jobs(Base("kitchen_2x2"), options)
    assert demos.output == tmp_path / "base/kitchen_2x2_state_400cleandemos_640steps/demos"
    assert not [flag for flag in demos.command if flag.startswith(("--noise", "--misses", "--steps_after"))]
    assert "--steps=640" in clone.command
    assert base_policy(Base("kitchen_2x2"), options).endswith("checkpoints/000480/pretrained_model")
    args = script.make_parser().parse_args(["figure7", "--base.clean", "--obs_type=pixels"])
    with pytest.raises(ValueError, match="no recipe for a clean base policy from pixels; from state there is"):
        script.make_options(args, [], [Base("kitchen_3x3")])


def test_starting_to_explain_takes_no_pytorch():
    code = "import sys; import cronos_lerobot.scripts.reproduce; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


WOULD_NOT_BEGIN = {
    "--foo=3": "`foo` are not valid for CronosTrainConfig",
    "--protocol.reset_budgets=3": "`protocol`: The fields `reset_budgets` are not valid for ProtocolConfig",
    "--policy.freeze_encodr=true": "--policy.freeze_encodr is no flag of --policy.type=pocketvla",
    "--protocol.takeover_price=3": "protocol.takeover_price=3 is for takeovers",
    "--protocol.extra_resets=[stock]": "protocol.extra_resets has ['stock']",
    "--algorithm.type=nobody": "got 'nobody'",
    "--algorithm.policy_lr=1": "algorithm.policy_lr must be policy_lr_min=1e-06",
    "--record.streams=2": "--record.streams=2 records nothing without --record.repo_id",
    "--env.split=held_out": "--env.split=held_out is of lerobot-eval",
    "--algorithm.self_imitation.max_age=3": "max_age=3 has no effect here: it needs an --algorithm.self_imitation",
}


@pytest.mark.parametrize("flag", WOULD_NOT_BEGIN)
def test_flags_that_no_run_takes_are_told_before_the_first(flag, tmp_path, monkeypatch, capsys):
    flags = ["table1", f"--root={tmp_path}", "--rows", "t80", "--seeds=1"]
    with pytest.raises(SystemExit) as stopped:
        call(monkeypatch, *flags, "--dry_run", "--", flag)
    said = f"error: kitchen_2x2_state_small/t80_307k/seed1 would not begin: .*{re.escape(WOULD_NOT_BEGIN[flag])}"
    assert re.match(said, str(stopped.value))
    assert "\n" not in str(stopped.value)
    assert not capsys.readouterr().out


def test_flags_of_a_policy_that_is_not_loaded_yet_are_its_own(monkeypatch, capsys):
    flags = ["table1", "--policy.path=me/policy", "--rows", "t80", "--seeds=1", "--dry_run"]
    # Neither the policy nor the benchmark is looked for.
    call(monkeypatch, *flags, "--", "--policy.my_width=3", "--env.benchmark=me/kitchen")
    assert "--policy.my_width=3" in capsys.readouterr().out


def test_own_experiment(tmp_path, monkeypatch, capsys):
    module = """
    from cronos_lerobot.experiments import Experiment, Row, register_experiment
    from cronos_lerobot.experiments.definitions import EXPERIMENTS
    flags = (
        "--protocol.discover_packages_path=my_strategy", "--protocol.extra_resets=[stuck]",
        "--protocol.task_order=random",
    )
    rows = (Row(1280, end_effector_reset=True), Row(1280, end_effector_reset=True, tag="stuck", flags=flags))
    register_experiment(Experiment("stuck", "Resetting stuck scenes", rows))
    """
    (tmp_path / "my_experiments.py").write_text(textwrap.dedent(module))
    strategy = """
    from cronos_lerobot.protocol.resets import EndEffectorReset, register_reset
    register_reset("stuck")(lambda rng, protocol: EndEffectorReset())
    """
    (tmp_path / "my_strategy.py").write_text(textwrap.dedent(strategy))
    monkeypatch.setattr(resets, "EXTRA_RESETS", {})
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(definitions, "EXPERIMENTS", dict(definitions.EXPERIMENTS))
    monkeypatch.setattr(script, "EXPERIMENTS", definitions.EXPERIMENTS)
    flags = ["stuck", "--import=my_experiments", "--policy.path=me/policy", "--seeds=1", f"--root={tmp_path}"]
    call(monkeypatch, *flags, "--dry_run")
    plain, stuck = capsys.readouterr().out.split("# kitchen_2x2_state_small/")[1:]
    assert plain.startswith("t1280_eer_307k/seed1")
    assert stuck.startswith("t1280_eer_stuck_307k/seed1")
    assert "extra_resets" not in plain
    assert "--protocol.extra_resets=[stuck]" in stuck
    # A flag of the row replaces the experiment's.
    assert stuck.count("task_order") == 1
    assert "--protocol.task_order=random" in stuck
    call(monkeypatch, *flags, "--report_only")
    assert "1 of 1 seeds not begun" in capsys.readouterr().out
    with pytest.raises(ValueError, match="need different names"):
        definitions.register_experiment(definitions.Experiment("twice", "", (definitions.Row(80),) * 2))
    with pytest.raises(ValueError, match="'table1' already"):
        definitions.register_experiment(definitions.Experiment("table1", "", (definitions.Row(80),)))
    for name in ("all", "list", "status"):
        with pytest.raises(ValueError, match=f"'{name}' is a word of cronos-reproduce's own: all, list, status"):
            definitions.register_experiment(definitions.Experiment(name, "", (definitions.Row(80),)))
    for untagged in (
        {"flags": ("--protocol.reward=level",)},
        {"stages": ((10_000, 80),)},
        {"budgets": (("--protocol.reset_budget", 100),)},
    ):
        row = definitions.Row(1280, **untagged)
        with pytest.raises(ValueError, match=f"row t1280 of untold has {next(iter(untagged))} and no tag"):
            definitions.register_experiment(definitions.Experiment("untold", "", (row,)))


def test_list_into_a_closed_pipe_ends_without_a_traceback():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-c", "from cronos_lerobot.scripts.listing import print_list; print_list()"]
    with open(writer, "wb") as closed:
        ended = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (1, "")
