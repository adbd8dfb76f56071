"""How every command ends: one `error:` line for what a user got wrong, and nothing where nobody reads on."""

from __future__ import annotations

import os
import sys
from argparse import ArgumentError
from collections.abc import Generator
from contextlib import contextmanager
from typing import NoReturn

from draccus.utils import DecodingError, ParsingError
from httpx import HTTPError, TransportError
from lerobot.configs.parser import PluginLoadError
from safetensors import SafetensorError
from yaml import YAMLError

USER_ERRORS = (
    ValueError, OSError, ParsingError, ArgumentError, PluginLoadError, SafetensorError, HTTPError, YAMLError,
)  # fmt: skip
"""What a wrong flag, a missing file or a damaged one raises, or the Hub. Any other error is a bug and shows its
traceback."""
WORK_ERRORS = (OSError, FloatingPointError, SafetensorError)
"""What ends a run that has begun without being a bug: a full disk, a loss that is not a number."""


@contextmanager
def error_line(*more: type[Exception], only: tuple[type[Exception], ...] = USER_ERRORS) -> Generator[None]:
    """End the program with status 1 and one line, `error: <what is wrong>`, instead of a traceback.

    A context manager and a decorator. `USER_ERRORS` belong around what reads flags and files, `WORK_ERRORS`
    around the work itself, whose other errors are bugs.

    Args:
        more: errors that are the user's here, beside `only`.
        only: errors that end in a line.
    """
    try:
        yield
    except (*only, *more) as error:
        stop(error)


def stop(error: Exception | str) -> NoReturn:
    """End the program with status 1 and `error: <reason>` on one line."""
    sys.exit(f"error: {reason(error)}")


def reason(error: Exception | str) -> str:
    """What an error says, on one line; draccus hides the reason in the cause."""
    is_hidden = isinstance(error, ParsingError) and not isinstance(error, DecodingError)
    if is_hidden and error.__cause__ is not None:
        return reason(error.__cause__)  # ty: ignore[invalid-argument-type]
    if isinstance(error, TransportError):
        return (
            f"the Hub was not reached ({type(error).__name__}: {error}); what is not on this machine, "
            "by its name or in the folder that a flag gives, is looked for there"
        )
    text = " ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return text or type(error).__name__


@contextmanager
def ends_with_its_reader() -> Generator[None]:
    """Print until nobody reads any more, as after ten lines of `| head`, and end without a traceback."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes once more at its end (the library reference's note on SIGPIPE).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
