"""Frames of many simulations, by MuJoCo's classic renderer on a few threads."""

import os
import weakref
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from lerobot_env_cronos import gl


class BatchRenderer:
    """Renders `camera` of simulation states at `height` x `width`.

    Each worker thread owns one OpenGL context, created and used in that thread only. Shadows and reflections
    are off unless asked for: in software rendering they cost five times the rest of the frame.
    """

    def __init__(
        self, model: mujoco.MjModel, height: int, width: int, camera: str, num_workers: int = 1, shadows=False
    ):
        if model.camera(camera).id < 0:  # pragma: no cover - model.camera raises with the valid names
            raise ValueError(f"unknown camera {camera!r}")
        self.model, self.height, self.width, self.camera = model, height, width, camera
        self._shadows = shadows
        self._pools = [ThreadPoolExecutor(1, thread_name_prefix="render") for _ in range(num_workers)]
        self._workers = [pool.submit(self._make_worker).result() for pool in self._pools]
        self._finalizer = weakref.finalize(self, _free, self._pools, self._workers)

    def _make_worker(self) -> tuple[mujoco.Renderer, mujoco.MjData]:
        try:
            renderer = mujoco.Renderer(self.model, self.height, self.width, max_geom=500)
        except Exception as error:  # The platforms raise whatever their bindings do.
            raise RuntimeError(gl.HELP.format(platform=os.environ.get("MUJOCO_GL"))) from error
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._shadows
        return renderer, mujoco.MjData(self.model)

    def render(self, qpos: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Render states `qpos` (n, nq) to uint8 frames (n, height, width, 3)."""
        n = len(qpos)
        frames = np.empty((n, self.height, self.width, 3), np.uint8) if out is None else out
        k = len(self._workers)
        jobs = [
            pool.submit(_render_some, worker, self.camera, qpos, frames, range(i, n, k))
            for i, (pool, worker) in enumerate(zip(self._pools, self._workers, strict=True))
        ]
        for job in jobs:
            job.result()
        return frames

    def close(self) -> None:
        """Free the OpenGL contexts; also done when the renderer is garbage-collected."""
        self._finalizer()


def _free(pools: list[ThreadPoolExecutor], workers: list) -> None:
    """Free each OpenGL context in the thread in which it is current: elsewhere EGL refuses."""
    for pool, (renderer, _) in zip(pools, workers, strict=True):
        try:
            pool.submit(renderer.close).result()
        except RuntimeError:  # At interpreter exit the threads are gone, and so is their hold on the context.
            renderer.close()
        pool.shutdown()


def _render_some(worker, camera: str, qpos: np.ndarray, frames: np.ndarray, indices: range) -> None:
    renderer, data = worker
    for i in indices:
        data.qpos[:] = qpos[i]
        mujoco.mj_kinematics(renderer.model, data)
        mujoco.mj_camlight(renderer.model, data)
        renderer.update_scene(data, camera=camera)
        renderer.render(out=frames[i])
