"""CRONOS scenes as a LeRobot environment plugin."""

from lerobot_env_cronos.scenes import CONTROL_HZ, SCENES, STEPS_PER_TASK, Scene, Task, get_scene
from lerobot_env_cronos.vector_env import CronosVectorEnv

__all__ = ["CONTROL_HZ", "SCENES", "STEPS_PER_TASK", "CronosVectorEnv", "Scene", "Task", "get_scene"]
