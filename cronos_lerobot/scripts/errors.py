"""One `error:` line for what a user got wrong, the same in every command."""

from __future__ import annotations

import io
import sys
from argparse import ArgumentError
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stderr
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, NoReturn, get_args, get_type_hints

from draccus.utils import ParsingError
from httpx import HTTPError, TransportError
from lerobot.configs import parser
from lerobot.configs.parser import PluginLoadError
from safetensors import SafetensorError
from yaml import YAMLError

from cronos_lerobot.training.resume import allow_single_file

USER_ERRORS = (
    ValueError, OSError, ParsingError, ArgumentError, PluginLoadError, SafetensorError, HTTPError, YAMLError,
)  # fmt: skip
"""What a wrong flag, a missing file or a damaged one raises, or the Hub. Any other error is a bug and shows its
traceback."""


@contextmanager
def error_line(*more: type[Exception]) -> Generator[None]:
    """End the program with status 1 and one line, `error: <what is wrong>`, in place of a traceback.

    A context manager and a decorator. It belongs around what reads flags and files, not around the work itself,
    whose errors are bugs.

    Args:
        more: errors that are the user's here, beside USER_ERRORS.
    """
    try:
        yield
    except (*USER_ERRORS, *more) as error:
        stop(error)


def stop(error: Exception | str) -> NoReturn:
    """End the program with status 1 and `error: <reason>` on one line."""
    sys.exit(f"error: {reason(error)}")


def reason(error: Exception | str) -> str:
    """What an error says, on one line; draccus hides the reason in the cause."""
    if isinstance(error, ParsingError) and error.__cause__ is not None:
        return reason(error.__cause__)  # ty: ignore[invalid-argument-type]
    if isinstance(error, TransportError):
        return (
            f"the Hub was not reached ({type(error).__name__}: {error}); what is not on this machine, "
            "by its name or in the folder that a flag gives, is looked for there"
        )
    text = " ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return text or type(error).__name__


def parse_command_line(
    config_class: type[Any],
    types: Mapping[str, str] | None = None,
    check_type: Mapping[str, Callable[[str], None]] | None = None,
) -> Any:
    """Return the config that the command line describes, read as `lerobot-train` reads it.

    `--<field>.path`, `--config_path` and `--<field>.discover_packages_path` are understood. An unknown flag ends
    the program with status 2 and one line. Errors are those of USER_ERRORS, so it stands within `error_line`.

    Args:
        config_class: of the config.
        types: types of choice fields by name, for a command line that sets their fields without `--<field>.type`.
        check_type: by name of a choice field, what raises a ValueError that names its valid types: argparse names
            every registered one.
    """

    def keep(config: Any) -> Any:
        return config

    keep.__annotations__["config"] = config_class
    given, said = sys.argv, io.StringIO()
    config_path = parser.parse_arg("config_path", given[1:])
    if config_path is not None and not Path(config_path).exists():
        raise FileNotFoundError(f"--config_path={config_path}: no such file or folder")
    sys.argv = [*given, *_missing_types(given, types or {})]
    for name in parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, given).values():
        allow_single_file(name)
    try:
        with redirect_stderr(said):
            config = parser.wrap()(keep)()  # ty: ignore[missing-argument]  (it reads the command line)
    except ParsingError as error:
        # What configs log, because draccus drops the reason of an error, `reason` finds without it.
        if isinstance(error.__cause__, TypeError) and (flags := _null_flags(given[1:])):
            raise ValueError(f"null is no value of {' or '.join(f'--{flag}' for flag in flags)}") from error
        raise
    except SystemExit as exit_:
        _, _, wrong = said.getvalue().rpartition(": error: ")
        if exit_.code != 2 or not wrong:
            sys.stderr.write(said.getvalue())
            raise
        for field, check in (check_type or {}).items():
            if name := parser.get_type_arg(field, given[1:]):
                check(name)
        # argparse prints all flags before it.
        sys.stderr.write(f"error: {reason(wrong)}; --help lists the flags\n")
        raise
    except BaseException:
        sys.stderr.write(said.getvalue())
        raise
    finally:
        sys.argv = given
    sys.stderr.write(said.getvalue())
    for flag in _null_flags(given[1:]):
        if not _takes_null(config, flag):
            raise ValueError(f"null is no value of --{flag}")
    return config


def _null_flags(arguments: list[str]) -> list[str]:
    """The flags that are given as null, without their dashes."""
    # `--name value` is read as `--name=value` is.
    pairs = (
        [*argument.removeprefix("--").split("=", 1), following]
        for argument, following in zip(arguments, [*arguments[1:], ""], strict=True)
        if argument.startswith("--")
    )
    return [name for name, value, *_ in pairs if value in ("null", "~")]


def _takes_null(config: Any, flag: str) -> bool:
    """Whether a field of a config may be None, if it is; draccus gives it to numbers and booleans, too."""
    *groups, name = flag.split(".")
    for group in groups:
        config = getattr(config, group, None)
    field = next((f for f in fields(config) if f.name == name), None) if is_dataclass(config) else None
    if field is None or field.default is None or getattr(config, name) is not None:
        return True
    return NoneType in get_args(get_type_hints(type(config))[name])


def _missing_types(arguments: list[str], types: Mapping[str, str]) -> list[str]:
    """draccus wants the type of a choice whenever one of its fields is set; its help says what they are."""
    asks = "--help" in arguments or "-h" in arguments
    if parser.parse_arg("config_path", arguments) is not None:
        return []
    fields = [field for field in types if asks or any(a.startswith(f"--{field}.") for a in arguments)]
    return [f"--{field}.type={types[field]}" for field in fields if parser.get_type_arg(field, arguments) is None]
