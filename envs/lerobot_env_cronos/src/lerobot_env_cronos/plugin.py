"""Registers `--env.type=cronos` and `cronos_hub` with LeRobot, and shortens its log, without importing it.

LeRobot loads torch and transformers. Users of Gymnasium need neither.
"""

import importlib
import importlib.util
import logging
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


class VideoBackendFilter(logging.Filter):
    """Says in one sentence, and once, that videos are decoded by PyAV.

    Without FFmpeg's libraries TorchCodec cannot be loaded, and LeRobot logs its tracebacks, one for each version
    of FFmpeg, whenever a dataset is opened or the flags of `lerobot-train` are read. PyAV brings its own FFmpeg.
    """

    def __init__(self) -> None:
        super().__init__()
        self._said = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Replace LeRobot's message the first time and drop it afterwards; all others stay."""
        if "'torchcodec' is installed but cannot be loaded" not in record.getMessage():
            return True
        record.msg = "Videos are decoded by PyAV; with FFmpeg installed TorchCodec would be about twice as fast."
        record.args = ()
        first, self._said = not self._said, True
        return first


def shorten_video_backend_warning() -> None:
    """Let LeRobot's choice of a video decoder pass through `VideoBackendFilter`."""
    logger = logging.getLogger("lerobot.utils.import_utils")
    if not any(isinstance(old, VideoBackendFilter) for old in logger.filters):
        logger.addFilter(VideoBackendFilter())
