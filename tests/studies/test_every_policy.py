"""The study's runs differ in what they say they differ in, and its table is what the runs wrote."""

import json

from cronos_lerobot.studies.every_policy import KINDS, make_jobs, make_runs, make_table, run_folder


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
    lines = make_table(runs, tmp_path).splitlines()
    assert len(lines) == 3
    # 0.2 +- 4.303 * 0.1 / sqrt(3), t of two degrees of freedom.
    half = 4.302653 * 0.1 / 3**0.5
    gain = f"+0.200 [{0.2 - half:+.3f}, {0.2 + half:+.3f}]"
    assert lines[2] == f"| act | ppo | 80 | 204,800 | 2,560 | 0.500 | .600 .700 .800 | {gain} |"
    write_run(tmp_path, imitation[1], 0.5, 0.55)
    assert make_table(runs, tmp_path).splitlines()[3].endswith("| .550 | +0.050 |")
