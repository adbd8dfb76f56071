"""The frozen benchmark configurations are what the command draws; bodies lie in view, and stay."""

import sys
from importlib import resources

import numpy as np
import pytest
from env_rollouts import keep_still, make
from lerobot_env_cronos import SCENES
from lerobot_env_cronos.benchmark import freeze
from lerobot_env_cronos.benchmark.configurations import (
    SPLITS,
    footprint_corners,
    footprint_gap,
    load_configurations,
)
from lerobot_env_cronos.scene.scenes import BODIES

DATA = resources.files("lerobot_env_cronos").joinpath("data")


@pytest.mark.parametrize(("what", "packaged"), [("configurations", "{}.json"), ("orderings", "orderings/{}.json")])
def test_the_command_draws_what_is_frozen(tmp_path, monkeypatch, what, packaged):
    monkeypatch.setattr(sys, "argv", ["freeze", what, "playroom_2x2", f"--output={tmp_path}"])
    freeze.main()
    path = tmp_path / "playroom_2x2.json"
    assert path.read_bytes() == DATA.joinpath(packaged.format("playroom_2x2")).read_bytes()


def test_footprint_gap_by_hand():
    plate = footprint_corners("yellow plate", np.array([0.0, 0.0]), 0.0)  # 0.11 x 0.11
    cloth = footprint_corners("cloth", np.array([0.15, 0.02]), 0.0)
    assert footprint_gap(plate, cloth) == pytest.approx(0.04)
    overlapping = footprint_corners("cloth", np.array([0.10, 0.0]), 0.0)
    assert footprint_gap(plate, overlapping) == pytest.approx(-0.01)
    # Turned by 45 degrees, its corner reaches 0.055 * sqrt(2) towards the plate.
    turned = footprint_corners("cloth", np.array([0.15, 0.0]), np.pi / 4)
    assert footprint_gap(plate, turned) == pytest.approx(0.15 - 0.055 - 0.055 * np.sqrt(2))


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("scene", SCENES)
def test_doing_nothing_moves_nothing_and_completes_nothing(scene, split):
    poses = load_configurations(scene, split)
    env = make(64, scene)
    env.scene_reset(np.arange(64), np.arange(64), split)
    keep_still(env, 2 * env.fps)
    assert np.abs(env.simulation.body_poses() - poses)[..., :3].max() < 2e-3
    assert np.abs(env.simulation.qvel[:, env.scene.robot.num_robot_joints :]).max() < 1e-6
    assert not env.find_complete(env.scene.tasks).any()
    assert not env.unsuitable_bodies().any()


@pytest.mark.parametrize("scene", SCENES)
def test_every_body_is_in_the_picture(scene):
    poses = np.concatenate([load_configurations(scene, split) for split in SPLITS])
    for i, name in enumerate(SCENES[scene].bodies):
        yaws = 2 * np.arctan2(poses[:, i, 6], poses[:, i, 3])
        corners = np.stack([footprint_corners(name, p[:2], yaw) for p, yaw in zip(poses[:, i], yaws)])
        for height in (0.0, BODIES[name].size[2]):
            assert (
                SCENES[scene]
                .robot.sees(np.concatenate([corners, np.full((*corners.shape[:2], 1), height)], -1))
                .all()
            )
