"""Signals that have to wait for what must not be cut in two."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def blocked(*numbers: signal.Signals) -> Generator[None]:
    """What is started within does not see these signals, nor does this thread until the end."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def deferred() -> Generator[None]:
    """Ctrl-C, SIGTERM and a closed terminal come after this, also for the programs that are started within."""
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    heard = [number for number in numbers if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    if threading.current_thread() is not threading.main_thread() or not heard:
        yield
        return
    # Another thread may be the one that a signal comes to, and then the handler is called here all the same.
    before = {number: signal.signal(number, lambda one, _: came.append(one)) for number in heard}
    try:
        with blocked(*heard):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
