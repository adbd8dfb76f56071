"""One writer for a folder: a second process that wants to write to a run or a dataset gets an error."""

from __future__ import annotations

import datetime as dt
import os
import socket
from pathlib import Path
from types import TracebackType
from typing import Self

from filelock import FileLock, Timeout

INSIDE = ".lock"
"""Name of the lock's file where it is in the folder."""


class FolderInUseError(OSError):
    """Another process writes to the folder."""


class FolderLock:
    """Holds a folder for this process, from `acquire` or `with` until `release`, the process's end or its kill.

    Keep the object: the lock goes with it.

    The operating system's lock is on `.<name>.lock` beside the folder, which itself need not exist yet, or on
    `.lock` in a folder whose parent cannot be written to. The file stays behind and means nothing by itself; it
    says who holds the lock.

    Args:
        folder: of a run, or the root of a dataset.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder).resolve()
        self.path = _lock_file(self.folder)
        self._lock = FileLock(self.path)

    def acquire(self) -> Self:
        """Take the lock, or say at once who has it.

        Raises:
            FolderInUseError: another process has it, or this one by another FolderLock.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._lock.acquire(blocking=False)
        except Timeout:
            owner = self.path.read_text().strip() or "another process"
            raise FolderInUseError(
                f"{self.folder} is being written by {owner}: wait for it or stop it; two writers would lose data."
            ) from None
        now = f"{dt.datetime.now(dt.UTC):%Y-%m-%d %H:%M:%S} UTC"
        self.path.write_text(f"process {os.getpid()} on {socket.gethostname()}, since {now}\n")
        return self

    def release(self) -> None:
        """Give the folder back; nothing happens if it is not held."""
        self._lock.release()

    def __enter__(self) -> Self:
        """Take the lock."""
        return self.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the folder back."""
        self.release()


def _lock_file(folder: Path) -> Path:
    """The place beside a folder, which need not exist; in it if only the folder itself can be written to."""
    beside = folder.with_name(f".{folder.name}.lock")
    is_writable = os.access(beside if beside.exists() else beside.parent, os.W_OK)
    return folder / INSIDE if folder.is_dir() and not is_writable else beside
