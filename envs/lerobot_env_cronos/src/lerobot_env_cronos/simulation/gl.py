"""Which OpenGL platform MuJoCo renders with; must be imported before mujoco."""

import ctypes.util
import os
import sys

NO_CONTEXT = (
    "cannot open an OpenGL context (MUJOCO_GL={platform!r}): {cause}. If packages are missing, install on Debian "
    "or Ubuntu `apt-get install libegl1 libgl1 libgl1-mesa-dri` and set MUJOCO_GL=egl; `--env.obs_type="
    "environment_state_agent_pos` needs no OpenGL"
)
FORKED = (
    "this process was forked from one that had drawn, and OpenGL does not survive a fork: start it by spawn or "
    "forkserver (gymnasium.vector.AsyncVectorEnv(..., context='spawn')), or before the first frame is drawn; "
    "`--env.obs_type=environment_state_agent_pos` needs no OpenGL"
)


class RenderingError(RuntimeError):
    """This machine, or this process, cannot draw; the message says what it lacks."""


_drawn_by: int | None = None


def claim_process() -> None:
    """Note that this process draws.

    Raises:
        RenderingError: it inherited OpenGL from one that did, so drawing would wait for threads that are gone.
    """
    global _drawn_by
    if _drawn_by is None:
        _drawn_by = os.getpid()
    if _drawn_by != os.getpid():
        raise RenderingError(FORKED)


def choose_platform() -> None:
    """Without a display, Linux renders through EGL, unless MUJOCO_GL says otherwise."""
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY")
    chosen = "MUJOCO_GL" in os.environ or "mujoco" in sys.modules
    if headless and not chosen and ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"


choose_platform()
