"""Runs a story of real commands, and writes it down as documentation shows it."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Act:
    """A command of the story."""

    title: str
    command: str
    lines: int = 2
    """The last lines of its output that are shown."""
    elsewhere: bool = False
    """In another folder, with empty caches."""


def wrap(command: str) -> str:
    """A command over several lines, none longer than a page is wide."""
    if "\n" in command:
        return command
    lines = [""]
    for word in command.split():
        if len(lines[-1]) + len(word) > 104:
            lines[-1] += " \\"
            lines.append("    " + word)
        else:
            lines[-1] += f" {word}" if lines[-1] else word
    return "\n".join(lines)


def tail(output: str, count: int) -> str:
    """The last lines, as a terminal shows them."""
    shown = [line.split("\r")[-1].rstrip() for line in output.splitlines()]
    shown = [re.sub(r"^INFO \S+ \S+ \S+ ", "", line) for line in shown if line]
    return "\n".join(shown[-count:] if count else [])


def perform(act: Act, folder: Path, environment: dict[str, str]) -> str:
    """Run a command in a folder; returns its part of the transcript."""
    start = time.perf_counter()
    result = subprocess.run(
        act.command,
        shell=True,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    seconds = time.perf_counter() - start
    print(f"{seconds:6.1f} s  {act.command.splitlines()[0][:90]}", flush=True)
    if result.returncode:
        sys.exit(f"{act.command}\n{result.stdout[-3000:]}")
    output = tail(result.stdout, act.lines)
    block = f"```console\n$ {wrap(act.command)}\n{output}\n```\n".replace("\n\n```", "\n```")
    return f"{act.title}:\n\n{block}" if act.title else block
