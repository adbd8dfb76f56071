"""What the package's commands share."""

import argparse
from importlib import import_module

from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_env_cronos.scene.scenes import SCENES, Scene, describe_unknown_scene

FLAG = "--discover_packages_path"
"""Names the package to import first, in commands that have it."""


def find_scene(parser: argparse.ArgumentParser, name: str, package: str | None = None) -> Scene:
    """The scene `name`, of this package or an installed plugin, or registered by `package` if one is given.

    Without such a scene the command ends in a sentence.
    """
    try:
        if package is not None:
            import_module(package)
    except ModuleNotFoundError as error:
        parser.error(f"{FLAG}={package}: {error}")
    except ValueError as error:
        parser.error(str(error))
    if name not in SCENES and package is None:
        register_third_party_plugins()
    if name not in SCENES:
        parser.error(describe_unknown_scene(name, FLAG if FLAG in parser.format_usage() else None))
    return SCENES[name]
