"""The console scripts. Importing PyTorch and LeRobot takes seconds, so `--help` and wrong flags do without."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module

from cronos_lerobot.scripts.flags import (
    check_flags,
    docstring_of,
    find_class,
    find_commands,
    format_flags,
    read_flags,
)

CONFIGS = {
    "train": ("cronos_lerobot.training.config", "CronosTrainConfig"),
    "eval": ("cronos_lerobot.evaluation.config", "CronosEvalConfig"),
    "record_demos": ("cronos_lerobot.scripts.record_demos", "RecordDemosConfig"),
}
"""Commands whose flags are those of one config; the others' first word says which."""


def _run(module: str) -> None:
    """Answer `--help` or a wrong flag, or import a command's module and run its `main`."""
    _answer(module, sys.argv[1:])
    is_watched = sys.stderr.isatty()
    if is_watched:
        sys.stderr.write("loading PyTorch and LeRobot ...")
        sys.stderr.flush()
    main = import_module(f"cronos_lerobot.scripts.{module}").main
    if is_watched:
        # Back to the start of the line, and clear it.
        sys.stderr.write("\r\033[K")
    import_module("cronos_lerobot.hub.push").limit_waiting()
    main()


def _answer(module: str, arguments: list[str]) -> None:
    """End the program if all that is asked for is help, or a flag does not exist."""
    text, asks = docstring_of(f"cronos_lerobot.scripts.{module}"), {"--help", "-h"} & set(arguments)
    if module in CONFIGS:
        source = find_class(*CONFIGS[module])
    else:
        commands = find_commands(f"cronos_lerobot.scripts.{module}")
        name, *arguments = arguments or ["--help"]
        if name in ("--help", "-h"):
            print(text)
            sys.exit()
        if name not in commands:
            sys.exit(f"error: unknown command {name!r}; valid commands: {list(commands)}")
        source, text = commands[name], f"cronos-{module} {name}"
    flags = read_flags(source, arguments)
    if asks:
        print(f"{text}\n\nflags, as --name=value:\n{format_flags(flags)}")
        sys.exit()
    if wrong := check_flags(flags, arguments):
        sys.stderr.write(f"error: {wrong}; --help lists the flags\n")
        sys.exit(2)


train, evaluate, record_demos, publish, streams = (
    partial(_run, module) for module in ("train", "eval", "record_demos", "publish", "streams")
)
