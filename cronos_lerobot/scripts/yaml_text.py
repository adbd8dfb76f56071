"""Values of flags as the text that they are: the parser of LeRobot's commands and ours reads YAML."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import yaml


def is_plain(value: str) -> bool:
    """Whether the value of a flag is to a parser that reads YAML the text that it is."""
    try:
        return yaml.safe_load(value) == value
    except yaml.YAMLError:
        return False


def quoted_texts(config_class: type, arguments: Sequence[str]) -> list[str]:
    """A command line for a config, quoted where a name, a title or a path would be read as something else.

    `--title="Kitchen: two plates"` is no mapping, `--root="my run #1"` no folder `my run`. `null` stays null.

    Args:
        config_class: a dataclass, whose fields of text are looked at.
        arguments: as given, `--name=value` or `--name value`.
    """
    quoted, flag = [], None
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if flag is not None and not argument.startswith("--"):
            quoted.append(_quoted(argument))
        elif equals and _is_text(config_class, name):
            quoted.append(f"{name}={_quoted(value)}")
        else:
            quoted.append(argument)
        flag = argument if not equals and _is_text(config_class, argument) else None
    return quoted


def _quoted(value: str) -> str:
    return value if value in ("", "null") or is_plain(value) else json.dumps(value)


def _is_text(config_class: Any, flag: str) -> bool:
    """Whether a flag is of a field of text, or a path."""
    *groups, name = flag.removeprefix("--").split(".")
    for group in groups:
        kinds = _kinds(config_class, group)
        config_class = next((kind for kind in kinds if is_dataclass(kind)), None)
    return bool({str, Path} & set(_kinds(config_class, name)))


def _kinds(config_class: Any, name: str) -> tuple[Any, ...]:
    if config_class is None:
        return ()
    hint = get_type_hints(config_class).get(name)
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
