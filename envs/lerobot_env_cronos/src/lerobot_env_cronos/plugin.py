"""Registers `--env.type=cronos` and `cronos_hub` with LeRobot, without importing it.

LeRobot loads torch and transformers. Users of Gymnasium need neither.
"""

import importlib
import importlib.util
import sys
from importlib.abc import MetaPathFinder

LEROBOT_CONFIGS = "lerobot.envs.configs"


def register_with_lerobot() -> None:
    """Register the configs now if LeRobot's are imported, else as soon as they are."""
    if LEROBOT_CONFIGS in sys.modules:
        _import_configs()
    else:
        sys.meta_path.insert(0, _AfterLeRobot())


def _import_configs() -> None:
    importlib.import_module("lerobot_env_cronos.config")


class _AfterLeRobot(MetaPathFinder):
    """Finds LeRobot's config module where it is, and adds a call after its execution."""

    def find_spec(self, fullname, path=None, target=None):
        if fullname != LEROBOT_CONFIGS:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module):
                execute(module)
                _import_configs()

            spec.loader.exec_module = execute_and_register
        return spec
