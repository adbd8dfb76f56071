"""An OpenGL context that draws a model, and the process that has one of its own.

    python canvas.py MODEL.mjb SHARED_FILE HEIGHT WIDTH CAMERA CAPACITY

It imports nothing but numpy and mujoco, so that such a process starts in a moment; see `render_pool`.
"""

import signal
import struct
import sys

import mujoco
import numpy as np

REQUEST, ANSWER = struct.Struct("<ii"), b"d"
"""First row and number of rows to draw; done."""


class Canvas:
    """Draws states of `model` from one camera; all calls come from one thread.

    Not mujoco.Renderer, which makes the context current and flips the picture anew for every frame: a sixth of the
    time of a small one.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, camera: int, shadows: bool = False):
        self._model, self._data = model, mujoco.MjData(model)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene, self._options = mujoco.MjvScene(model, maxgeom=500), mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = shadows
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


def shared_arrays(path: str, capacity: int, nq: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """States (capacity, nq) float64 and frames (capacity, height, width, 3) uint8 in a file that two map."""
    offset = capacity * nq * 8
    memory = np.memmap(path, np.uint8, "r+", shape=(offset + capacity * height * width * 3,))
    return memory[:offset].view(np.float64).reshape(capacity, nq), memory[offset:].reshape(-1, height, width, 3)


def serve(model_path: str, shared_path: str, *numbers: str) -> None:
    """Draw what is asked for on standard input, until it ends."""
    height, width, camera, capacity = map(int, numbers)
    # Ctrl-C goes to all processes of a terminal, SIGTERM to all of a cluster's job; the one that asked decides,
    # and this one ends with its standard input.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    model = mujoco.MjModel.from_binary_path(model_path)
    states, frames = shared_arrays(shared_path, capacity, model.nq, height, width)
    canvas = Canvas(model, height, width, camera)
    sys.stdout.buffer.write(ANSWER)
    sys.stdout.buffer.flush()
    while len(request := sys.stdin.buffer.read(REQUEST.size)) == REQUEST.size:
        first, count = REQUEST.unpack(request)
        canvas.draw(states[first : first + count], frames[first : first + count])
        sys.stdout.buffer.write(ANSWER)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    serve(*sys.argv[1:])
