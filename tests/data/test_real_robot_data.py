"""LeRobot's recordings of a real SO-101 merge with our demonstrations, and an ACT acts in the scene.

Everything but the bus and the cameras is LeRobot's own: its arm, its leader, its programs.
"""

import json
import sys

import numpy as np
import pytest
from forked_commands import run_forked
from lerobot.cameras.opencv import OpenCVCameraConfig
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.aggregate import validate_all_metadata
from lerobot.robots.so_follower import SO101FollowerConfig, SOFollower
from lerobot.scripts import lerobot_edit_dataset
from lerobot.scripts.lerobot_record import RecordConfig, record
from lerobot.teleoperators.so_leader import SO101LeaderConfig, SOLeader
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv, ScriptedExpert
from tiny_checkpoints import TINY_ACT

from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos

SCENE, CAMERAS, SIZE = "so101_desk_2x2", "front,wrist", {"observation_height": 48, "observation_width": 64}
OVERWRITE = "--operation.overwrite=true"
OURS = "--operation.feature_names=['next.reward', 'next.success', 'next.done', 'next.truncated']"
ENV = ["--env.type=cronos", f"--env.scene={SCENE}", f"--env.camera_name={CAMERAS}"]
ENV += [f"--env.{name}={value}" for name, value in SIZE.items()]


def record_real(root, monkeypatch):
    """Two episodes by `lerobot-record`, of an arm whose motors and cameras are those of the scene."""
    env = CronosVectorEnv(1, SCENE, obs_type="pixels_agent_pos", camera_name=CAMERAS, num_threads=1, **SIZE)
    expert = ScriptedExpert(env)

    def observe(_):
        seen = env.observe()
        pictures = {name: frames[0] for name, frames in seen["pixels"].items()}
        return dict(zip(env.state_names, seen["agent_pos"][0].tolist(), strict=True)) | pictures

    def send(_, action):
        env.step(np.array([[action[name] for name in env.action_names]]))
        return action

    for kind in (SOFollower, SOLeader):
        monkeypatch.setattr(kind, "connect", lambda _: None)
        monkeypatch.setattr(kind, "is_connected", False)
    monkeypatch.setattr(SOFollower, "get_observation", observe)
    monkeypatch.setattr(SOFollower, "send_action", send)
    lead = lambda _: dict(zip(env.action_names, expert.act()[0].tolist(), strict=True))  # noqa: E731
    monkeypatch.setattr(SOLeader, "get_action", lead)
    cameras = {
        name: OpenCVCameraConfig(
            index_or_path=i, fps=30, height=SIZE["observation_height"], width=SIZE["observation_width"]
        )
        for i, name in enumerate(CAMERAS.split(","))
    }
    record(
        RecordConfig(
            robot=SO101FollowerConfig(port="none", cameras=cameras),
            teleop=SO101LeaderConfig(port="none"),
            dataset=DatasetRecordConfig(
                "me/real",
                "put the cube on the plate",
                root,
                num_episodes=2,
                episode_time_s=0.6,
                reset_time_s=0,
                push_to_hub=False,
            ),
            play_sounds=False,
        )
    )
    return root


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Real and simulated data, and what LeRobot's tools make of them."""
    root = tmp_path_factory.mktemp("bridge")
    with pytest.MonkeyPatch.context() as monkeypatch:
        record_real(root / "real", monkeypatch)
    env = CronosEnvConfig(
        scene=SCENE, camera_name=CAMERAS, task="put the cube on the box lid", num_threads=1, **SIZE
    )
    record_demos(
        RecordDemosConfig(env=env, dataset=DemoDatasetConfig("me/simulated", root / "simulated", 2), num_envs=2)
    )
    plain = ["--new_repo_id=me/plain", f"--new_root={root}/plain"]
    for flags in (
        [*plain, "--repo_id=me/simulated", f"--root={root}/simulated", "--operation.type=remove_feature", OURS],
        [*plain, "--repo_id=me/plain", f"--root={root}/plain", "--operation.type=reencode_videos", OVERWRITE],
        ["--new_repo_id=me/both", f"--new_root={root}/both", "--operation.type=merge",
         "--operation.repo_ids=['me/real', 'me/plain']", f"--operation.roots=['{root}/real', '{root}/plain']"],
    ):  # fmt: skip
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(sys, "argv", ["lerobot-edit-dataset", *flags])
            lerobot_edit_dataset.main()
    return root


def load(folders, name):
    return LeRobotDataset(f"me/{name}", root=folders / name)


def test_real_and_simulated_episodes_are_merged(folders):
    real, simulated, plain, both = (load(folders, name) for name in ("real", "simulated", "plain", "both"))
    with pytest.raises(ValueError, match="Same features"):
        validate_all_metadata([real.meta, simulated.meta])
    assert both.meta.robot_type == real.meta.robot_type == "so_follower"
    assert both.fps == 30
    assert both.meta.features.keys() == real.meta.features.keys()
    assert set(both.meta.camera_keys) == {"observation.images.front", "observation.images.wrist"}
    assert both.meta.features["action"]["names"] == simulated.meta.features["observation.state"]["names"]
    assert len(real) > 8
    assert (both.num_episodes, len(both)) == (4, len(real) + len(simulated))
    assert set(both.meta.tasks.index) == {"put the cube on the plate", "put the cube on the box lid"}
    for frame, source, index in ((3, real, 3), (len(real) + 30, plain, 30), (len(both) - 1, plain, -1)):
        ours, theirs = both[frame], source[index % len(source)]
        assert ours["task"] == theirs["task"]
        for key in ("observation.state", "action", *both.meta.camera_keys):
            assert (ours[key] == theirs[key]).all()
    before, after = (dataset[40]["observation.images.front"] for dataset in (simulated, plain))
    assert 0 < (before - after).abs().mean() < 0.03


def test_act_of_real_and_of_merged_data_acts_in_the_scene(folders, tmp_path):
    policies = {}
    flags = [f"--policy.{name}={'null' if value is None else value}" for name, value in TINY_ACT.items()]
    for name in ("real", "both"):
        command = ["lerobot-train", f"--dataset.repo_id=me/{name}", f"--dataset.root={folders / name}", *flags]
        command += ["--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--num_workers=0"]
        command += ["--batch_size=2", "--steps=2", "--save_freq=2", f"--output_dir={tmp_path / name}"]
        run_forked(command, check=True)
        policies[name] = tmp_path / name / "checkpoints/last/pretrained_model"
    outputs = {name: tmp_path / name / "results" for name in policies}
    command = [
        "lerobot-eval",
        f"--policy.path={policies['real']}",
        "--policy.device=cpu",
        *ENV,
        "--eval.n_episodes=1",
    ]
    run_forked(
        [
            *command,
            "--env.task=put the cube on the plate",
            "--env.render_size=[32, 32]",
            f"--output_dir={outputs['real']}",
        ],
        check=True,
    )
    assert json.loads((outputs["real"] / "eval_info.json").read_text())["overall"]["n_episodes"] == 1
    command = ["cronos-eval", f"--policy.path={policies['both']}", "--policy.device=cpu", *ENV]
    command += ["--eval.n_episodes=1", "--eval.suites=[independent]", "--eval.splits=[train]", "--eval.videos=0"]
    run_forked([*command, f"--output_dir={outputs['both']}"], check=True)
    (results,) = outputs["both"].rglob("results.json")
    assert json.loads(results.read_text())["n"] == 4
