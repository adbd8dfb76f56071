"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any


def partial_name(name: str) -> str:
    """What a file is called while it is written; a kill or a full disk may leave it behind."""
    return f".{name}.partial"


@contextmanager
def written_whole(path: Path, mode: str = "w") -> Generator[IO[Any]]:
    """Open a file that takes the place of `path`, in its folder, once it is written and on the disk.

    A kill or a crash of the machine leaves the old one or the new one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(partial_name(path.name))
    with partial.open(mode) as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
