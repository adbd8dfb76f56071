"""Commands such as `cronos-publish policy`, whose first word says which config the flags are of."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import draccus
from draccus.utils import ParsingError
from httpx import HTTPError
from yaml import YAMLError

from cronos_lerobot.scripts.errors import stop


def run_subcommand(
    help_text: str,
    commands: Mapping[str, tuple[type, Callable[[Any], None]]],
    errors: tuple[type[Exception], ...] = (ValueError, OSError),
) -> None:
    """Parse the command line and run the command that it names.

    Args:
        help_text: printed for `--help` and where no command is given.
        commands: config class and function by name.
        errors: end the program with one line; any other is a bug and shows its traceback.
    """
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h"):
        print(help_text)
        return
    if name not in commands:
        sys.exit(f"error: unknown command {name!r}; valid commands: {list(commands)}")
    config_class, run = commands[name]
    try:
        run(draccus.parse(config_class, args=quote_texts(config_class, arguments)))
    except (*errors, ParsingError, YAMLError, HTTPError) as error:
        stop(error)


def quote_texts(config_class: type, arguments: Sequence[str]) -> list[str]:
    """A command line on which texts and paths stay what they are. draccus reads every value as YAML.

    Without quotes `--title="Kitchen: two plates"` is a mapping, and `--root="run #1"` the folder `run`.

    Args:
        config_class: a dataclass with the flags.
        arguments: `--name=value` or `--name value`.
    """
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1].startswith("--") and "=" not in joined[-1] and not argument.startswith("--"):
            argument = f"{joined.pop()}={argument}"
        joined.append(argument)
    pairs = [argument.partition("=") for argument in joined]
    return [
        f"{name}={json.dumps(value, ensure_ascii=False)}"
        if value not in ("", "null") and _is_text(config_class, name.removeprefix("--").split("."))
        else f"{name}{equals}{value}"
        for name, equals, value in pairs
    ]


def _is_text(config_class: type, names: Sequence[str]) -> bool:
    """Whether the field `names` of nested dataclasses is a text or a path."""
    hint = get_type_hints(config_class).get(names[0])
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if len(names) == 1:
        return bool({str, Path} & set(kinds))
    return any(is_dataclass(kind) and _is_text(kind, names[1:]) for kind in kinds)
