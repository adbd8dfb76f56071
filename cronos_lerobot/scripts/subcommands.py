"""Commands such as `cronos-publish policy`, whose first word says which config the flags are of."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import draccus
from draccus.utils import ParsingError
from httpx import HTTPError
from yaml import YAMLError

from cronos_lerobot.scripts.errors import stop
from cronos_lerobot.scripts.yaml_text import quoted_texts


def run_subcommand(
    help_text: str,
    commands: Mapping[str, tuple[type, Callable[[Any], None]]],
    errors: tuple[type[Exception], ...] = (ValueError, OSError),
) -> None:
    """Parse the command line and run the command that it names.

    Args:
        help_text: printed for `--help` and where no command is given.
        commands: config class and function by name.
        errors: end the program with a line that says what they say; any other is a bug and shows its traceback.
    """
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h"):
        print(help_text)
        return
    if name not in commands:
        sys.exit(f"error: unknown command {name!r}; valid commands: {list(commands)}")
    config_class, run = commands[name]
    try:
        run(draccus.parse(config_class, args=quoted_texts(config_class, arguments)))
    except (ParsingError, YAMLError) as error:
        stop(error)
    except errors as error:
        sys.exit(f"error: {error}")
    except HTTPError as error:
        stop(error)
