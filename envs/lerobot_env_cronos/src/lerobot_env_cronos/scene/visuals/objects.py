"""Looks of the objects and receptacles, one function per shape, each inside its bounding box.

What a look consists of is named `<body>` and `<body>/<part>`, so that no two bodies share a name.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from lerobot_env_cronos.scene.bodies import SHOVEL_BLADE_SHARE, SHOVEL_HANDLE_HALF_WIDTH
from lerobot_env_cronos.scene.scenes import Body
from lerobot_env_cronos.scene.visuals.materials import add_plain_material
from lerobot_env_cronos.scene.visuals.meshes import (
    Surface,
    add_visual,
    box,
    circle,
    cylinder,
    loft,
    merge,
    prism,
    rounded_rectangle,
    stack,
    superellipse,
)

DEFAULT_COLOUR = (0.55, 0.55, 0.58)
"""RGB of a plain body without a colour of its own."""


def _dress_bottle(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A red squeeze bottle lying along y, with a pale label and a white nozzle cap at +y."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = superellipse(hx, hz, 3.2)
    shoulder, cap = 0.36 * hy, 0.50 * hy
    profile = [(-hy, 0.82), (-0.93 * hy, 0.97), (shoulder, 0.97), (cap, 0.62)]
    add_visual(spec, spec_body, body.name, "ketchup", stack(outline, profile, "y", "first"))
    label = prism(outline, -0.52 * hy, 0.02 * hy, "y", "none")
    add_visual(spec, spec_body, f"{body.name}/label", "label", label)
    nozzle = [(cap, 0.66), (0.70 * hy, 0.66), (hy, 0.26)]
    add_visual(spec, spec_body, f"{body.name}/cap", "white plastic", stack(circle(hx, 8), nozzle, "y"))


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
    add_visual(spec, spec_body, f"{body.name}/handle", "handle", stack(outline, grip, "y", "first"))
    end = prism(outline, 0.86 * hy, hy, "y", "last")
    add_visual(spec, spec_body, f"{body.name}/end", "white plastic", end)


def _dress_plate(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A shallow plate: flared rim and a paler well just below the surface that objects rest on."""
    outline, hz = circle(body.size[0] / 2, 24), body.size[2] / 2
    rim = [(-hz, 0.72), (0.5 * hz, 1.0), (hz, 0.99), (0.2 * hz, 0.74)]
    add_visual(spec, spec_body, body.name, "yellow ceramic", stack(outline, rim, caps="first"))
    well = stack(0.74 * outline, [(0.1 * hz, 1.0), (0.2 * hz, 1.0)], caps="last")
    add_visual(spec, spec_body, f"{body.name}/well", "yellow glaze", well)


def _dress_cloth(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A checkered cloth folded once: two layers with rounded edges."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = rounded_rectangle(hx, hy, 0.012)
    profile = [(-hz, 0.97), (-0.5 * hz, 1.0), (0.0, 0.965), (0.5 * hz, 0.99), (hz, 0.95)]
    surface = stack(outline, profile, caps="last")
    add_visual(spec, spec_body, body.name, "cloth", surface, texture_size=max(body.size))


def _dress_bear(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A teddy bear that sits upright and looks along +x: brown, with a pale snout, tummy and soles."""
    hx, hy, hz = (s / 2 for s in body.size)
    limb, ear, back = 0.36 * hy, 0.34 * hy, -0.25 * hx
    torso = stack(
        superellipse(0.75 * hx, 0.84 * hy, 2.4, 10),
        [(-hz, 0.74), (-0.76 * hz, 0.98), (-0.42 * hz, 1.0), (-0.08 * hz, 0.82), (0.12 * hz, 0.6)],
        caps="none", pos=(back, 0, 0),
    )  # fmt: skip
    head = stack(
        superellipse(0.75 * hx, 0.86 * hy, 2.2, 10),
        [(-0.06 * hz, 0.55), (0.14 * hz, 0.92), (0.42 * hz, 1.0), (0.68 * hz, 0.86), (0.86 * hz, 0.45)],
        caps="last", pos=(back, 0, 0),
    )  # fmt: skip

    def roll(
        radius: float, x0: float, x1: float, y: float, z: float, sides: int = 6, caps: str = "last"
    ) -> Surface:
        return cylinder(radius, x0 * hx, x1 * hx, "x", (0, y, z), sides, caps)

    arm = 0.8 * limb
    limbs, pale, face = [], [], []
    for side in (-1, 1):
        limbs += [
            roll(limb, -0.2, 0.96, side * (hy - limb), -hz + limb, 8),
            roll(arm, -0.4, 0.62, side * (hy - arm), -0.2 * hz),
            roll(ear, -0.45, -0.1, side * (hy - ear), hz - ear, 8),
        ]
        pale.append(roll(0.7 * limb, 0.96, 1.0, side * (hy - limb), -hz + limb))
        face.append(roll(0.13 * hy, 0.3, 0.5, side * 0.42 * hy, 0.56 * hz))
    pale += [roll(0.36 * hy, 0.2, 0.76, 0, 0.26 * hz, 8), roll(0.48 * hy, 0.3, 0.54, 0, -0.42 * hz, 8)]
    face.append(roll(0.17 * hy, 0.7, 0.86, 0, 0.36 * hz))
    add_visual(spec, spec_body, body.name, "fur", torso, head, *limbs)
    add_visual(spec, spec_body, f"{body.name}/pale", "light fur", *pale)
    add_visual(spec, spec_body, f"{body.name}/face", "bead", *face)


def _dress_water_bottle(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A pale blue bottle lying along y, with a dark blue label and a white screw cap at +y."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = superellipse(hx, hz, 2.6)
    shoulder, neck, cap = 0.30 * hy, 0.70 * hy, 0.78 * hy
    profile = [(-hy, 0.80), (-0.95 * hy, 0.99), (shoulder, 0.99), (0.5 * hy, 0.72), (neck, 0.42), (cap, 0.42)]
    add_visual(spec, spec_body, body.name, "clear plastic", stack(outline, profile, "y", "first"))
    label = prism(outline, -0.58 * hy, 0.10 * hy, "y", "none")
    add_visual(spec, spec_body, f"{body.name}/label", "bottle label", label)
    screw = prism(circle(0.52 * hx, 8), cap, hy, "y")
    add_visual(spec, spec_body, f"{body.name}/cap", "white plastic", screw)


def _dress_carpet(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A crimson rug with a border and a diamond."""
    hx, hy, hz = (s / 2 for s in body.size)
    surface = box((-hx, -hy, -hz), (hx, hy, hz), caps="last")
    add_visual(spec, spec_body, body.name, "carpet", surface, texture_size=body.size[:2])


def _dress_newspaper(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A folded newspaper: a lower layer that shows at the edges and the front page on top."""
    hx, hy, hz = (s / 2 for s in body.size)
    edge = 0.0012
    lower = box((-hx, -hy, -hz), (hx, hy, 0.2 * hz), caps="last")
    upper = box((-hx + edge, -hy + edge, 0.2 * hz), (hx - edge, hy - edge, hz), caps="last")
    add_visual(spec, spec_body, body.name, "newspaper", lower, upper, texture_size=body.size[:2])


def _dress_box(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A plain box of the body's colour."""
    hx, hy, hz = (s / 2 for s in body.size)
    _add_plain(spec, spec_body, body, box((-hx, -hy, -hz), (hx, hy, hz)))


def _dress_disc(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A plain disc of the body's colour."""
    _add_plain(spec, spec_body, body, cylinder(body.size[0] / 2, -body.size[2] / 2, body.size[2] / 2, sides=24))


def _dress_brick(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A building block of the body's colour with a pale stripe across its middle."""
    hx, hy, hz = (s / 2 for s in body.size)
    _add_plain(spec, spec_body, body, box((-hx, -hy, -hz), (hx, hy, hz), 0.002))
    stripe = box((-hx - 5e-5, -0.2 * hy, -hz), (hx + 5e-5, 0.2 * hy, hz + 5e-5), caps="last")
    add_visual(spec, spec_body, f"{body.name}/stripe", "white plastic", stripe)


def _dress_marker(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A marker lying along y: a white barrel, a cap of the body's colour at +y, and a band of it at -y."""
    hx, hy, hz = (s / 2 for s in body.size)
    outline = superellipse(hx, hz, 3.0, 10)
    barrel = prism(0.96 * outline, -0.94 * hy, 0.40 * hy, "y", "none")
    add_visual(spec, spec_body, f"{body.name}/barrel", "white plastic", barrel)
    cap = stack(outline, [(0.38 * hy, 1.0), (0.94 * hy, 1.0), (hy, 0.72)], "y")
    end = stack(outline, [(-hy, 0.86), (-0.92 * hy, 1.0), (-0.80 * hy, 1.0)], "y")
    _add_plain(spec, spec_body, body, merge(cap, end))


def _dress_tape(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A roll of masking tape, lying: a ring around a cardboard core."""
    radius, hz = body.size[0] / 2, body.size[2] / 2
    for part, material, outer, inner in (("", "masking tape", 1.0, 0.62), ("/core", "cardboard edge", 0.62, 0.54)):
        add_visual(spec, spec_body, body.name + part, material, _ring(radius * outer, radius * inner, hz))


def _ring(outer: float, inner: float, hz: float) -> Surface:
    """A ring about the z axis from -hz to hz: its walls and its flat sides."""
    sections = [(inner, -hz), (outer, -hz), (outer, hz), (inner, hz), (inner, -hz)]
    rings = [np.column_stack([circle(radius, 16), np.full(16, z)]) for radius, z in sections]
    return loft(np.stack(rings), "none")


def _dress_lid(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A cardboard lid, upside up, with darker edges."""
    hx, hy, hz = (s / 2 for s in body.size)
    edge = 0.004
    add_visual(
        spec, spec_body, body.name, "cardboard edge", box((-hx, -hy, -hz), (hx, hy, hz - 2e-4), 0.003, "last")
    )
    top = box((-hx + edge, -hy + edge, hz - 2e-4), (hx - edge, hy - edge, hz), 0.002, "last")
    add_visual(spec, spec_body, f"{body.name}/top", "cardboard", top)


def _dress_dish(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A shallow plate: a flared rim of the body's colour around a white well."""
    outline, hz = circle(body.size[0] / 2, 24), body.size[2] / 2
    _add_plain(spec, spec_body, body, stack(outline, [(-hz, 0.72), (0.5 * hz, 1.0), (hz, 0.98), (0.4 * hz, 0.74)]))
    well = stack(0.74 * outline, [(0.3 * hz, 1.0), (0.45 * hz, 1.0)], caps="last")
    add_visual(spec, spec_body, f"{body.name}/well", "white plastic", well)


def _dress_mat(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body) -> None:
    """A green cutting mat with a grid."""
    hx, hy, hz = (s / 2 for s in body.size)
    surface = box((-hx, -hy, -hz), (hx, hy, hz), 0.004, "last")
    add_visual(spec, spec_body, body.name, "mat", surface, texture_size=body.size[:2])


def _add_plain(spec: mujoco.MjSpec, spec_body: mujoco.MjsBody, body: Body, surface: Surface) -> None:
    material = f"{body.name} colour"
    add_plain_material(spec, material, body.colour or DEFAULT_COLOUR)
    add_visual(spec, spec_body, body.name, material, surface)


LOOKS: dict[str, Callable[[mujoco.MjSpec, mujoco.MjsBody, Body], None]] = {
    "bottle": _dress_bottle,
    "shovel": _dress_shovel,
    "plate": _dress_plate,
    "cloth": _dress_cloth,
    "bear": _dress_bear,
    "water bottle": _dress_water_bottle,
    "carpet": _dress_carpet,
    "newspaper": _dress_newspaper,
    "box": _dress_box,
    "disc": _dress_disc,
    "brick": _dress_brick,
    "marker": _dress_marker,
    "tape": _dress_tape,
    "lid": _dress_lid,
    "dish": _dress_dish,
    "mat": _dress_mat,
}
"""How to draw a body, by `Body.shape`."""
