"""Frames of many simulations, by one of MuJoCo's renderers.

All OpenGL work of a process is done in one thread. A context belongs to the thread in which it is current, and
Mesa's software rasteriser, which spreads every frame over the cores by itself, crashes when two threads draw at
once.
"""

from __future__ import annotations

import os
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import mujoco
import numpy as np

from lerobot_env_cronos.simulation import gl
from lerobot_env_cronos.simulation.filament import FilamentRenderer

RENDERERS = ("classic", "filament")

_GL_THREAD = ThreadPoolExecutor(1, thread_name_prefix="opengl")


class BatchRenderer(Protocol):
    """Draws simulation states; any thread may ask for frames."""

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Frames (n, height, width, 3) uint8 of states `qpos` (n, nq)."""
        ...

    def close(self) -> None:
        """Free what it draws with."""


def make_renderer(name: str, model: mujoco.MjModel, height: int, width: int, camera: str) -> BatchRenderer:
    """Return the renderer `name` of `RENDERERS` for one camera and size.

    Raises:
        KeyError: the model has no such camera.
        RuntimeError: it cannot draw on this machine, or in this process; says why.
    """
    gl.claim_process()
    if name == "classic":
        return ClassicRenderer(model, height, width, camera)
    return FilamentRenderer(model, height, width, camera)


class ClassicRenderer:
    """Renders `camera` of simulation states at `height` x `width`.

    Shadows and reflections are off unless asked for: in software rendering they cost five times the rest of the
    frame.

    Raises:
        KeyError: the model has no such camera.
        RuntimeError: no OpenGL context can be opened.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: str, *, shadows: bool = False):
        self.model, self.height, self.width = model, height, width
        self.camera = model.camera(camera).id
        self._data = mujoco.MjData(model)
        self._renderer = _GL_THREAD.submit(_open, model, height, width, shadows).result()
        self._finalizer = weakref.finalize(self, _close, self._renderer, os.getpid())

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Render states `qpos` (n, nq) to uint8 frames (n, height, width, 3)."""
        gl.claim_process()
        return _GL_THREAD.submit(self._render, qpos).result()

    def _render(self, qpos: np.ndarray) -> np.ndarray:
        frames = np.empty((len(qpos), self.height, self.width, 3), np.uint8)
        for frame, q in zip(frames, qpos, strict=True):
            self._data.qpos[:] = q
            mujoco.mj_kinematics(self.model, self._data)
            mujoco.mj_camlight(self.model, self._data)
            self._renderer.update_scene(self._data, camera=self.camera)
            self._renderer.render(out=frame)
        return frames

    def close(self) -> None:
        """Free the OpenGL context; also done when the renderer is garbage-collected."""
        self._finalizer()


def _open(model: mujoco.MjModel, height: int, width: int, shadows: bool) -> mujoco.Renderer:
    try:
        renderer = mujoco.Renderer(model, height, width, max_geom=500)
    except Exception as error:  # The platforms raise whatever their bindings do.
        raise RuntimeError(gl.HELP.format(platform=os.environ.get("MUJOCO_GL"))) from error
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = shadows
    return renderer


def _close(renderer: mujoco.Renderer, opened_by: int) -> None:
    # A forked process has neither the thread nor the context.
    if opened_by != os.getpid():
        return
    # Nobody waits for it: the garbage collector may run in the OpenGL thread itself.
    try:
        _GL_THREAD.submit(renderer.close)
    except RuntimeError:  # At interpreter exit the thread is gone, and so is its hold on the context.
        renderer.close()
