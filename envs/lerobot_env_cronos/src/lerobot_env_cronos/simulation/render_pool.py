"""Software rendering in processes of its own.

Mesa's software rasteriser draws a small picture on one core, most of it in the thread that asks, and crashes when
two threads of a process ask. Two processes on two cores draw twice as much.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
import weakref
from typing import IO

import mujoco
import numpy as np

from lerobot_env_cronos.simulation import canvas

MIN_FRAMES = 8
"""For each process; fewer are drawn sooner than they are handed over."""


def num_processes(frames: int, most: int) -> int:
    """How many of at most so many processes share so many frames."""
    return max(1, min(most, frames // MIN_FRAMES))


class RenderPool:
    """Draws states of one model from one camera in several processes.

    Args:
        model: what to draw.
        height, width: of a frame [px].
        camera: number of the camera.
        processes: how many.

    Raises:
        RuntimeError: a process does not start; says what it said.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: int, processes: int):
        self._shape = (height, width, 3)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 -- as long as the processes.
        self._processes: list[subprocess.Popen] = []
        self._finalizer = weakref.finalize(self, _stop, self._processes, self._errors, os.getpid())
        # The folder is gone once all have read the model: nothing is left behind when they are killed.
        with tempfile.TemporaryDirectory(prefix="cronos-model-") as folder:
            mujoco.mj_saveModel(model, f"{folder}/model.mjb")
            command = [sys.executable, "-P", canvas.__file__, f"{folder}/model.mjb"]
            command += map(str, (height, width, camera))
            self._processes += [self._start(command) for _ in range(processes)]
            for process in self._processes:
                self._read(process, np.empty(len(canvas.READY), np.uint8))

    def _start(self, command: list[str]) -> subprocess.Popen:
        # A core each; what OpenGL says at its start is of interest only if it fails.
        environment = os.environ | {"LP_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._errors, env=environment)

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Frames (n, height, width, 3) uint8 of states (n, nq).

        Raises:
            RuntimeError: a process has died.
        """
        try:
            return self._render(qpos)
        except BaseException:
            # Answers that nobody has read, of what Ctrl-C broke off, would be taken for those of what comes next.
            self.close()
            raise

    def _render(self, qpos: np.ndarray) -> np.ndarray:
        drawing = self._processes[: num_processes(len(qpos), len(self._processes))]
        for process, states in zip(drawing, np.array_split(qpos, len(drawing)), strict=True):
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # Noticed below, with what it said.
                process.stdin.write(canvas.COUNT.pack(len(states)) + states.tobytes())
                process.stdin.flush()
        frames = np.empty((len(qpos), *self._shape), np.uint8)
        for process, drawn in zip(drawing, np.array_split(frames, len(drawing)), strict=True):
            self._read(process, drawn)
        return frames

    def _read(self, process: subprocess.Popen, into: np.ndarray) -> None:
        """Read bytes until the array `into` is full."""
        assert isinstance(process.stdout, io.BufferedReader)
        if process.stdout.readinto(into.data) < into.nbytes:
            self._errors.seek(0)
            said = self._errors.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"a rendering process ended ({process.wait()}). {' '.join(said[-1:])}")

    def close(self) -> None:
        """End the processes; also done when the pool is garbage-collected."""
        self._finalizer()

    @property
    def size(self) -> int:
        """How many processes draw, none after `close`."""
        return len(self._processes) if self._finalizer.alive else 0


def _stop(processes: list[subprocess.Popen], errors: IO[bytes], opened_by: int) -> None:
    # A forked process has only copies of the pipes.
    if opened_by != os.getpid():
        return
    for process in processes:
        assert process.stdin is not None
        assert process.stdout is not None
        process.kill()
        with contextlib.suppress(BrokenPipeError):  # A request that was never read is flushed here.
            process.stdin.close()
        process.stdout.close()
        process.wait()
    errors.close()
