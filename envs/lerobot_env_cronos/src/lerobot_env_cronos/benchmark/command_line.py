"""What the package's commands share."""

import argparse
from importlib import import_module

from lerobot_env_cronos.scene.scenes import Scene, get_scene


def find_scene(parser: argparse.ArgumentParser, name: str, package: str | None = None) -> Scene:
    """The scene `name`, which `package` registers if one is given; without it the command ends in a sentence."""
    try:
        if package is not None:
            import_module(package)
        return get_scene(name)
    except ModuleNotFoundError as error:
        parser.error(f"--discover_packages_path={package}: {error}")
    except ValueError as error:
        parser.error(str(error))
