"""Table, floor, walls, lights and the quality settings of the renderer."""

import itertools

import mujoco
import numpy as np

from lerobot_env_cronos.scene.visuals.meshes import Surface, add_visual, box, loft, rectangle

EDGE_TRIM_M = 0.012
LEG_HALF_WIDTH_M = 0.03
STAVE_WIDTH_M, STAVE_LENGTHS_M = 0.06, (0.18, 0.36)
"""The table top is a butcher block: staves along y, of random lengths."""

ROOM_HALF_SIZE_M, ROOM_HEIGHT_M = 4.0, 3.0


def set_quality(spec: mujoco.MjSpec) -> None:
    """Few slices and no multisampling, which more than doubles the cost of a 128 px frame in software."""
    visual = spec.visual
    visual.quality.shadowsize = 2048
    visual.quality.offsamples = 0
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 10, 6, 1
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    # Near and far plane are multiples of the extent; the shadow map covers 1.1 m around the key light.
    spec.stat.extent, spec.stat.center = 1.0, [0.25, 0.0, 0.1]
    visual.map.znear, visual.map.zfar = 0.02, 12.0
    visual.map.shadowclip = 1.1


def dress_room(spec: mujoco.MjSpec) -> None:
    """Draw the table and the floor around their collision geoms, and light the room."""
    _add_table(spec)
    _add_walls(spec)
    _add_lights(spec)


def _add_table(spec: mujoco.MjSpec) -> None:
    table, floor_z = spec.geom("table"), spec.geom("floor").pos[2]
    low, high = table.pos - table.size, table.pos + table.size
    world, t = spec.worldbody, EDGE_TRIM_M
    for shade, tops in zip(("oak", "light oak", "dark oak"), _staves(low + t, high - t, high[2])):
        add_visual(spec, world, f"/table {shade}", shade, *tops)
    trims = [
        box((low[0], low[1], low[2]), (low[0] + t, high[1], high[2])),
        box((high[0] - t, low[1], low[2]), (high[0], high[1], high[2])),
        box((low[0] + t, low[1], low[2]), (high[0] - t, low[1] + t, high[2])),
        box((low[0] + t, high[1] - t, low[2]), (high[0] - t, high[1], high[2])),
    ]
    w = LEG_HALF_WIDTH_M
    legs = [
        box((x - w, y - w, floor_z), (x + w, y + w, low[2]), caps="none")
        for x in (low[0] + 2 * w, high[0] - 2 * w)
        for y in (low[1] + 2 * w, high[1] - 2 * w)
    ]
    add_visual(spec, world, "/table edge", "table edge", *trims, *legs)


def _staves(low: np.ndarray, high: np.ndarray, z: float) -> tuple[list[Surface], ...]:
    """Tops of the staves between two corners, dealt to three shades."""
    rng = np.random.default_rng(7)
    shades: tuple[list[Surface], ...] = ([], [], [])
    edges = np.linspace(low[0], high[0], round((high[0] - low[0]) / STAVE_WIDTH_M) + 1)
    for x0, x1 in itertools.pairwise(edges):
        y0, shade = low[1], int(rng.integers(3))
        while y0 < high[1] - 1e-6:
            length = rng.uniform(*STAVE_LENGTHS_M)
            y1 = y0 + length if y0 + 1.5 * length < high[1] else high[1]
            corners = np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)])
            shades[shade].append((corners, np.array([(0, 1, 2), (0, 2, 3)])))
            y0, shade = y1, (shade + int(rng.integers(1, 3))) % 3
    return shades


def _add_walls(spec: mujoco.MjSpec) -> None:
    """A pale room, floor included, seen from inside; its faces are culled from outside."""
    h, z = ROOM_HALF_SIZE_M, spec.geom("floor").pos[2]
    bottom = np.column_stack([rectangle(h, h), np.full(4, z)])
    top = bottom + np.array([0, 0, ROOM_HEIGHT_M])
    vertices, faces = loft(np.stack([bottom, top]), caps="first")
    add_visual(spec, spec.worldbody, "/room", "wall", (vertices, faces[:, ::-1]))


def _add_lights(spec: mujoco.MjSpec) -> None:
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.34] * 3, [0.22] * 3, [0.10] * 3
    # A key light from the left, in front of the robot, and a weaker fill from the right without shadows.
    for name, direction, strength, shadows in (
        ("key", (-0.30, -0.30, -1.0), 0.47, True),
        ("fill", (0.35, 0.75, -0.7), 0.16, False),
    ):
        spec.worldbody.add_light(
            name=name, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=direction,
            pos=spec.stat.center - np.array(direction), diffuse=[strength] * 3, specular=[0.6 * strength] * 3,
            ambient=[0.0] * 3, castshadow=shadows,
        )  # fmt: skip
