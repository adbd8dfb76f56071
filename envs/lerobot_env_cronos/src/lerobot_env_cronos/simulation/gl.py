"""Which OpenGL platform MuJoCo renders with; must be imported before mujoco."""

import ctypes.util
import os
import sys

HELP = (
    "cannot open an OpenGL context (MUJOCO_GL={platform!r}). Headless rendering on Debian or Ubuntu needs "
    "`apt-get install libegl1 libgl1 libgl1-mesa-dri` and MUJOCO_GL=egl; `--env.obs_type="
    "environment_state_agent_pos` needs no OpenGL"
)


def choose_platform() -> None:
    """Without a display, Linux renders through EGL, unless MUJOCO_GL says otherwise."""
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY")
    chosen = "MUJOCO_GL" in os.environ or "mujoco" in sys.modules
    if headless and not chosen and ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"


choose_platform()
