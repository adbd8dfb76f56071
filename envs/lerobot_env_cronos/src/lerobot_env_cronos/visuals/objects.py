"""Looks of the objects and receptacles, one function per shape, each inside its bounding box."""

from collections.abc import Callable

import mujoco

from lerobot_env_cronos.bodies import SHOVEL_BLADE_SHARE, SHOVEL_HANDLE_HALF_WIDTH
from lerobot_env_cronos.scenes import Body
from lerobot_env_cronos.visuals.meshes import (
    add_visual,
    box,
    circle,
    prism,
    rounded_rectangle,
    stack,
    superellipse,
)


def _dress_bottle(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A red squeeze bottle lying along y, with a pale label and a white nozzle cap at +y."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = superellipse(hx, hz, 3.2)
    shoulder, cap = 0.36 * hy, 0.50 * hy
    profile = [(-hy, 0.82), (-0.93 * hy, 0.97), (shoulder, 0.97), (cap, 0.62)]
    add_visual(spec, spec_body, body.name, "ketchup", stack(outline, profile, "y", "first"))
    label = prism(outline, -0.52 * hy, 0.02 * hy, "y", "none")
    add_visual(spec, spec_body, f"{body.name} label", "label", label)
    nozzle = [(cap, 0.66), (0.70 * hy, 0.66), (hy, 0.26)]
    add_visual(spec, spec_body, f"{body.name} cap", "white plastic", stack(circle(hx, 8), nozzle, "y"))


def _dress_shovel(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A turner: a slotted teal blade towards -y and a blue handle towards +y, its end white."""
    hx, hy, hz = (s / 2 for s in body.size)
    back, top = -hy + 2 * SHOVEL_BLADE_SHARE * hy, -0.3 * hz
    front_bar, neck, tine = -hy + 0.012, back - 0.022, 0.16 * hx
    bars = [
        prism([(-hx, -hy + 0.004), (-hx + 0.004, -hy), (hx - 0.004, -hy), (hx, -hy + 0.004),
               (hx, front_bar), (-hx, front_bar)], -hz, -0.6 * hz, caps="last"),
        prism([(-hx, neck), (hx, neck), (hx, back - 0.012), (0.45 * hx, back), (-0.45 * hx, back),
               (-hx, back - 0.012)], -hz, top, caps="last"),
    ]  # fmt: skip
    tines = [
        box((x - tine, front_bar, -hz), (x + tine, neck, -0.6 * hz), caps="last")
        for x in (-hx + tine, -hx / 3 + 0.3 * tine, hx / 3 - 0.3 * tine, hx - tine)
    ]
    add_visual(spec, spec_body, body.name, "blade", *bars, *tines)
    outline = superellipse(SHOVEL_HANDLE_HALF_WIDTH, hz, 3.0, 8)
    grip = [(back - 0.008, 0.60), (back + 0.026, 1.0), (0.86 * hy, 1.0)]
    add_visual(spec, spec_body, f"{body.name} handle", "handle", stack(outline, grip, "y", "first"))
    end = prism(outline, 0.86 * hy, hy, "y", "last")
    add_visual(spec, spec_body, f"{body.name} end", "white plastic", end)


def _dress_plate(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A shallow plate: flared rim and a paler well just below the surface that objects rest on."""
    outline, hz = circle(body.size[0] / 2, 24), body.size[2] / 2
    rim = [(-hz, 0.72), (0.5 * hz, 1.0), (hz, 0.99), (0.2 * hz, 0.74)]
    add_visual(spec, spec_body, body.name, "yellow ceramic", stack(outline, rim, caps="first"))
    well = stack(0.74 * outline, [(0.1 * hz, 1.0), (0.2 * hz, 1.0)], caps="last")
    add_visual(spec, spec_body, f"{body.name} well", "yellow glaze", well)


def _dress_cloth(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A checkered cloth folded once: two layers with rounded edges."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = rounded_rectangle(hx, hy, 0.012)
    profile = [(-hz, 0.97), (-0.5 * hz, 1.0), (0.0, 0.965), (0.5 * hz, 0.99), (hz, 0.95)]
    surface = stack(outline, profile, caps="last")
    add_visual(spec, spec_body, body.name, "cloth", surface, texture_size=max(body.size))


LOOKS: dict[str, Callable[[mujoco.MjSpec, mujoco.MjsBody, Body], None]] = {
    "bottle": _dress_bottle,
    "shovel": _dress_shovel,
    "plate": _dress_plate,
    "cloth": _dress_cloth,
}
"""How to draw a body, by `Body.shape`."""
