"""Frames of many simulations, by one of MuJoCo's renderers.

All OpenGL work of a process is done in one thread. A context belongs to the thread in which it is current, and
Mesa's software rasteriser, which spreads every frame over the cores by itself, crashes when two threads draw at
once.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from lerobot_env_cronos.simulation import gl
from lerobot_env_cronos.simulation.canvas import Canvas
from lerobot_env_cronos.simulation.filament import FilamentRenderer
from lerobot_env_cronos.simulation.render_pool import MIN_FRAMES, RenderPool, num_processes

RENDERERS = ("classic", "filament")
SOFTWARE = "llvmpipe"
"""Mesa's rasteriser, by OpenGL's name of what it draws with."""

_GL_THREAD = ThreadPoolExecutor(1, thread_name_prefix="opengl")


def make_renderer(
    name: str, model: mujoco.MjModel, height: int, width: int, camera: str, processes: int = 1
) -> ClassicRenderer | FilamentRenderer:
    """Return the renderer `name` of `RENDERERS` for one camera and size.

    Args:
        name: see above.
        model: what to draw.
        height, width: of a frame [px].
        camera: name of the camera.
        processes: for many frames at a time, where OpenGL draws in software; the frames do not depend on it.

    Raises:
        KeyError: the model has no such camera.
        RenderingError: it cannot draw on this machine, or in this process; says why.
    """
    gl.claim_process()
    if name == "classic":
        return ClassicRenderer(model, height, width, camera, processes)
    return FilamentRenderer(model, height, width, camera)


class ClassicRenderer:
    """Renders `camera` of simulation states at `height` x `width`, without shadows.

    Raises:
        KeyError: the model has no such camera.
        RenderingError: no OpenGL context can be opened.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: str, processes: int = 1):
        self.model, self.height, self.width = model, height, width
        self.camera = model.camera(camera).id
        self._canvas = _GL_THREAD.submit(_open, model, height, width, self.camera).result()
        self._finalizer = weakref.finalize(self, _close, self._canvas, os.getpid())
        in_software = processes > 1 and SOFTWARE in _GL_THREAD.submit(self._canvas.driver).result()
        self._processes = processes if in_software else 1
        self._pool: RenderPool | None = None
        self._pool_lock = threading.Lock()

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Render states `qpos` (n, nq) to uint8 frames (n, height, width, 3)."""
        gl.claim_process()
        if self._processes > 1 and len(qpos) >= 2 * MIN_FRAMES:
            # One batch at a time.
            with self._pool_lock:
                return self._pool_for(len(qpos)).render(qpos)
        frames = np.empty((len(qpos), self.height, self.width, 3), np.uint8)
        _GL_THREAD.submit(self._canvas.draw, qpos, frames).result()
        return frames

    def _pool_for(self, count: int) -> RenderPool:
        needed = num_processes(count, self._processes)
        if self._pool is None or self._pool.size < needed:
            if self._pool is not None:
                self._pool.close()
            self._pool = RenderPool(self.model, self.height, self.width, self.camera, needed)
        return self._pool

    def close(self) -> None:
        """Free the OpenGL context and end the processes; also done when the renderer is garbage-collected."""
        if self._pool is not None:
            self._pool.close()
        self._finalizer()


def _open(model: mujoco.MjModel, height: int, width: int, camera: int) -> Canvas:
    try:
        return Canvas(model, height, width, camera)
    except Exception as error:  # The platforms raise whatever their bindings do.
        cause = f"{type(error).__name__}: {error}"
        raise gl.RenderingError(gl.NO_CONTEXT.format(platform=os.environ.get("MUJOCO_GL"), cause=cause)) from error


def _close(canvas: Canvas, opened_by: int) -> None:
    # A forked process has neither the thread nor the context.
    if opened_by != os.getpid():
        return
    # Nobody waits for it: the garbage collector may run in the OpenGL thread itself.
    with contextlib.suppress(RuntimeError):  # At interpreter exit the thread is gone, and soon the context.
        _GL_THREAD.submit(canvas.close)
