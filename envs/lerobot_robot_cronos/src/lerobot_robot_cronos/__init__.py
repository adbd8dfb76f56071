"""A simulated SO-101 and a scripted person beside it, for LeRobot's `--robot.type` and `--teleop.type`."""

import lerobot_env_cronos as lerobot_env_cronos  # isort: skip  # chooses OpenGL's platform before mujoco

from lerobot_robot_cronos.person import CronosPerson as CronosPerson
from lerobot_robot_cronos.person import CronosPersonConfig as CronosPersonConfig
from lerobot_robot_cronos.so101 import CronosSO101 as CronosSO101
from lerobot_robot_cronos.so101 import CronosSO101Config as CronosSO101Config
from lerobot_robot_cronos.so101 import connected_robots as connected_robots
