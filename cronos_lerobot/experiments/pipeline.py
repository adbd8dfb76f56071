"""Lists of commands that can be run again: what is done is skipped, what was stopped resumes.

Each command makes one folder. `<folder>/.done` holds the command that made it, `<folder>.log` what it printed, and
whoever makes it holds the lock `<folder>.lock`: a folder that many pipelines need is made by the first to come.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

DONE = ".done"
WARNING = signal.SIGUSR2
"""Sent by submitit before a time limit, to all processes of a job; the commands do not need to know."""


class CommandFailedError(Exception):
    """A command ended with an error."""


@dataclass(frozen=True)
class Command:
    """One command and the folder that it makes."""

    words: tuple[str, ...]
    """A script of this environment, or `python`, and its flags, `--name=value` each."""
    output: Path
    resumes: bool = False
    """Continue with what is in `output`; otherwise an unfinished folder is deleted and made anew."""

    @property
    def log(self) -> Path:
        """What the command printed, over all its starts."""
        return self.output.with_name(f"{self.output.name}.log")

    @property
    def is_done(self) -> bool:
        """Whether this command has made its folder.

        Raises:
            ValueError: another command has made it.
        """
        path = self.output / DONE
        if not path.is_file():
            return False
        there = shlex.split(path.read_text())
        if there != list(self.words):
            differing = " ".join(sorted(set(there) ^ set(self.words)))
            raise ValueError(
                f"{self.output} was made with other flags ({differing}): delete it, or choose another folder."
            )
        return True

    def __str__(self) -> str:
        """The command for a shell, a flag on each line."""
        return " \\\n    ".join(map(shlex.quote, self.words))


class Runner:
    """Runs commands one after the other; `stop` ends the one that is running, from another thread or a handler.

    Args:
        threads: of each command, for PyTorch and other libraries.
        show: is told of every start: the command and its log file.
        log: write output to the command's log file instead of the terminal.
    """

    def __init__(
        self, threads: int, show: Callable[[Command], None] = lambda _: None, *, log: bool = True
    ) -> None:
        self._threads = threads
        self._show, self._log = show, log
        self._running: set[subprocess.Popen] = set()
        self._stopping = threading.Event()

    def run(self, commands: Sequence[Command]) -> None:
        """Run what is not done.

        Raises:
            CommandFailedError: a command failed, or was stopped; running the list again continues there.
        """
        for command in commands:
            command.output.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(command.output.with_name(f"{command.output.name}.lock")):
                if not command.is_done:
                    self._run(command)

    def stop(self) -> None:
        """Ask running commands to end, and wait until they have saved what they want to keep."""
        self._stopping.set()
        for process in list(self._running):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        for process in list(self._running):
            # Not `process.wait`: the thread that we may have interrupted is in it, with its lock.
            with suppress(ChildProcessError):
                os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)

    def _run(self, command: Command) -> None:
        if self._stopping.is_set():
            raise CommandFailedError("stopped")
        if command.output.exists() and not command.log.exists():
            raise CommandFailedError(f"{command.output} exists and is not of this command: choose another folder.")
        if not command.resumes:
            shutil.rmtree(command.output, ignore_errors=True)
        self._show(command)
        code = self._call(command)
        if code:
            where = f": see {command.log}" if self._log else ""
            raise CommandFailedError(f"{command.words[0]} of {command.output} ended with status {code}{where}")
        (command.output / DONE).write_text(shlex.join(command.words))

    def _call(self, command: Command) -> int:
        script, *flags = command.words
        environment = portable_arithmetic(script) | {"OMP_NUM_THREADS": str(self._threads)} | dict(os.environ)
        program = sys.executable if script == "python" else str(Path(sys.executable).with_name(script))
        with command.log.open("ab") as log:
            output = log if self._log else None
            signal.pthread_sigmask(signal.SIG_BLOCK, {WARNING})
            try:
                # A session of its own: Ctrl-C reaches us alone, and we stop the command and what it has started.
                process = subprocess.Popen(
                    [program, *flags],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    start_new_session=True,
                    env=environment,
                )
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {WARNING})
            self._running.add(process)
            code = process.wait()
            self._running.discard(process)
            return code


@dataclass(frozen=True)
class Pipeline:
    """Commands of one run, with its name and how far it is to go."""

    name: str
    commands: tuple[Command, ...]

    @property
    def is_done(self) -> bool:
        """Whether all its commands are."""
        return all(command.is_done for command in self.commands)


def run_here(
    pipelines: Sequence[Pipeline],
    parallel: int,
    threads: int,
    progress: Callable[[], None] = lambda: None,
    show: Callable[[Command], None] = lambda _: None,
) -> list[str]:
    """Run pipelines on this machine, several at a time.

    Args:
        pipelines: in the order in which they start.
        parallel: how many run at the same time.
        threads: of each.
        progress: is called every second.
        show: is told of every command that starts.

    Returns:
        Why pipelines failed, a line each.

    Raises:
        KeyboardInterrupt: Ctrl-C; the commands have saved and ended.
    """
    runner = Runner(threads, show)
    with ThreadPoolExecutor(parallel) as pool:
        futures: list[Future] = [pool.submit(runner.run, pipeline.commands) for pipeline in pipelines]
        try:
            return await_all(pipelines, futures, progress)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            runner.stop()
            raise


def await_all(pipelines: Sequence[Pipeline], jobs: Sequence[Any], progress: Callable[[], None]) -> list[str]:
    """Wait for futures, or for submitit's jobs, which are alike; returns why they failed, a line each."""
    while not all(job.done() for job in jobs):
        progress()
        time.sleep(1)
    progress()
    failed = [(pipeline, job.exception()) for pipeline, job in zip(pipelines, jobs, strict=True)]
    return [f"{pipeline.name}: {error}" for pipeline, error in failed if error is not None]


def interrupt_on_signals() -> None:
    """Let SIGTERM and a closed terminal end this process as Ctrl-C does."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)


def portable_arithmetic(script: str) -> dict[str, str]:
    """Variables that make PyTorch, MKL, oneDNN and NumPy round alike on all processors with AVX2.

    With newer instructions sums have other last bits, and two machines clone two different base policies.
    """
    import numpy as np

    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    newer = [name for name in found if name.startswith("AVX512")]
    held = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "OPENBLAS_CORETYPE": "Haswell"}
    # MKL has one path that all makers' processors share, without AVX: the slow one, so only clones take it.
    held["MKL_CBWR"] = "COMPATIBLE" if script == "lerobot-train" else "AVX2"
    return held | ({"NPY_DISABLE_CPU_FEATURES": " ".join(newer)} if newer else {})
