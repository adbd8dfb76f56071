"""Flags as configs, read as LeRobot's own commands read them."""

from __future__ import annotations

import importlib
import io
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

import draccus
from draccus.utils import ParsingError
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
        ValueError: a flag does not exist, or its value is null where it cannot be.
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
    with _one_reason(given), draccus.config_type(kind):
        config = draccus.parse(config_class, file, flags)
    for flag in _null_flags(given):
        if not _takes_null(config, flag):
            raise ValueError(f"null is no value of --{flag}")
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


@contextmanager
def _one_reason(arguments: Sequence[str]) -> Generator[None]:
    """Turn what argparse prints, all flags and then the reason, into a ValueError with the reason."""
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            yield
    except SystemExit as exit_:
        wrong = said.getvalue().rpartition(": error: ")[2].strip()
        raise ValueError(f"{wrong}; --help lists the flags") from exit_
    except ParsingError as error:
        # Logged by configs, because draccus hides the reason: `reason` finds it again.
        if isinstance(error.__cause__, TypeError) and (flags := _null_flags(arguments)):
            raise ValueError(f"null is no value of {' or '.join(f'--{flag}' for flag in flags)}") from error
        raise
    sys.stderr.write(said.getvalue())


def _null_flags(arguments: Sequence[str]) -> list[str]:
    """The flags that are given as null, without their dashes."""
    found = []
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, equals, value = argument.partition("=")
        if name.startswith("--") and (value if equals else following) in ("null", "~"):
            found.append(name.removeprefix("--"))
    return found


def _takes_null(config: Any, flag: str) -> bool:
    """Whether a field of a config may be None; draccus gives None to numbers and booleans, too."""
    *groups, name = flag.split(".")
    for group in groups:
        config = getattr(config, group, None)
    field = next((f for f in fields(config) if f.name == name), None) if is_dataclass(config) else None
    if field is None or field.default is None or getattr(config, name) is not None:
        return True
    return NoneType in get_args(get_type_hints(type(config))[name])


def _missing_types(arguments: Sequence[str], types: Mapping[str, str]) -> list[str]:
    """draccus wants the type of a choice whenever one of its fields is set."""
    used = [name for name in types if any(argument.startswith(f"--{name}.") for argument in arguments)]
    return [f"--{name}.type={types[name]}" for name in used if parser.get_type_arg(name, arguments) is None]
