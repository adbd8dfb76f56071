"""The console scripts. Importing PyTorch and LeRobot takes seconds, so each says first that it has been heard."""

from __future__ import annotations

import sys
from importlib import import_module


def _run(module: str) -> None:
    """Import a command's module and run its `main`; a terminal is told what takes its time."""
    is_watched = sys.stderr.isatty()
    if is_watched:
        sys.stderr.write("loading PyTorch and LeRobot ...")
        sys.stderr.flush()
    main = import_module(f"cronos_lerobot.scripts.{module}").main
    if is_watched:
        # Back to the start of the line, and clear it.
        sys.stderr.write("\r\033[K")
    main()


def train() -> None:
    """`cronos-train`."""
    _run("train")


def evaluate() -> None:
    """`cronos-eval`."""
    _run("eval")


def record_demos() -> None:
    """`cronos-record-demos`."""
    _run("record_demos")


def publish() -> None:
    """`cronos-publish`."""
    _run("publish")


def streams() -> None:
    """`cronos-streams`."""
    _run("streams")
