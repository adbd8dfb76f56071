"""CRONOS scenes as Gymnasium environments and as a LeRobot environment plugin.

Names are imported when they are first used, so `import lerobot_env_cronos` needs neither MuJoCo nor LeRobot.
"""

import importlib
from typing import TYPE_CHECKING

from lerobot_env_cronos.simulation import gl as gl  # isort: skip  # chooses OpenGL's platform before mujoco

from lerobot_env_cronos.benchmark.version import register_gymnasium
from lerobot_env_cronos.plugin import register_with_lerobot, shorten_video_backend_warning
from lerobot_env_cronos.scene.scenes import SCENES as SCENES

if TYPE_CHECKING:
    from lerobot_env_cronos.autoreset import CronosGymVectorEnv as CronosGymVectorEnv
    from lerobot_env_cronos.benchmark.benchmark import Benchmark as Benchmark
    from lerobot_env_cronos.benchmark.benchmark import EpisodeGroup as EpisodeGroup
    from lerobot_env_cronos.benchmark.benchmark import packaged_benchmark as packaged_benchmark
    from lerobot_env_cronos.benchmark.files import write_benchmark as write_benchmark
    from lerobot_env_cronos.benchmark.load import load_benchmark as load_benchmark
    from lerobot_env_cronos.benchmark.orderings import load_orderings as load_orderings
    from lerobot_env_cronos.benchmark.registry import register_scene as register_scene
    from lerobot_env_cronos.benchmark.version import check_environment_id as check_environment_id
    from lerobot_env_cronos.benchmark.version import gymnasium_id as gymnasium_id
    from lerobot_env_cronos.config import CronosEnvConfig as CronosEnvConfig
    from lerobot_env_cronos.config import CronosHubEnvConfig as CronosHubEnvConfig
    from lerobot_env_cronos.episodic import CronosEnv as CronosEnv
    from lerobot_env_cronos.episodic import IndependentVectorEnv as IndependentVectorEnv
    from lerobot_env_cronos.expert.expert import ScriptedExpert as ScriptedExpert
    from lerobot_env_cronos.scene.scenes import Body as Body
    from lerobot_env_cronos.scene.scenes import Scene as Scene
    from lerobot_env_cronos.scene.scenes import Task as Task
    from lerobot_env_cronos.scene.scenes import get_scene as get_scene
    from lerobot_env_cronos.sequential import SequentialVectorEnv as SequentialVectorEnv
    from lerobot_env_cronos.vector_env import CronosVectorEnv as CronosVectorEnv
    from lerobot_env_cronos.vector_env import EnvIdentity as EnvIdentity

_MODULES = {
    "autoreset": "CronosGymVectorEnv",
    "benchmark.benchmark": "Benchmark EpisodeGroup packaged_benchmark",
    "benchmark.load": "load_benchmark",
    "benchmark.files": "write_benchmark",
    "benchmark.orderings": "load_orderings",
    "benchmark.registry": "register_scene",
    "benchmark.version": "check_environment_id gymnasium_id",
    "config": "CronosEnvConfig CronosHubEnvConfig",
    "episodic": "CronosEnv IndependentVectorEnv",
    "expert.expert": "ScriptedExpert",
    "scene.scenes": "Body Scene Task get_scene",
    "sequential": "SequentialVectorEnv",
    "vector_env": "CronosVectorEnv EnvIdentity",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF})


register_gymnasium()
shorten_video_backend_warning()
register_with_lerobot()
