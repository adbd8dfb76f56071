"""The study's runs differ in what they say they differ in, and its table is what the runs wrote."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

from cronos_lerobot.studies.every_policy import (
    KINDS,
    find_costs,
    find_ends,
    make_jobs,
    make_runs,
    read_runs,
    run_folder,
)
from cronos_lerobot.studies.every_policy_report import (
    Ended,
    draw_gains,
    make_cost_table,
    make_table,
    merge,
    read_gains,
    write_gains,
)

DOCS = Path(__file__).parents[2] / "docs"


def flags_of(job):
    return dict(flag.split("=", 1) for flag in job.command[1:])


def test_runs_differ_in_policy_agent_interval_and_seed_alone(tmp_path):
    runs = make_runs(list(KINDS), ["ppo", "imitation", "steering"], [80, 320], [1, 2])
    assert len(runs) == len({run.name for run in runs}) == 4 * sum(len(kind.agents) for kind in KINDS.values())
    jobs = {job.name: job for job in make_jobs(runs, tmp_path)}
    first, second = flags_of(jobs["act_ppo_80_1"]), flags_of(jobs["act_ppo_80_2"])
    assert {name for name in first if first[name] != second[name]} == {"--seed", "--output_dir"}
    far = flags_of(jobs["act_ppo_320_1"])
    assert {name for name in far if first.get(name) != far[name]} == {
        "--protocol.scene_reset_interval", "--protocol.end_effector_reset", "--output_dir",
    }  # fmt: skip
    bases = {flags_of(jobs[run.name])["--policy.path"] for run in runs}
    assert bases == {f"{tmp_path}/bases/{kind}/checkpoints/last/pretrained_model" for kind in KINDS}
    assert all(need in jobs for job in jobs.values() for need in job.needs)


def write_run(folder, run, before, after, steps=None):
    path = run_folder(run, folder)
    path.mkdir(parents=True)
    records = [
        {"kind": "evaluation", "interaction_steps": at, "success": success, "interventions": at // 80, "n": 256}
        for at, success in ((0, before), (steps or run.steps, after))
    ]
    (path / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))


def test_the_table_has_the_gain_over_the_seeds(tmp_path):
    runs = make_runs(["act"], ["ppo", "imitation"], [80], [1, 2, 3])
    ppo, imitation = ([run for run in runs if run.agent == agent] for agent in ("ppo", "imitation"))
    for run, after in zip(ppo, (0.6, 0.7, 0.8), strict=True):
        write_run(tmp_path, run, 0.5, after)
    # One that is not over has no line of its own.
    write_run(tmp_path, imitation[0], 0.5, 0.9, steps=51_200)
    lines = make_table(find_ends(read_runs(tmp_path))).splitlines()
    assert len(lines) == 3
    # 0.2 +- 4.303 * 0.1 / sqrt(3), t of two degrees of freedom.
    half = 4.302653 * 0.1 / 3**0.5
    gain = f"+0.200 [{0.2 - half:+.3f}, {0.2 + half:+.3f}]"
    assert 0.2 - half < 0
    assert lines[2] == f"| act | ppo | 80 | 204,800 | 2,560 | 0.500 | .600 .700 .800 | {gain} |"
    write_run(tmp_path, imitation[1], 0.5, 0.55)
    # A run that has not come to its first evaluation, and a folder that is none of the study's.
    for name in ("act_ppo_320_3", "somebody_ppo_80_1"):
        (tmp_path / "runs" / name).mkdir()
        (tmp_path / "runs" / name / "metrics.jsonl").touch()
    assert set(read_runs(tmp_path)) == {*ppo, *imitation[:2]}
    ends = merge(find_ends(read_runs(tmp_path)), [], list(KINDS))
    assert make_table(ends).splitlines()[3].endswith("| .550 | +0.050 |")
    write_run(tmp_path, imitation[2], 0.5, 0.56)
    # An interval above zero is bold: 0.055 +- 12.706 * 0.005 is not, 0.055 +- 12.706 * 0.0005 is.
    ends = [end for end in find_ends(read_runs(tmp_path)) if end.agent == "imitation"]
    assert "**" not in make_table(ends)
    # Two that came to the same do not say that all do.
    tied = [replace(end, after=0.55) for end in ends]
    assert make_table(tied).splitlines()[2].endswith("| .550 .550 | +0.050 |")
    ends = [replace(end, after=after) for end, after in zip(ends, (0.5545, 0.5555), strict=True)]
    assert make_table(ends).endswith("| **+0.055 [+0.049, +0.061]** |")


def test_runs_of_another_machine_count_where_there_is_no_own(tmp_path):
    own = [Ended("flow", "ppo", 80, seed, 1000, 12, 0.5, 0.6, 256) for seed in (1, 2)]
    others = [Ended("flow", "ppo", 80, seed, 1000, 12, 0.5, 0.7, 256) for seed in (2, 3)]
    others += [replace(others[0], policy="tokens"), replace(others[0], agent="imitation", interval=320)]
    write_gains(others, tmp_path / "gains.csv")
    assert read_gains(tmp_path / "gains.csv") == others
    found = merge(own, read_gains(tmp_path / "gains.csv"), list(KINDS))
    assert [(end.policy, end.agent, end.seed, end.after) for end in found] == [
        ("tokens", "ppo", 2, 0.7), ("flow", "ppo", 1, 0.6), ("flow", "ppo", 2, 0.6), ("flow", "ppo", 3, 0.7),
        ("flow", "imitation", 2, 0.7),
    ]  # fmt: skip


def test_the_docs_have_the_table_of_their_file():
    assert make_table(read_gains(DOCS / "results/every_policy/gains.csv")) in (DOCS / "results.md").read_text()


def test_the_figure_has_a_line_for_each_policy_agent_and_interval():
    ends = read_gains(DOCS / "results/every_policy/gains.csv")
    (ax,) = draw_gains(ends).axes
    assert len(ax.get_yticks()) == len({(end.policy, end.agent, end.interval) for end in ends})
    low, high = ax.get_xlim()
    assert all(low < end.after < high for end in ends)


def test_cost_is_time_over_the_time_of_physics(tmp_path):
    runs = make_runs(["flow"], ["ppo"], [80], [1, 2, 3])
    # 1000 steps in 10 s, 4 s of them physics, and in 5 s, 1 s of them; the first update does not count.
    speeds = {1: ((1, 1.0), (100, 0.4), (200, 0.2)), 2: ((1, 1.0), (100, 0.5)), 3: ((1, 1.0),)}
    for run in runs:
        path = run_folder(run, tmp_path)
        path.mkdir(parents=True)
        records = [
            {
                "kind": "update",
                "interaction_steps": 1000 * (i + 1),
                "steps_per_s": speed,
                "time_share": {"physics": p},
            }
            for i, (speed, p) in enumerate(speeds[run.seed])
        ]
        (path / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    table = make_cost_table(find_costs(read_runs(tmp_path)))
    assert table.splitlines()[2] == "| flow | ppo | 100 to 133 | 2.0 to 3.0 |"


def test_the_commands_of_the_docs_are_those_of_the_study():
    """The table of baselines can be made by hand."""
    page = (DOCS / "results.md").read_text()
    block = page[page.index("## Baselines") : page.index("| base | cloned for")].replace("\\\n", " ")
    (shared,) = re.findall(r'^clone="(.*?)"$', block, re.MULTILINE)
    lines = [shlex.split(f"{shared} {line}") for line in re.findall(r"^\$clone (.*)$", block, re.MULTILINE)]
    by_hand = {flag.split("/")[-1]: line for line in lines for flag in line if flag.startswith("--output_dir")}
    runs = make_runs(list(KINDS), ["ppo"], [80], [1])
    jobs = {job.name: job for job in make_jobs(runs, Path("outputs/baselines"))}
    for kind in KINDS:
        expected = flags_of(jobs[f"base {kind}"]) | {"--output_dir": f"outputs/baselines/{kind}"}
        assert _parsed(by_hand[kind]) == _parsed([f"{name}={value}" for name, value in expected.items()])
    (record,) = [shlex.split(line) for line in block.splitlines() if line.startswith("cronos-record-demos")]
    assert _parsed(record) == _parsed(jobs["demos"].command)


def _parsed(flags):
    """JSON is the same however it is written."""
    parts = [flag.split("=", 1) for flag in flags if "=" in flag]
    return {name: json.loads(value) if value.startswith("{") else value for name, value in parts}
