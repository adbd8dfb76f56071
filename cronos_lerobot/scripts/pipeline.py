"""Runs commands one after the other, shows each before it runs, and skips what is done when run again."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cronos_lerobot.experiments.arithmetic import portable_arithmetic
from cronos_lerobot.experiments.runner import raise_on_signals
from cronos_lerobot.locks import INSIDE, FolderLock
from cronos_lerobot.provenance import package_versions
from cronos_lerobot.training.stopping import SAME_S

ECHO_S = 1.0
"""When a command is told what Ctrl-C may not have [s]; within SAME_S it is no second signal."""
STATE = "demo.json"
"""What has been done, in the output folder."""


@dataclass(frozen=True)
class Step:
    """One command of a pipeline."""

    name: str
    title: str
    """What it does, for the reader."""
    command: list[str]
    """A console script of this environment, or `python`, and its flags."""
    output: Path
    """File or folder that the command makes; removed before the command runs anew."""
    resume: Callable[[], list[str] | None] = lambda: None
    """The command that goes on with an unfinished `output`, or None if there is nothing to go on with."""
    always: bool = False
    """Run it even if it was done before."""


class StepFailedError(Exception):
    """A command ended with an error."""


def run_steps(steps: Sequence[Step], folder: Path) -> None:
    """Run the steps that are not done yet; from the first one that runs on, all later ones do.

    Args:
        steps: in their order; each may use the outputs of those before it.
        folder: holds their outputs and a note of what was done with which command and versions.

    Raises:
        FileExistsError: the folder holds something else, or a step that is done was done with another command or
            other versions.
        FolderInUseError: another process runs the steps there.
        StepFailedError: a command failed; running the steps again goes on from there.
    """
    with FolderLock(folder):
        # A step must not go on by itself, with the folder free for another process.
        previous = raise_on_signals()
        try:
            _run_steps(steps, folder)
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def _run_steps(steps: Sequence[Step], folder: Path) -> None:
    state, versions = _read_state(folder), package_versions()
    stale = False
    for step in steps:
        note = state.get(step.name, {})
        if note.get("done") and step.output.exists() and (why := _differences(step, note, versions, folder)):
            raise FileExistsError(
                f"{step.output} is done and was made otherwise ({why}): choose another --output_dir, or delete it"
            )
    for number, step in enumerate(steps, start=1):
        heading = f"[{number}/{len(steps)}] {step.title}"
        note = state.get(step.name, {})
        made = {"command": step.command, "versions": versions}
        same = not _differences(step, note, versions, folder)
        if same and note.get("done") and step.output.exists() and not stale and not step.always:
            print(f"\n{heading}: done before ({step.output})", flush=True)
            continue
        resumed = step.resume() if same and not stale else None
        stale = True
        if resumed is None:
            _remove(step.output)
        for later in steps[number - 1 :]:
            state.get(later.name, {}).pop("done", None)
        state[step.name] = made
        _write_state(folder, state)
        print(f"\n{heading}", flush=True)
        start = time.perf_counter()
        run_command(resumed or step.command)
        seconds = time.perf_counter() - start
        state[step.name] |= {"done": True, "seconds": round(seconds, 1)}
        _write_state(folder, state)
        print(f"    took {seconds / 60:.1f} min", flush=True)


def _differences(step: Step, note: dict, versions: dict[str, str], folder: Path) -> str:
    """How a step was done otherwise than it would be now, in words; empty if it was not.

    The folder may be spelled in another way: paths are compared as seen from there.
    """
    old, new = (_seen_from(folder, command) for command in (note.get("command", []), step.command))
    words = [word for word in old if word not in new][:2] + [f"now {word}" for word in new if word not in old][:2]
    if old != new:
        return ", ".join(words) or "another order of the flags"
    there = note.get("versions", {})
    names = [name for name in sorted(there | versions) if there.get(name) != versions.get(name)]
    return ", ".join(f"{name} {there.get(name, 'none')}, now {versions.get(name, 'none')}" for name in names)


def _seen_from(folder: Path, command: Sequence[str]) -> list[str]:
    found = []
    for word in command:
        name, sign, value = word.rpartition("=")
        path = Path(value).resolve()
        below = path.relative_to(folder.resolve()) if value and path.is_relative_to(folder.resolve()) else value
        found.append(f"{name}{sign}{below}")
    return found


def remember(folder: Path, name: str, find_out: Callable[[], dict]) -> dict:
    """What is noted in the folder under `name`; found out and noted if nothing is, so that a later call agrees.

    Raises:
        FileExistsError: the folder holds something else.
    """
    state = _read_state(folder)
    if name not in state:
        state[name] = find_out()
        _write_state(folder, state)
    return state[name]


def run_command(command: list[str]) -> None:
    """Show a command as one may type it, and run it; its output goes where ours goes.

    Raises:
        StepFailedError: it ended with an error.
        KeyboardInterrupt: Ctrl-C, or a signal that ends us; the command has ended by itself, or was killed by a
            second one.
    """
    print(f"    $ {command_line(command)}\n", flush=True)
    # The script of the environment that this Python runs in, whatever PATH says.
    program = Path(sys.executable) if command[0] == "python" else Path(sys.executable).with_name(command[0])
    if _run([str(program), *command[1:]]) != 0:
        raise StepFailedError(f"the command failed:\n    {command_line(command)}")


def _run(command: list[str]) -> int:
    """Run a command, which Ctrl-C reaches as it does us, to its end; a second one kills it. Its exit status."""
    # As `cronos-reproduce` runs them: README says what comes out.
    environment = portable_arithmetic(Path(command[0]).name) | os.environ
    with subprocess.Popen(command, env=environment) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            _end(process)
            raise


def _end(process: subprocess.Popen) -> None:
    """Await a command that Ctrl-C has reached, too; should it have come to us alone, SIGTERM tells the command."""
    began, told = time.monotonic(), False
    while process.poll() is None:
        try:
            time.sleep(0.05)
            if not told and time.monotonic() > began + ECHO_S:
                process.terminate()
                told = True
        except KeyboardInterrupt:
            if time.monotonic() > began + SAME_S:
                process.kill()


def command_line(command: list[str]) -> str:
    """A command for a shell, each flag on a line of its own with its values."""
    lines = [command[0]]
    for part in command[1:]:
        word = shlex.quote(part)
        if part.startswith("--"):
            lines.append(word)
        else:
            lines[-1] += f" {word}"
    return " \\\n        ".join(lines)


def _read_state(folder: Path) -> dict[str, dict]:
    path = folder / STATE
    if path.is_file():
        return json.loads(path.read_text())
    if folder.exists() and (not folder.is_dir() or any(file.name != INSIDE for file in folder.iterdir())):
        raise FileExistsError(f"{folder} is not empty and not of an earlier run; choose another --output_dir.")
    return {}


def _write_state(folder: Path, state: dict[str, dict]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f".{STATE}"
    partial.write_text(json.dumps(state, indent=2))
    partial.replace(folder / STATE)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
