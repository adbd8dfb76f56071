"""LeRobot's own programs run on the simulated arm: teleoperate, record, replay, rollout, its RL environment."""

import sys
from pathlib import Path
from threading import Event
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import merge_datasets, remove_feature
from lerobot.rl.gym_manipulator import RobotEnv
from lerobot.robots.so_follower import SO101Follower
from lerobot.scripts import lerobot_record, lerobot_replay, lerobot_rollout, lerobot_teleoperate
from lerobot.utils.feature_utils import hw_to_dataset_features
from lerobot_env_cronos import CronosEnvConfig
from lerobot_robot_cronos import CronosSO101
from simulated_arm import CAMERAS, CUBE_ON_PLATE, SCENE, make_robot
from tiny_checkpoints import TINY_ACT, save_policy

from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos

SIZES = {"observation_height": CAMERAS["camera_height"], "observation_width": CAMERAS["camera_width"]}
ENV = {"scene": SCENE, "camera_name": "front,wrist", "num_threads": 1, **SIZES}
OWN_COLUMNS = ["next.reward", "next.success", "next.done", "next.truncated"]
FRONT = "observation.images.front"


@pytest.fixture
def robots(monkeypatch) -> list[CronosSO101]:
    """The arms that a program made."""
    made: list[CronosSO101] = []
    connect = CronosSO101.connect
    monkeypatch.setattr(
        CronosSO101, "connect", lambda self, **options: made.append(self) or connect(self, **options)
    )
    return made


@pytest.fixture
def run(monkeypatch, tmp_path, robots):
    """Run a program with the arm's flags and others; returns its arm."""
    arm = {f"--robot.{key}": value for key, value in CAMERAS.items()}
    arm |= {"--robot.type": "cronos_so101", "--robot.id": "desk", "--robot.calibration_dir": tmp_path}

    def run(program: ModuleType, *flags: str) -> CronosSO101:
        monkeypatch.setattr(sys, "argv", ["lerobot", *(f"{key}={value}" for key, value in arm.items()), *flags])
        program.main()
        return robots.pop()

    return run


def person(folder: Path) -> list[str]:
    return [
        "--teleop.type=cronos_person", "--teleop.robot_id=desk", f"--teleop.calibration_dir={folder}",
        f"--teleop.task={CUBE_ON_PLATE}",
    ]  # fmt: skip


def test_teleoperate(run, tmp_path):
    robot = run(lerobot_teleoperate, *person(tmp_path), "--teleop_time_s=0.5")
    assert 8 <= robot.desk.steps <= 300
    assert (
        np.abs(robot.desk.goal - robot.world.scene.robot.hold(robot.world.scene.robot.home_qpos[None, :5])).max()
        > 1
    )


def record(run, folder: Path) -> LeRobotDataset:
    run(
        lerobot_record, *person(folder), "--dataset.repo_id=me/cubes", f"--dataset.root={folder / 'cubes'}",
        f"--dataset.single_task={CUBE_ON_PLATE}", "--dataset.no_stamp=true", "--dataset.num_episodes=2",
        "--dataset.episode_time_s=1.5", "--dataset.reset_time_s=0.1", "--dataset.streaming_encoding=true",
        "--dataset.rgb_encoder.vcodec=h264", "--dataset.push_to_hub=false", "--play_sounds=false",
    )  # fmt: skip
    return LeRobotDataset("me/cubes", folder / "cubes")


def write_real(arm: SO101Follower, root: Path) -> LeRobotDataset:
    """An episode as `lerobot-record` writes it of this arm."""
    both = {"action": arm.action_features, "observation": arm.observation_features}
    features = {k: v for prefix, own in both.items() for k, v in hw_to_dataset_features(own, prefix).items()}
    dataset = LeRobotDataset.create(
        "me/real", 30, features, root, arm.name, rgb_encoder=RGBEncoderConfig(vcodec="h264")
    )  # fmt: skip
    blank = {
        key: np.zeros(value["shape"], "uint8" if "image" in key else "float32") for key, value in features.items()
    }
    for _ in range(2):
        dataset.add_frame(blank | {"task": CUBE_ON_PLATE})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("me/real", root)


def test_what_is_recorded_merges_with_the_real_arms_and_the_experts_and_is_replayed(run, tmp_path, real_arm):
    recorded = record(run, tmp_path)
    assert recorded.num_episodes == 2
    merged = merge_datasets([recorded, write_real(real_arm, tmp_path / "real")], "me/arms", tmp_path / "arms")
    assert (merged.num_episodes, merged.meta.robot_type) == (3, real_arm.name)

    root = tmp_path / "demos"
    shown = DemoDatasetConfig("me/demos", root, 1)
    record_demos(RecordDemosConfig(env=CronosEnvConfig(**ENV), dataset=shown, num_envs=1))
    # The experts' dataset says more: columns of its own, and how its fixed camera projects.
    demos = remove_feature(LeRobotDataset("me/demos", root), [*OWN_COLUMNS, FRONT], tmp_path / "plain", "me/plain")
    alike = remove_feature(recorded, FRONT, tmp_path / "wrist", "me/wrist")
    assert merge_datasets([alike, demos], "me/both", tmp_path / "both").num_episodes == 3

    robot = run(
        lerobot_replay, "--dataset.repo_id=me/cubes", f"--dataset.root={tmp_path / 'cubes'}",
        "--dataset.episode=1", "--play_sounds=false",
    )  # fmt: skip
    last = int(recorded.meta.episodes[1]["dataset_to_index"]) - 1
    np.testing.assert_array_equal(robot.desk.goal.astype(np.float32), recorded[last]["action"])


def test_rollout_of_an_act(run, tmp_path, monkeypatch):
    handler = SimpleNamespace(shutdown_event=Event())
    monkeypatch.setattr(lerobot_rollout, "ProcessSignalHandler", lambda **_: handler)
    policy = save_policy(tmp_path / "act", "act", ENV, **TINY_ACT)
    flags = ("--duration=0.5", "--device=cpu", "--return_to_initial_position=false", "--strategy.type=base")
    robot = run(lerobot_rollout, f"--policy.path={policy}", *flags)
    # Far from home: what it was trained for is nothing.
    assert robot.desk.steps > 5
    assert not robot.is_connected


def test_the_environment_of_lerobots_rl(tmp_path):
    robot = make_robot(tmp_path, **CAMERAS)
    pose = [10.0, -40.0, 30.0, 80.0, 5.0, 20.0]
    env = RobotEnv(robot, use_gripper=True, reset_pose=pose, reset_time_s=0.0)
    observation, _ = env.reset()
    assert robot.desk.steps == 50
    np.testing.assert_allclose(observation["agent_pos"], pose, atol=4.0)
    assert observation["pixels"]["wrist"].shape == (48, 64, 3)
    env.step(np.array(pose) + 1.0)
    np.testing.assert_array_equal(robot.desk.goal, np.array(pose) + 1.0)
    env.close()
    assert not robot.is_connected
