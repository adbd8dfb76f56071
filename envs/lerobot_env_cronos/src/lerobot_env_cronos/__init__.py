"""CRONOS scenes as a LeRobot environment plugin."""

from lerobot_env_cronos.simulation import gl as gl  # isort: skip  # chooses OpenGL's platform before mujoco

from lerobot_env_cronos.autoreset import CronosGymVectorEnv
from lerobot_env_cronos.benchmark.benchmark import Benchmark, EpisodeGroup
from lerobot_env_cronos.benchmark.load import load_benchmark
from lerobot_env_cronos.benchmark.orderings import load_orderings
from lerobot_env_cronos.benchmark.registry import register_gymnasium, register_scene
from lerobot_env_cronos.benchmark.version import VERSION, check_environment_id, gymnasium_id
from lerobot_env_cronos.config import CronosEnvConfig
from lerobot_env_cronos.episodic import CronosEnv, IndependentVectorEnv
from lerobot_env_cronos.hub_config import CronosHubEnvConfig
from lerobot_env_cronos.lerobot_log import shorten_video_backend_warning
from lerobot_env_cronos.scene.scenes import CONTROL_HZ, SCENES, STEPS_PER_TASK, Body, Scene, Task, get_scene
from lerobot_env_cronos.sequential import SequentialVectorEnv
from lerobot_env_cronos.vector_env import CronosVectorEnv

register_gymnasium()
shorten_video_backend_warning()

__all__ = [
    "CONTROL_HZ",
    "SCENES",
    "STEPS_PER_TASK",
    "VERSION",
    "Benchmark",
    "Body",
    "CronosEnv",
    "CronosEnvConfig",
    "CronosGymVectorEnv",
    "CronosHubEnvConfig",
    "CronosVectorEnv",
    "EpisodeGroup",
    "IndependentVectorEnv",
    "Scene",
    "SequentialVectorEnv",
    "Task",
    "check_environment_id",
    "get_scene",
    "gymnasium_id",
    "load_benchmark",
    "load_orderings",
    "register_scene",
]
