"""Looks of the objects and receptacles, one function per shape, each inside its bounding box."""

from collections.abc import Callable

import mujoco
import numpy as np

from lerobot_env_cronos.bodies import SHOVEL_BLADE_SHARE, SHOVEL_HANDLE_HALF_WIDTH
from lerobot_env_cronos.scenes import Body
from lerobot_env_cronos.visuals.materials import CLOTH_TEXTURE_M
from lerobot_env_cronos.visuals.meshes import add_visual, box, circle, prism, stack, superellipse


def _dress_bottle(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A red squeeze bottle lying along y, with a pale label and a white nozzle cap at +y."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = superellipse(hx, hz, 3.2)
    shoulder, cap = 0.36 * hy, 0.50 * hy
    profile = [(-hy, 0.78), (-0.94 * hy, 0.95), (shoulder, 0.97), (0.44 * hy, 0.86), (cap, 0.60)]
    add_visual(spec, spec_body, body.name, "ketchup", stack(outline, profile, "y"))
    label = [(-0.52 * hy, 0.97), (-0.52 * hy, 1.0), (0.02 * hy, 1.0), (0.02 * hy, 0.97)]
    add_visual(spec, spec_body, f"{body.name} label", "label", stack(outline, label, "y"))
    nozzle = [(cap, 0.66), (0.68 * hy, 0.66), (0.72 * hy, 0.50), (hy, 0.26)]
    add_visual(spec, spec_body, f"{body.name} cap", "white plastic", stack(circle(hx, 12), nozzle, "y"))


def _dress_shovel(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A turner: a slotted teal blade towards -y and a blue handle towards +y, its end white."""
    hx, hy, hz = (s / 2 for s in body.size)
    back, top = -hy + 2 * SHOVEL_BLADE_SHARE * hy, -hz + 0.7 * hz
    bar, tine = 0.012, 0.16 * hx
    bars = [
        prism([(-hx, -hy + 0.004), (-hx + 0.004, -hy), (hx - 0.004, -hy), (hx, -hy + 0.004),
               (hx, -hy + bar), (-hx, -hy + bar)], -hz, 0.6 * top - 0.4 * hz),
        prism([(-hx, back - bar - 0.010), (hx, back - bar - 0.010), (hx, back - 0.012), (0.45 * hx, back),
               (-0.45 * hx, back), (-hx, back - 0.012)], -hz, top),
    ]  # fmt: skip
    tines = [
        box((x - tine, -hy + bar, -hz), (x + tine, back - bar - 0.010, 0.8 * top - 0.2 * hz))
        for x in (-hx + tine, -hx / 3 + 0.3 * tine, hx / 3 - 0.3 * tine, hx - tine)
    ]
    add_visual(spec, spec_body, body.name, "blade", *bars, *tines)
    outline = superellipse(SHOVEL_HANDLE_HALF_WIDTH, hz, 3.0, 12)
    grip = [(back - 0.006, 0.55), (back + 0.012, 0.80), (back + 0.030, 1.0), (0.86 * hy, 1.0)]
    add_visual(spec, spec_body, f"{body.name} handle", "handle", stack(outline, grip, "y"))
    end = [(0.86 * hy, 1.0), (0.96 * hy, 1.0), (hy, 0.8)]
    add_visual(spec, spec_body, f"{body.name} end", "white plastic", stack(outline, end, "y"))


def _dress_plate(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A shallow plate: foot, flared rim and a well just below the surface that objects rest on."""
    radius, hz = body.size[0] / 2, body.size[2] / 2
    profile = [(-hz, 0.0), (-hz, 0.70), (0.4 * hz, 0.97), (hz, 1.0), (hz, 0.95), (0.1 * hz, 0.70), (0.1 * hz, 0.0)]
    add_visual(spec, spec_body, body.name, "yellow ceramic", stack(circle(radius, 32), profile))


def _dress_cloth(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A checkered cloth folded once: two layers with rounded edges."""
    hx, hy, hz = (s / 2 for s in body.size)
    profile = [(-hz, 0.96), (-0.5 * hz, 1.0), (-0.05 * hz, 0.965), (0.05 * hz, 0.965), (0.5 * hz, 0.995), (hz, 0.94)]
    outline = np.asarray(superellipse(hx, hy, 14.0, 24))
    add_visual(spec, spec_body, body.name, "cloth", stack(outline, profile), texture_size=CLOTH_TEXTURE_M)


LOOKS: dict[str, Callable[[mujoco.MjSpec, mujoco.MjsBody, Body], None]] = {
    "bottle": _dress_bottle,
    "shovel": _dress_shovel,
    "plate": _dress_plate,
    "cloth": _dress_cloth,
}
"""How to draw a body, by `Body.shape`."""
