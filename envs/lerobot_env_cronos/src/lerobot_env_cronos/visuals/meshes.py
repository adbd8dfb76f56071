"""Low-poly meshes generated in code: everything is a loft through a stack of rings.

A surface is a pair of vertices (n, 3) [m] and outward triangles (m, 3). Merging parts of one colour into one
mesh keeps the number of draw calls, and with it the cost of a frame, low.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

Surface = tuple[np.ndarray, np.ndarray]

VISUAL_GROUP = 2
CREASE_ANGLE_COS = np.cos(np.deg2rad(50))
"""Faces that meet at less than 50 degrees are shaded smoothly."""

_AXES = {"x": (1, 2, 0), "y": (0, 2, 1), "z": (0, 1, 2)}
"""Extrusion axis -> columns of the outline's first and second coordinate and of the height."""


def loft(rings: np.ndarray) -> Surface:
    """Closed surface through `rings` (r, k, 3), capped by fans; every ring is star-shaped about its mean."""
    rings = np.asarray(rings, dtype=float)
    r, k, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]])
    a = np.arange(r * k).reshape(r, k)
    b = np.roll(a, -1, axis=1)
    sides = [np.stack(t, -1).reshape(-1, 3) for t in ((a[:-1], b[:-1], b[1:]), (a[:-1], b[1:], a[1:]))]
    first, last = np.full(k, r * k), np.full(k, r * k + 1)
    caps = [np.stack([first, b[0], a[0]], -1), np.stack([last, a[-1], b[-1]], -1)]
    faces = np.concatenate(sides + caps)
    corners = vertices[faces]
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum()
    return vertices, faces if volume > 0 else faces[:, ::-1]


def merge(*surfaces: Surface) -> Surface:
    """One surface made of several."""
    offsets = np.cumsum([0] + [len(v) for v, _ in surfaces[:-1]])
    return (
        np.concatenate([v for v, _ in surfaces]),
        np.concatenate([f + o for (_, f), o in zip(surfaces, offsets)]),
    )


def prism(outline, low: float, high: float, axis: str = "z", bevel: float = 0.0, pos=(0, 0, 0)) -> Surface:
    """Extrude a convex `outline` (k, 2) from `low` to `high` along `axis`, its end edges bevelled [m].

    The outline's coordinates are the other two axes in alphabetical order.
    """
    outline = np.asarray(outline, dtype=float)
    levels = [(low, bevel), (low + bevel, 0.0), (high - bevel, 0.0), (high, bevel)] if bevel else None
    centre = outline.mean(0)
    reach = np.abs(outline - centre).max(0)
    rings = []
    for height, inset in levels or [(low, 0.0), (high, 0.0)]:
        ring = np.empty((len(outline), 3))
        ring[:, _AXES[axis][:2]] = centre + (outline - centre) * (1 - inset / reach)
        ring[:, _AXES[axis][2]] = height
        rings.append(ring)
    return loft(np.array(rings) + np.asarray(pos))


def box(low, high, bevel: float = 0.0) -> Surface:
    """Box between two corners, the edges of its z faces bevelled [m]."""
    outline = rectangle((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, bevel)
    return prism(outline, low[2], high[2], bevel=bevel, pos=((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0))


def cylinder(radius: float, low: float, high: float, axis: str = "z", pos=(0, 0, 0), sides=14, bevel=0.0) -> Surface:
    """Cylinder about `axis` through `pos` [m]."""
    return prism(circle(radius, sides), low, high, axis, bevel, pos)


def circle(radius: float, sides: int = 14) -> np.ndarray:
    """Outline (sides, 2) of a regular polygon that touches +-radius on both axes if 4 divides `sides`."""
    angles = 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angles), np.sin(angles)], -1)


def rectangle(hx: float, hy: float, chamfer: float = 0.0) -> np.ndarray:
    """Outline of a rectangle of half sizes `hx`, `hy`, its corners cut off by `chamfer`."""
    if not chamfer:
        return np.array([(hx, -hy), (hx, hy), (-hx, hy), (-hx, -hy)])
    x, y = hx - chamfer, hy - chamfer
    return np.array([(x, -hy), (hx, -y), (hx, y), (x, hy), (-x, hy), (-hx, y), (-hx, -y), (-x, -hy)])


def superellipse(hx: float, hy: float, exponent: float = 4.0, sides: int = 16) -> np.ndarray:
    """Outline of a rounded rectangle |x/hx|^n + |y/hy|^n = 1."""
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    c, s = np.cos(angles), np.sin(angles)
    radius = (np.abs(c) ** exponent + np.abs(s) ** exponent) ** (-1 / exponent)
    return np.stack([hx * radius * c, hy * radius * s], -1)


def stadium(start, end, radius_start: float, radius_end: float, sides: int = 16) -> np.ndarray:
    """Convex outline around two discs: the side view of a lever between two pivots."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    direction = np.arctan2(*(end - start)[::-1])
    half = np.linspace(-np.pi / 2, np.pi / 2, sides // 2)
    far, near = direction + half, direction + np.pi + half
    return np.concatenate(
        [
            end + radius_end * np.stack([np.cos(far), np.sin(far)], -1),
            start + radius_start * np.stack([np.cos(near), np.sin(near)], -1),
        ]
    )


def stack(outline: np.ndarray, profile: Sequence[tuple[float, float]], axis: str = "z", pos=(0, 0, 0)) -> Surface:
    """Loft of one outline scaled along a profile of (height [m], scale)."""
    rings = np.zeros((len(profile), len(outline), 3))
    for ring, (height, scale) in zip(rings, profile):
        ring[:, _AXES[axis][:2]] = scale * outline
        ring[:, _AXES[axis][2]] = height
    return loft(rings + np.asarray(pos))


def add_visual(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, material: str, *parts: Surface, texture_size: float = 0.0
) -> None:
    """Add the merged `parts` to `body` as one visual geom.

    With a `texture_size` [m] the mesh is textured as seen from above, one repeat per `texture_size`.
    """
    vertices, faces = merge(*parts)
    corners = vertices[faces].reshape(-1, 3)
    mesh = spec.add_mesh(name=f"{name} visual", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = corners.ravel()
    mesh.userface = np.arange(len(corners))
    mesh.usernormal = _corner_normals(vertices, faces).ravel()
    if texture_size:
        mesh.usertexcoord = (corners[:, :2] / texture_size + 0.5).ravel()
    body.add_geom(
        name=f"{name} visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, material=material,
        contype=0, conaffinity=0, density=0, mass=0, group=VISUAL_GROUP,
    )  # fmt: skip


def _corner_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (3 m, 3) of the triangles' corners, smooth across edges below the crease angle."""
    corners = vertices[faces]
    area_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(area_normals, axis=1, keepdims=True)
    unit = area_normals / np.maximum(lengths, 1e-12)
    _, position = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    shares = position[faces].ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    smooth = (shares[:, None] == shares[None]) & (unit[owner] @ unit[owner].T > CREASE_ANGLE_COS)
    normals = smooth @ area_normals[owner]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
