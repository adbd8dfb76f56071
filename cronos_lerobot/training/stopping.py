"""A run that is told to stop ends where it can go on from."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from types import FrameType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
"""Ctrl-C, what a cluster sends at the end of its time, a dropped connection, and a cluster's warnings."""
SAME_S = 2.0
"""Signals this close to each other [s] are one: a cluster sends it to us, and so does who started us."""


class StopRequest:
    """Notes one of SIGNALS while it is entered; a second one ends the process as if there were no first.

    Where a signal is ignored it stays ignored, as for what a shell runs in the background.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        """Of the signal; None as long as there is none."""
        self._at = 0.0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            caught = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
            self._previous = {number: signal.signal(number, self._note) for number in caught}
        return self

    def __exit__(self, *args: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.number is None:
            self.number, self._at = number, now
            # Not by logging: it may be what was interrupted.
            name = signal.Signals(number).name
            # Who read it may be gone: `2>&1 | tee log` ends by the same Ctrl-C.
            with suppress(OSError):
                os.write(
                    2, f"{name}: ending after this update, with a checkpoint; once more ends at once\n".encode()
                )
        elif now - self._at > SAME_S:
            end_by(number)


def end_by(number: int) -> None:
    """End this process by a signal, so that whoever started it sees why."""
    for stream in (sys.stdout, sys.stderr):
        # The reader may be gone, or the signal have come in the middle of a flush.
        with suppress(OSError, ValueError, RuntimeError):
            stream.flush()
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
