"""Software rendering in processes of its own.

Mesa's software rasteriser draws a small picture on one core, most of it in the thread that asks, and crashes when
two threads of a process ask. Two processes on two cores draw twice as much.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import IO

import mujoco
import numpy as np

from lerobot_env_cronos.simulation import canvas

MIN_FRAMES = 8
"""For each process; fewer are drawn sooner than they are handed over."""


class RenderPool:
    """Draws states of one model from one camera in several processes.

    Args:
        model: what to draw.
        height, width: of a frame [px].
        camera: number of the camera.
        processes: how many at most.
        capacity: the most frames at a time.

    Raises:
        OSError: there is no place for so many frames.
        RuntimeError: a process does not start; says what it said.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: int, processes: int, capacity: int):
        self.capacity = capacity
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 -- as long as the processes.
        self._processes: list[subprocess.Popen] = []
        self._finalizer = weakref.finalize(self, _stop, self._processes, self._errors, os.getpid())
        # The folder is gone once all have opened what is in it: nothing is left behind when they are killed.
        with _folder_with("shared", capacity * (model.nq * 8 + height * width * 3)) as folder:
            model_path, shared = f"{folder}/model.mjb", f"{folder}/shared"
            mujoco.mj_saveModel(model, model_path)
            self._states, self._frames = canvas.shared_arrays(shared, capacity, model.nq, height, width)
            command = [sys.executable, "-P", canvas.__file__, model_path, shared]
            command += map(str, (height, width, camera, capacity))
            self._processes += [self._start(command) for _ in range(_num_for(capacity, processes))]
            self._wait(self._processes)

    def _start(self, command: list[str]) -> subprocess.Popen:
        # A core each; what OpenGL says at its start is of interest only if it fails.
        environment = os.environ | {"LP_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._errors, env=environment)

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Frames (n, height, width, 3) uint8 of states (n, nq), n at most `capacity`.

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
        n = len(qpos)
        self._states[:n] = qpos
        drawing = self._processes[: _num_for(n, len(self._processes))]
        bounds = np.linspace(0, n, len(drawing) + 1).astype(int).tolist()
        for process, first, end in zip(drawing, bounds[:-1], bounds[1:], strict=True):
            assert process.stdin is not None
            try:
                process.stdin.write(canvas.REQUEST.pack(first, end - first))
                process.stdin.flush()
            except BrokenPipeError:
                continue  # Noticed below, with what it said.
        self._wait(drawing)
        return self._frames[:n].copy()

    def _wait(self, processes: list[subprocess.Popen]) -> None:
        for process in processes:
            assert process.stdout is not None
            if process.stdout.read(1) != canvas.ANSWER:
                self._errors.seek(0)
                said = self._errors.read().decode(errors="replace").strip().splitlines()
                raise RuntimeError(f"a rendering process ended ({process.wait()}). {' '.join(said[-1:])}")

    def close(self) -> None:
        """End the processes; also done when the pool is garbage-collected."""
        self._finalizer()

    @property
    def is_closed(self) -> bool:
        """Whether it draws no more."""
        return not self._finalizer.alive


def _num_for(frames: int, processes: int) -> int:
    """How many of the processes share so many frames."""
    return max(1, min(processes, frames // MIN_FRAMES))


def _folder_with(name: str, size: int) -> tempfile.TemporaryDirectory:
    """A new folder with a file of `size` [bytes], in memory where there is room (Docker's default has 64 MB).

    Raises:
        OSError: there is room nowhere.
    """
    for place in filter(None, (_memory_folder(), tempfile.gettempdir())):
        folder = tempfile.TemporaryDirectory(prefix="cronos-frames-", dir=place)
        try:
            with open(Path(folder.name) / name, "wb") as file:
                # A file with holes would be found too large only by who writes to it, and killed for that.
                os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            folder.cleanup()
            full = error
        else:
            return folder
    raise OSError(f"no room for {size / 1e6:.0f} MB of frames in {place}: {full}")


def _memory_folder() -> Path | None:
    """Where files lie in memory, if there is such a place."""
    folder = Path("/dev/shm")
    return folder if folder.is_dir() and os.access(folder, os.W_OK) else None


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
