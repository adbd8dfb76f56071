"""Collision geometry of the objects and receptacles: primitives that fill their published bounding boxes.

Each builder adds geoms to an MjSpec body whose origin is the centre of the bounding box, resting pose, z up.
Looks are added by `lerobot_env_cronos.scene.visuals`; only the geometry here has mass and collides.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from lerobot_env_cronos.scene.contacts import CONTACT_SOLIMP
from lerobot_env_cronos.scene.scenes import Body

# Sliding 1.0 as in SimplerEnv; torsional and rolling friction (condim 6) keep round bodies from rolling away.
FRICTION = [1.0, 0.01, 0.003]

COLLISION_GROUP = 3
MAX_CLOSING_TILT = 0.7
"""Vertical part of the unit vector along which a hand that points down closes."""


def _add_geom(spec_body: mujoco.MjsBody, body: Body, geom_type: mujoco.mjtGeom, size, pos=(0, 0, 0), **extra):
    spec_body.add_geom(
        type=geom_type, size=size, pos=pos, density=body.density, group=COLLISION_GROUP, condim=6,
        friction=FRICTION, solimp=CONTACT_SOLIMP, **extra,
    )  # fmt: skip


def _add_bottle(spec_body: mujoco.MjsBody, body: Body) -> None:
    """A squeeze bottle lying on its flat side: a box-shaped belly and a narrower neck along +y."""
    hx, hy, hz = (s / 2 for s in body.size)
    neck = 0.28 * hy
    box = mujoco.mjtGeom.mjGEOM_BOX
    _add_geom(spec_body, body, box, [hx, hy - neck, hz], [0, -neck, 0])
    _add_geom(spec_body, body, box, [0.55 * hx, neck, 0.55 * hz], [0, hy - neck, 0])


SHOVEL_BLADE_SHARE = 0.42
SHOVEL_HANDLE_HALF_WIDTH = 0.009


def _add_shovel(spec_body: mujoco.MjsBody, body: Body) -> None:
    """A flat blade (towards -y) on the table and a handle (towards +y) as thick as the bounding box."""
    hx, hy, hz = (s / 2 for s in body.size)
    blade_hy = SHOVEL_BLADE_SHARE * hy
    blade_hz = 0.35 * hz
    box = mujoco.mjtGeom.mjGEOM_BOX
    _add_geom(spec_body, body, box, [hx, blade_hy, blade_hz], [0, -hy + blade_hy, -hz + blade_hz])
    _add_geom(spec_body, body, box, [SHOVEL_HANDLE_HALF_WIDTH, hy - blade_hy, hz], [0, blade_hy, 0])


BEAR_BODY_SHARE = 0.55
BEAR_HEAD_DEPTH, BEAR_HEAD_WIDTH = 0.75, 0.85


def _add_bear(spec_body: mujoco.MjsBody, body: Body) -> None:
    """A sitting bear: body and legs as wide as the bounding box, so that it stands firmly, and a smaller head."""
    hx, hy, hz = (s / 2 for s in body.size)
    lower, upper = BEAR_BODY_SHARE * hz, (1 - BEAR_BODY_SHARE) * hz
    box = mujoco.mjtGeom.mjGEOM_BOX
    _add_geom(spec_body, body, box, [hx, hy, lower], [0, 0, -hz + lower])
    _add_geom(spec_body, body, box, [BEAR_HEAD_DEPTH * hx, BEAR_HEAD_WIDTH * hy, upper], [0, 0, hz - upper])


def _add_plate(spec_body: mujoco.MjsBody, body: Body) -> None:
    _add_geom(spec_body, body, mujoco.mjtGeom.mjGEOM_CYLINDER, [body.size[0] / 2, body.size[2] / 2, 0])


def _add_slab(spec_body: mujoco.MjsBody, body: Body) -> None:
    _add_geom(spec_body, body, mujoco.mjtGeom.mjGEOM_BOX, [s / 2 for s in body.size])


SHAPES: dict[str, Callable[[mujoco.MjsBody, Body], None]] = {
    "bottle": _add_bottle,
    "shovel": _add_shovel,
    "plate": _add_plate,
    "cloth": _add_slab,
    "bear": _add_bear,
    "water bottle": _add_bottle,
    "carpet": _add_slab,
    "newspaper": _add_slab,
    "box": _add_slab,
    "disc": _add_plate,
    "brick": _add_slab,
    "marker": _add_slab,
    "tape": _add_plate,
    "lid": _add_slab,
    "dish": _add_plate,
    "mat": _add_slab,
}
"""How to build a body, by `Body.shape`; another shape is another entry here and in `visuals.objects.LOOKS`."""
_PACKAGED = dict(SHAPES)
"""Those of this package, whatever is entered later: a name and its function."""


def narrowest_width(body: Body) -> float:
    """The least horizontal side of any of the boxes that a body consists of, in its resting pose [m].

    That is where a hand that points down can hold it, as a shovel by its handle.
    """
    model = _compile(body)
    widths = []
    for g in np.flatnonzero(model.geom_contype):
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        # Sides of the box along which a hand could close: those that are not upright.
        is_level = np.abs(rotation.reshape(3, 3)[2]) <= MAX_CLOSING_TILT
        widths += (2 * model.geom_aabb[g, 3:][is_level]).tolist()
    return min(widths)


def describe_collisions(body: Body) -> dict[str, Any]:
    """What is known of a body only by compiling it: nothing, unless its shape is none of this package's.

    Returns:
        Mass [kg], principal moments of inertia [kg m^2], and type, size [m], position [m], quaternion and friction
        of every geom that collides; rounded, for the last bits differ between processors.
    """
    if SHAPES[body.shape] is _PACKAGED.get(body.shape):
        return {}
    model = _compile(body)
    part = model.body(body.name)
    geoms = [_describe_geom(model, g) for g in np.flatnonzero(model.geom_contype | model.geom_conaffinity)]
    mass, *inertia = (float(f"{value:.6g}") for value in (*part.mass, *part.inertia))
    return {"mass": mass, "inertia": inertia, "geoms": geoms}


def _describe_geom(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    names = ("size", "pos", "quat", "friction")
    # Zero has a sign, which JSON would show.
    numbers = {name: (getattr(model, f"geom_{name}")[geom].round(6) + 0.0).tolist() for name in names}
    return {"type": mujoco.mjtGeom(model.geom_type[geom]).name} | numbers


def _compile(body: Body) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    add_body(spec, body)
    return spec.compile()


def add_body(spec: mujoco.MjSpec, body: Body) -> mujoco.MjsBody:
    """Add `body` as a free body to `spec` and return it."""
    spec_body = spec.worldbody.add_body(name=body.name, pos=[0, 0, body.size[2] / 2])
    spec_body.add_freejoint(name=body.name)
    SHAPES[body.shape](spec_body, body)
    return spec_body
