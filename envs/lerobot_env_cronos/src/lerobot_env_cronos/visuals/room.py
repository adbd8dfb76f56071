"""Table, floor, lights and the quality settings of the renderer."""

import mujoco

from lerobot_env_cronos.visuals.materials import FLOOR_TEXTURE_M, TABLE_TEXTURE_M
from lerobot_env_cronos.visuals.meshes import VISUAL_GROUP, add_visual, box

EDGE_TRIM_M = 0.012
LEG_HALF_WIDTH_M = 0.03


def set_quality(spec: mujoco.MjSpec) -> None:
    """Few slices, a small shadow map and no multisampling: most of a small frame's cost in software."""
    visual = spec.visual
    visual.quality.shadowsize = 1024
    visual.quality.offsamples = 0
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 10, 6, 4
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    # Near and far plane are multiples of the extent.
    spec.stat.extent, spec.stat.center = 1.0, [0.25, 0.0, 0.1]
    visual.map.znear, visual.map.zfar = 0.02, 10.0
    visual.map.shadowclip, visual.map.shadowscale = 1.0, 0.6


def dress_room(spec: mujoco.MjSpec) -> None:
    """Draw the table and the floor around their collision geoms, and light the room."""
    _add_table(spec)
    floor = spec.geom("floor")
    spec.worldbody.add_geom(
        name="floor visual", type=mujoco.mjtGeom.mjGEOM_PLANE, size=floor.size, pos=floor.pos, material="floor",
        contype=0, conaffinity=0, group=VISUAL_GROUP,
    )  # fmt: skip
    spec.material("floor").texrepeat = [1 / FLOOR_TEXTURE_M] * 2
    spec.material("floor").texuniform = True
    _add_lights(spec)


def _add_table(spec: mujoco.MjSpec) -> None:
    table, floor_z = spec.geom("table"), spec.geom("floor").pos[2]
    low, high = table.pos - table.size, table.pos + table.size
    world, t = spec.worldbody, EDGE_TRIM_M
    add_visual(
        spec, world, "table top", "table top",
        box((low[0] + t, low[1] + t, low[2]), (high[0] - t, high[1] - t, high[2])), texture_size=TABLE_TEXTURE_M,
    )  # fmt: skip
    trims = [
        box((low[0], low[1], low[2]), (low[0] + t, high[1], high[2])),
        box((high[0] - t, low[1], low[2]), (high[0], high[1], high[2])),
        box((low[0] + t, low[1], low[2]), (high[0] - t, low[1] + t, high[2])),
        box((low[0] + t, high[1] - t, low[2]), (high[0] - t, high[1], high[2])),
    ]
    add_visual(spec, world, "table edge", "table edge", *trims)
    w = LEG_HALF_WIDTH_M
    legs = [
        box((x - w, y - w, floor_z), (x + w, y + w, low[2]))
        for x in (low[0] + 2 * w, high[0] - 2 * w)
        for y in (low[1] + 2 * w, high[1] - 2 * w)
    ]
    add_visual(spec, world, "table legs", "table leg", *legs)


def _add_lights(spec: mujoco.MjSpec) -> None:
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.34] * 3, [0.22] * 3, [0.10] * 3
    # A key light from the left, in front of the robot, and a weaker fill from the right without shadows.
    for name, direction, strength, shadows in (
        ("key", (-0.45, -0.55, -1.0), 0.50, True),
        ("fill", (0.35, 0.75, -0.7), 0.16, False),
    ):
        spec.worldbody.add_light(
            name=name, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=direction,
            pos=[-1.5 * d for d in direction], diffuse=[strength] * 3, specular=[0.6 * strength] * 3,
            ambient=[0.0] * 3, castshadow=shadows,
        )  # fmt: skip
