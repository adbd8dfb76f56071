"""A world that is not ours is trained, resumed, recorded, checked, evaluated and published."""

import json

import pytest

from cronos_lerobot.scripts.report import main as report

WORLD = ("--env.discover_packages_path=point_mass", "--env.type=point_mass")
TRAINING = (
    *WORLD, "--policy.type=pocketvla", "--policy.action_bounds=unit", "--policy.gripper_dim=null",
    "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1", "--policy.push_to_hub=false",
    "--num_envs=2", "--protocol.end_effector_reset=false", "--protocol.scene_reset_interval=80", "--save_freq=160",
    "--eval_freq=0", "--tensorboard=false", "--algorithm.minibatch_size=16", "--algorithm.value_warmup_updates=0",
    "--record.repo_id=me/pushes",
)  # fmt: skip


@pytest.fixture(scope="module")
def run(commands, tmp_path_factory):
    """480 steps: of each stream six tasks of 40 steps, and a scene reset after every second one."""
    folder = tmp_path_factory.mktemp("train") / "run"
    output = commands.run("cronos-train", *TRAINING, "--steps=480", f"--output_dir={folder}")
    assert "found complete" in output
    assert "never grasped" not in output
    return folder


def metrics(folder):
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k in ("kind", "rollout", "agent")} for line in lines]


def test_its_intervals_follow_from_its_tasks_and_a_resumed_run_is_the_unbroken_one(run, commands, tmp_path):
    protocol = json.loads((run / "manifest.json").read_text())["starts"][0]["config"]["protocol"]
    assert [protocol[f"{name}_interval"] for name in ("task_switch", "update", "scene_reset")] == [40, 80, 80]
    broken = tmp_path / "run"
    commands.run("cronos-train", *TRAINING, "--steps=160", f"--output_dir={broken}")
    commands.run("cronos-train", "--resume=true", f"--output_dir={broken}", *WORLD[:1], "--steps=480")
    assert metrics(broken)[-2:] == metrics(run)[-2:]


def test_its_streams_are_recorded_whole_and_published(run, commands, served):
    flags = ("--dataset.repo_id=me/pushes", f"--dataset.root={run / 'streams'}")
    commands.run("cronos-streams", "check", *flags)
    info = json.loads((run / "streams/meta/info.json").read_text())
    assert (info["fps"], info["robot_type"], info["total_frames"]) == (20, "point_mass", 240)
    assert info["features"]["action"]["names"] == ["vx", "vy"]
    assert json.loads((run / "streams/meta/cronos.json").read_text())["environment"] == "examples/point_mass-v1"
    commands.run("cronos-publish", "stream", f"--root={run / 'streams'}", "--repo_id=me/pushes")
    assert ("datasets", "me/pushes") in served.repositories


def test_its_policies_are_published_and_evaluated_from_there(run, commands, served, tmp_path, monkeypatch):
    commands.run("cronos-publish", "policy", f"--path={run}", "--repo_id=me/pushing")
    assert ("models", "me/pushing") in served.repositories
    flags = ("--eval.n_episodes=2", "--eval.orderings=2", "--eval.suites=[independent,sequential,stream]")
    output = commands.run(
        "cronos-eval",
        "--policy.path=me/pushing",
        *WORLD,
        *flags,
        "--eval.batch_size=4",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert "push the puck to the left" in output
    results = json.loads((tmp_path / "eval/stream_held_out/results.json").read_text())
    assert (results["environment"], results["n"], results["segments"]) == ("examples/point_mass-v1", 2, 16)
    assert results["by_start"] == {}
    assert all(e["steps"] == 16 * 40 for e in results["episodes"])
    assert list((tmp_path / "eval/independent_train/videos").glob("*.mp4"))
    folders = str(run), str(tmp_path / "eval")
    monkeypatch.setattr("sys.argv", ["cronos-report", *folders, f"--output={tmp_path / 'report'}"])
    report()
    assert (tmp_path / "report/index.html").is_file()
    # It does not say what is grasped.
    written = [run / "metrics.jsonl", *tmp_path.rglob("results.json"), tmp_path / "report/independent.csv"]
    texts = [file.read_text() for file in written]
    assert len(texts) == 8
    assert all("found_complete" in text and "never_grasped" not in text for text in texts)
