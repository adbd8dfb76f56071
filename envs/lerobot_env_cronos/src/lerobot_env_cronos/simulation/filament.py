"""Frames of many simulations, by MuJoCo's physically based renderer, Filament, with shadows.

On Linux it draws through Vulkan, on a GPU or in software (Debian's `mesa-vulkan-drivers`), elsewhere by the
platform's own means. Its dithering changes from frame to frame, and MuJoCo has no switch for it: two frames of
one state differ by a grey level here and there, and by more at a few edges.
"""

import ctypes
import os
import sys
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from queue import SimpleQueue
from typing import Any

import mujoco
import numpy as np

from lerobot_env_cronos.simulation import gl

HELP = (
    "Filament finds no Vulkan device. Debian and Ubuntu draw in software with `apt-get install "
    "mesa-vulkan-drivers`; a GPU's driver brings Vulkan. `--env.renderer=classic` needs OpenGL only"
)


class _Thread:
    """One thread that does everything.

    Filament's engine must be shut down by the thread that made it; at exit an executor's are gone too early.
    """

    def __init__(self) -> None:
        self._calls: SimpleQueue[tuple[Future, Callable, tuple]] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="filament", daemon=True)
        self._thread.start()

    def call(self, function: Callable, *args: Any) -> Any:
        """Return what `function` returns, or raise what it raises, in the thread."""
        # The garbage collector may close a renderer in the thread itself.
        if threading.current_thread() is self._thread:
            return function(*args)
        future: Future = Future()
        self._calls.put((future, function, args))
        return future.result()

    def _work(self) -> None:
        while True:
            future, function, args = self._calls.get()
            try:
                future.set_result(function(*args))
            except BaseException as error:
                future.set_exception(error)
            # Waiting for the next call must not keep the arguments of this one alive.
            del future, function, args


@cache
def _thread() -> _Thread:
    """The process's, from the first renderer on."""
    return _Thread()


class FilamentRenderer:
    """Renders `camera` of simulation states at `height` x `width`, with shadows.

    Raises:
        KeyError: the model has no such camera.
        RenderingError: there is no Vulkan device.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: str):
        self.model, self.height, self.width = model, height, width
        self.camera = model.camera(camera).id
        self._moves = bool(model.cam_bodyid[self.camera])
        self._view: list[Any] = _thread().call(_open, model, self.camera)
        self._finalizer = weakref.finalize(self, _close, self._view, os.getpid())

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Render states `qpos` (n, nq) to uint8 frames (n, height, width, 3)."""
        gl.claim_process()
        return _thread().call(self._render, qpos)

    def _render(self, qpos: np.ndarray) -> np.ndarray:
        data, renderer, scene, view = self._view
        frames = np.empty((len(qpos), self.height, self.width, 3), np.uint8)
        for frame, q in zip(frames, qpos, strict=True):
            data.qpos[:] = q
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_camlight(self.model, data)
            scene.update(data)
            if self._moves:
                view.camera = _camera(self.model, data, self.camera)
            renderer.target("frame", frame)
            renderer.render([view])
        return frames

    def close(self) -> None:
        """Free the scene; also done when the renderer is garbage-collected."""
        self._finalizer()


def _close(view: list[Any], opened_by: int) -> None:
    # A forked process has no such thread.
    if opened_by == os.getpid():
        _thread().call(view.clear)


def _open(model: mujoco.MjModel, camera: int) -> list[Any]:
    """What a frame is drawn with. A list is freed from its end: the scene goes before its renderer."""
    import mujoco.studio  # brings Filament's materials
    from mujoco import mjrf
    from mujoco.rendering.filament.model_scene import ModelScene
    from mujoco.rendering.filament.renderer import Renderer, View

    config = mjrf.ContextConfig()
    if sys.platform == "linux":
        # Without a device, or a display for OpenGL, Filament ends the process.
        if not count_vulkan_devices():
            raise gl.RenderingError(HELP)
        config.graphics_api = mjrf.GraphicsApi.GRAPHICS_API_VULKAN
    # One for each renderer: MuJoCo draws no second scene in it.
    renderer = Renderer(mjrf.Context(config))
    scene = ModelScene(renderer.context, model, renderer.scene("scene"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # A camera that moves is set anew for every frame.
    return [data, renderer, scene, View("scene", "frame", camera=_camera(model, data, camera))]


def _camera(model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> mujoco.MjvGLCamera:
    chosen = mujoco.MjvCamera()
    chosen.type, chosen.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
    scene = mujoco.MjvScene(model, 1)
    mujoco.mjv_updateCamera(model, data, chosen, scene)
    # The two are a viewer's eyes.
    return mujoco.mjv_averageCamera(*scene.camera)


class _InstanceCreateInfo(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_int), ("next", ctypes.c_void_p), ("flags", ctypes.c_uint32),
        ("application", ctypes.c_void_p),
        ("layer_count", ctypes.c_uint32), ("layers", ctypes.c_void_p),
        ("extension_count", ctypes.c_uint32), ("extensions", ctypes.c_void_p),
    )  # fmt: skip


def count_vulkan_devices() -> int:
    """How many devices, software ones included, Vulkan finds."""
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError:
        return 0
    instance, count = ctypes.c_void_p(), ctypes.c_uint32(0)
    # 1 is VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO, 0 VK_SUCCESS.
    if vulkan.vkCreateInstance(ctypes.byref(_InstanceCreateInfo(type=1)), None, ctypes.byref(instance)) != 0:
        return 0
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    vulkan.vkDestroyInstance(instance, None)
    return count.value
