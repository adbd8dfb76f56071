"""What becomes of a command's text where nobody reads on."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def ends_with_its_reader() -> Generator[None]:
    """Print until nobody reads any more, as after ten lines of `| head`, and end without a traceback.

    A context manager and a decorator, around what is printed when everything is done or nothing is to be done.
    """
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes once more at its end (the library reference's note on SIGPIPE).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
