"""Which classes the processors of a checkpoint may name: LeRobot imports and calls whatever they say."""

from __future__ import annotations

import importlib
import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from lerobot.processor import ProcessorStep
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

FILES = tuple(f"{name}.json" for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME))


def check_processor_classes(path: str | Path, revision: str | None = None) -> None:
    """Check that a checkpoint's processors name steps of LeRobot, or of modules that are imported already.

    Args:
        path: the checkpoint, a folder or a repository of the Hub.
        revision: of the repository.

    Raises:
        ValueError: a class is none; `--<field>.discover_packages_path` imports your own.
        OSError: the Hub has no such file.
    """
    for name in FILES:
        file = Path(path) / name
        if not Path(path).is_dir():
            file = Path(hf_hub_download(str(path), name, revision=revision))
        if not file.is_file():
            continue
        for step in json.loads(file.read_text())["steps"]:
            if (named := step.get("class")) and not _is_step(str(named)):
                raise ValueError(
                    f"{file} names {named}, which is no step of LeRobot or of an imported module: it is not run. "
                    "--policy.discover_packages_path=<package> imports your own steps."
                )


def _is_step(path: str) -> bool:
    module, _, name = path.rpartition(".")
    if module.partition(".")[0] == "lerobot":
        with suppress(ImportError):
            importlib.import_module(module)
    found: Any = getattr(sys.modules.get(module), name, None)
    return isinstance(found, type) and issubclass(found, ProcessorStep)
