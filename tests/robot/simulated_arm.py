"""Arms and persons for tests: without cameras, as fast as they go."""

from pathlib import Path

from lerobot_robot_cronos import CronosPerson, CronosPersonConfig, CronosSO101, CronosSO101Config

SCENE, CUBE_ON_PLATE = "so101_desk_2x2", "put the cube on the plate"
CAMERAS = {"camera_names": ["front", "wrist"], "camera_height": 48, "camera_width": 64}


def make_robot(folder: Path, **options) -> CronosSO101:
    """An arm that is not connected yet."""
    fast = {"id": "desk", "real_time": False, "camera_names": []}
    return CronosSO101(CronosSO101Config(**(fast | {"calibration_dir": folder} | options)))


def connect_both(folder: Path, start: int = 0, **options) -> tuple[CronosSO101, CronosPerson]:
    """An arm and the person beside it."""
    robot = make_robot(folder, start=start)
    person = CronosPerson(CronosPersonConfig(robot_id="desk", calibration_dir=folder, **options))
    robot.connect()
    person.connect()
    return robot, person
