"""The real arm, as far as it exists without hardware."""

from types import SimpleNamespace

import pytest
from lerobot.cameras.opencv import OpenCVCameraConfig
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig, so_follower
from simulated_arm import CAMERAS


def no_bus(port, motors, calibration):
    """Motors alone: LeRobot's class needs the servos' SDK."""
    return SimpleNamespace(motors=motors, is_connected=False)


@pytest.fixture
def real_arm(monkeypatch, tmp_path) -> SO101Follower:
    """LeRobot's robot, but for its serial port."""
    monkeypatch.setattr(so_follower, "FeetechMotorsBus", no_bus)
    size = {"fps": 30, "width": CAMERAS["camera_width"], "height": CAMERAS["camera_height"]}
    cameras = {name: OpenCVCameraConfig(index_or_path=0, **size) for name in CAMERAS["camera_names"]}
    return SO101Follower(SO101FollowerConfig(port="none", cameras=cameras, calibration_dir=tmp_path))
