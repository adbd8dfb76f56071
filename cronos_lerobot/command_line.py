"""Flags as configs, read as LeRobot's own commands read them."""

from __future__ import annotations

import importlib
import io
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, suppress
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import parser


def parse_command_line(
    config_class: type[Any],
    arguments: Sequence[str] | None = None,
    types: Mapping[str, str] | None = None,
) -> Any:
    """Return the config that flags describe.

    `--config_path` names a file of values that the flags override. `--<field>.discover_packages_path` names a
    module to import. `--<field>.path` is left to the config's own `validate`.

    Args:
        config_class: of the config.
        arguments: the flags; None takes those of the command line.
        types: default types of choice fields, by name.

    Raises:
        ValueError: a flag does not exist.
        FileNotFoundError: there is no file `--config_path`.
        ParsingError: a value does not fit its flag; `scripts.errors.reason` finds why.
        PluginLoadError: a module cannot be imported.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    flags = import_plugins(given)
    file = parser.parse_arg("config_path", flags)
    if file is None:
        flags += _missing_types(flags, types or {})
    elif not Path(file).is_file():
        raise FileNotFoundError(f"--config_path={file}: no such file.")
    paths = config_class.__get_path_fields__() if hasattr(config_class, "__get_path_fields__") else []
    flags = parser.filter_arg("config_path", parser.filter_path_args(paths, flags))
    if file is not None:
        file = parser.extract_path_fields_from_config(file, paths)
    kind = "json" if file is not None and file.endswith(".json") else "yaml"
    said = io.StringIO()
    try:
        with draccus.config_type(kind), redirect_stderr(said):
            config = draccus.parse(config_class, file, flags)
    except SystemExit as exit_:
        # argparse prints all flags, and then the reason.
        wrong = said.getvalue().rpartition(": error: ")[2].strip()
        raise ValueError(f"{wrong}; --help lists the flags") from exit_
    sys.stderr.write(said.getvalue())
    return config


def import_plugins(arguments: Sequence[str]) -> list[str]:
    """Import what `--<field>.discover_packages_path` names; returns the other flags.

    Raises:
        PluginLoadError: a module cannot be imported.
    """
    others = list(arguments)
    for flag, name in parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, arguments).items():
        allow_single_file(name)
        parser.load_plugin(name)
        others = parser.filter_arg(flag, others)
    return others


def allow_single_file(name: str) -> None:
    """Let `discover_packages_path` name a module as well as a package, in which LeRobot looks for more modules."""
    # LeRobot says what cannot be imported.
    with suppress(ImportError):
        module = importlib.import_module(name)
        module.__path__ = getattr(module, "__path__", [])


def _missing_types(arguments: Sequence[str], types: Mapping[str, str]) -> list[str]:
    """draccus wants the type of a choice whenever one of its fields is set."""
    used = [name for name in types if any(argument.startswith(f"--{name}.") for argument in arguments)]
    return [f"--{name}.type={types[name]}" for name in used if parser.get_type_arg(name, arguments) is None]
