"""Commands such as `cronos-publish policy`, whose first word says which config the flags are of."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from cronos_lerobot.command_line import import_plugins, parse_command_line
from cronos_lerobot.scripts.errors import error_line
from cronos_lerobot.scripts.flags import join_values


def run_subcommand(commands: Mapping[str, tuple[type, Callable[[Any], None]]], *errors: type[Exception]) -> None:
    """Parse the command line and run the command that it names; `entry` has answered unknown names.

    Args:
        commands: config class and function by name.
        errors: end the program with one line, as the user's errors do.
    """
    name, *arguments = sys.argv[1:]
    config_class, run = commands[name]
    with error_line(ImportError, *errors):
        run(parse_command_line(config_class, quote_texts(config_class, import_plugins(arguments))))


def quote_texts(config_class: type, arguments: Sequence[str]) -> list[str]:
    """A command line on which texts and paths stay what they are. draccus reads every value as YAML.

    Without quotes `--title="Kitchen: two plates"` is a mapping, and `--root="run #1"` the folder `run`.

    Args:
        config_class: a dataclass with the flags.
        arguments: `--name=value` or `--name value`.
    """
    quoted = []
    for flag in join_values(arguments):
        name, equals, value = flag.partition("=")
        if value not in ("", "null") and _is_text(config_class, name.removeprefix("--").split(".")):
            value = json.dumps(value, ensure_ascii=False)
        quoted.append(f"{name}{equals}{value}")
    return quoted


def _is_text(config_class: type, names: Sequence[str]) -> bool:
    """Whether the field `names` of nested dataclasses is a text or a path."""
    hint = get_type_hints(config_class).get(names[0])
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if len(names) == 1:
        return bool({str, Path} & set(kinds))
    return any(is_dataclass(kind) and _is_text(kind, names[1:]) for kind in kinds)
