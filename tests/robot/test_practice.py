"""Practice on the simulated robot by the commands: trained, killed, resumed, recorded, evaluated, compared."""

import json
import subprocess
import sys

import pytest
import torch
import yaml
from forked_commands import run_forked
from lerobot.datasets import LeRobotDataset
from lerobot.rl import ReplayBuffer
from tiny_checkpoints import TINY_ACT, save_policy

from cronos_lerobot.scripts.report import main as report

SHOWN = {"scene": "so101_desk_2x2", "obs_type": "environment_state_agent_pos"}
TRAINING = (
    "--num_envs=1", "--policy.device=cpu", "--algorithm.type=imitation", "--algorithm.warmup_segments=1",
    "--algorithm.steps_per_update=1", "--algorithm.batch_size=8", "--protocol.task_switch_interval=30",
    "--protocol.update_interval=30", "--protocol.scene_reset_interval=60", "--eval_freq=0", "--save_freq=30",
    "--tensorboard=false", "--record.repo_id=me/practice",
)  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file that describes the robot, and a policy."""
    folder = tmp_path_factory.mktemp("robot")
    env = {
        "type": "cronos_robot", "tasks": "so101_desk_2x2", "judge": "sim", "steps_per_task": 30,
        "robot": {
            "type": "cronos_so101", "id": "desk", "real_time": False, "camera_names": [], "privileged_state": True
        },
        "teleop": {
            "type": "cronos_person", "robot_id": "desk", "judges": False, "reset_s": 1, "takeovers": 1,
            "patience_s": 0.5,
        },
    }  # fmt: skip
    (folder / "robot.yaml").write_text(yaml.safe_dump({"env": env}))
    torch.manual_seed(0)
    save_policy(folder / "other", "act", SHOWN, **TINY_ACT)
    return folder / "robot.yaml", save_policy(folder / "policy", "act", SHOWN, **TINY_ACT)


def run(command, files, *flags):
    return run_forked([command, f"--config_path={files[0]}", f"--policy.path={files[1]}", *flags], check=True)


@pytest.fixture(scope="module")
def practice(files, tmp_path_factory):
    """Four segments of one second, with a reset after every second one, in two sittings."""
    folder = tmp_path_factory.mktemp("practice") / "run"
    run("cronos-train", files, *TRAINING, "--steps=60", f"--output_dir={folder}", "--resume=auto")
    run("cronos-train", files, *TRAINING, "--steps=120", f"--output_dir={folder}", "--resume=auto")
    return folder


def kinds(folder):
    lines = [json.loads(line) for line in (folder / "interventions.jsonl").read_text().splitlines()]
    return [(line["kind"], line["during"]) for line in lines]


def test_the_ledger_has_all_that_the_person_did_in_both_sittings(practice):
    # The first placement and the person's help in the first segment; twice. A reset is due after the second
    # segment, and nobody is asked for it, because nothing follows.
    sitting = [("scene_reset", "training"), ("take_over", "training")]
    assert kinds(practice) == 2 * sitting
    last = json.loads((practice / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["interventions_by_kind"]["help"] == 2
    assert last["interventions_by_kind"]["scene_reset"] == 2


def test_the_stream_is_whole_and_is_read_by_lerobot(practice, files, tmp_path):
    flags = ("--dataset.repo_id=me/practice", f"--dataset.root={practice / 'streams'}")
    run_forked(["cronos-streams", "check", *flags], check=True)
    dataset = LeRobotDataset("me/practice", root=practice / "streams")
    assert (dataset.meta.robot_type, dataset.meta.total_frames, dataset.meta.fps) == ("so_follower", 120, 30)
    # The second half of the first segment, and of the first one after it was resumed.
    helped = [bool(frame["intervention"]) for frame in dataset]
    assert 10 <= sum(helped[:30]) <= 16
    assert sum(helped[30:60]) == 0
    keys = ["observation.state", "observation.environment_state"]
    assert len(ReplayBuffer.from_lerobot_dataset(dataset, device="cpu", state_keys=keys, capacity=200)) == 120
    training = (*flags, "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--steps=1")
    small = [f"--policy.{name}={value}".replace("=None", "=null") for name, value in TINY_ACT.items()]
    output = f"--output_dir={tmp_path / 'clone'}"
    run_forked(["lerobot-train", *training, *small, "--batch_size=4", "--num_workers=0", output], check=True)


def test_evaluations_are_counted_apart_and_compared_by_start(files, tmp_path, monkeypatch, capsys):
    flags = ("--eval.suites=[independent]", "--eval.splits=[train]", "--eval.n_episodes=1", "--eval.videos=0")
    for name, policy in (("before", files[1]), ("after", files[1].with_name("other"))):
        run("cronos-eval", (files[0], policy), *flags, f"--output_dir={tmp_path / name}")
    assert kinds(tmp_path / "after").count(("scene_reset", "evaluation")) == 4
    results = json.loads((tmp_path / "after/independent_train/results.json").read_text())
    assert (results["environment"], results["n"]) == ("cronos_robot/so101_desk_2x2-v1", 4)
    assert "judge sim" in results["benchmark"]["source"]
    monkeypatch.setattr(
        sys, "argv", ["cronos-report", "compare", str(tmp_path / "before"), str(tmp_path / "after")]
    )
    report()
    assert "4" in capsys.readouterr().out


def test_a_person_who_is_not_there_is_an_error(files, tmp_path):
    robot = yaml.safe_load(files[0].read_text())
    del robot["env"]["teleop"]
    file = tmp_path / "alone.yaml"
    file.write_text(yaml.safe_dump(robot))
    with pytest.raises(subprocess.CalledProcessError) as error:
        run("cronos-train", (file, files[1]), *TRAINING, "--steps=30", f"--output_dir={tmp_path / 'run'}")
    assert "nobody is beside the robot" in error.value.stderr
