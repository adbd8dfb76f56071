"""An OpenGL context that draws a model, and the process that has one of its own.

    python canvas.py MODEL.mjb HEIGHT WIDTH CAMERA

It imports nothing but numpy and mujoco, so that such a process starts in a moment; see `render_pool`.
"""

import signal
import struct
import sys

import mujoco
import numpy as np

READY, COUNT = b"r", struct.Struct("<i")
"""What a process says when it can draw; how many states, float64 (nq,), a request consists of."""


class Canvas:
    """Draws states of `model` from one camera; all calls come from one thread.

    Not mujoco.Renderer, which makes the context current and flips the picture anew for every frame: a sixth of the
    time of a small one.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: int):
        self._model, self._data = model, mujoco.MjData(model)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene, self._options = mujoco.MjvScene(model, maxgeom=500), mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        # In software they cost five times the rest of the frame.
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        # The buffer is as large as the model says, and a picture beyond it is black there.
        screen = model.vis.global_
        screen.offwidth, screen.offheight = max(screen.offwidth, width), max(screen.offheight, height)
        self._context = mujoco.GLContext(width, height)
        self._context.make_current()
        self._resources = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._resources)

    def draw(self, qpos: np.ndarray, frames: np.ndarray) -> None:
        """Draw states (n, nq) into `frames` (n, height, width, 3) uint8."""
        everything = mujoco.mjtCatBit.mjCAT_ALL
        self._context.make_current()
        upside_down = np.empty(frames.shape[1:], np.uint8)
        for q, frame in zip(qpos, frames, strict=True):
            self._data.qpos[:] = q
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_camlight(self._model, self._data)
            mujoco.mjv_updateScene(
                self._model, self._data, self._options, None, self._camera, everything, self._scene
            )
            mujoco.mjr_render(self._rect, self._scene, self._resources)
            mujoco.mjr_readPixels(upside_down, None, self._rect, self._resources)
            frame[:] = upside_down[::-1]

    def driver(self) -> str:
        """What OpenGL draws with."""
        from OpenGL import GL

        self._context.make_current()
        return (GL.glGetString(GL.GL_RENDERER) or b"").decode(errors="replace")

    def close(self) -> None:
        """Free the context."""
        self._context.make_current()
        self._resources.free()
        self._context.free()


def serve(model_path: str, *numbers: str) -> None:
    """Answer each request on standard input with its frames (n, height, width, 3) uint8, until it ends."""
    height, width, camera = map(int, numbers)
    # Ctrl-C goes to all processes of a terminal, SIGTERM to all of a cluster's job; the one that asked decides,
    # and this one ends with its standard input.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    model = mujoco.MjModel.from_binary_path(model_path)
    canvas = Canvas(model, height, width, camera)
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    answers.write(READY)
    answers.flush()
    while len(head := requests.read(COUNT.size)) == COUNT.size:
        (count,) = COUNT.unpack(head)
        states = np.frombuffer(requests.read(count * model.nq * 8)).reshape(count, model.nq)
        frames = np.empty((count, height, width, 3), np.uint8)
        canvas.draw(states, frames)
        answers.write(frames.data)
        answers.flush()


if __name__ == "__main__":
    serve(*sys.argv[1:])
