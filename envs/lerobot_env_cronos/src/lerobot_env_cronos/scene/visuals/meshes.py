"""Low-poly meshes generated in code: everything is a loft through a stack of rings.

A surface is a pair of vertices (n, 3) [m] and outward triangles (m, 3). Merging parts of one colour into one
mesh keeps the number of draw calls, and with it the cost of a frame, low.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from lerobot_env_cronos.scene.visuals.materials import use_material

Surface = tuple[np.ndarray, np.ndarray]

VISUAL_GROUP = 2
CREASE_ANGLE_COS = np.cos(np.deg2rad(50))
"""Faces that meet at less than 50 degrees are shaded smoothly."""

_AXES = {"x": (1, 2, 0), "y": (0, 2, 1), "z": (0, 1, 2)}
"""Extrusion axis -> columns of the outline's first and second coordinate and of the height."""


def loft(rings: np.ndarray, caps: str = "both") -> Surface:
    """Surface through `rings` (r, k, 3) of convex outlines, closed by `caps`: both, first, last or none.

    Ends that nobody sees are left open: a frame's cost grows with the triangles.
    """
    rings = np.asarray(rings, dtype=float)
    r, k, _ = rings.shape
    vertices = rings.reshape(-1, 3)
    a = np.arange(r * k).reshape(r, k)
    b = np.roll(a, -1, axis=1)
    sides = [np.stack(t, -1).reshape(-1, 3) for t in ((a[:-1], b[:-1], b[1:]), (a[:-1], b[1:], a[1:]))]
    i = np.arange(1, k - 1)
    first = np.stack([a[0, 0] + 0 * i, a[0, i + 1], a[0, i]], -1)
    last = np.stack([a[-1, 0] + 0 * i, a[-1, i], a[-1, i + 1]], -1)
    closed = vertices[np.concatenate([*sides, first, last])]
    volume = (closed[:, 0] * np.cross(closed[:, 1], closed[:, 2])).sum()
    ends = [end for end, name in ((first, "first"), (last, "last")) if caps in ("both", name)]
    faces = np.concatenate(sides + ends)
    # Collapsed rings (a profile that ends in a point) leave triangles without area.
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[area > 1e-12]
    return vertices, faces if volume > 0 else faces[:, ::-1]


def merge(*surfaces: Surface) -> Surface:
    """One surface made of several."""
    offsets = np.cumsum([0] + [len(v) for v, _ in surfaces[:-1]])
    return (
        np.concatenate([v for v, _ in surfaces]),
        np.concatenate([f + o for (_, f), o in zip(surfaces, offsets)]),
    )


def prism(outline, low: float, high: float, axis: str = "z", caps: str = "both", pos=(0, 0, 0)) -> Surface:
    """Extrude a convex `outline` (k, 2) from `low` to `high` along `axis` [m].

    The outline's coordinates are the other two axes in alphabetical order.
    """
    return stack(np.asarray(outline, dtype=float), [(low, 1.0), (high, 1.0)], axis, caps, pos)


def box(low, high, chamfer: float = 0.0, caps: str = "both") -> Surface:
    """Box between two corners, its vertical edges cut off by `chamfer` [m]."""
    outline = rectangle((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, chamfer)
    return prism(outline, low[2], high[2], "z", caps, ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0))


def cylinder(
    radius: float, low: float, high: float, axis: str = "z", pos=(0, 0, 0), sides: int = 10, caps: str = "both"
) -> Surface:
    """Cylinder about `axis` through `pos` [m]."""
    return prism(circle(radius, sides), low, high, axis, caps, pos)


def circle(radius: float, sides: int = 12) -> np.ndarray:
    """Outline (sides, 2) of a regular polygon that touches +-radius on both axes if 4 divides `sides`."""
    angles = 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angles), np.sin(angles)], -1)


def rectangle(hx: float, hy: float, chamfer: float = 0.0) -> np.ndarray:
    """Outline of a rectangle of half sizes `hx`, `hy`, its corners cut off by `chamfer`."""
    if not chamfer:
        return np.array([(hx, -hy), (hx, hy), (-hx, hy), (-hx, -hy)])
    x, y = hx - chamfer, hy - chamfer
    return np.array([(x, -hy), (hx, -y), (hx, y), (x, hy), (-x, hy), (-hx, y), (-hx, -y), (-x, -hy)])


def rounded_rectangle(hx: float, hy: float, radius: float, corner_points: int = 3) -> np.ndarray:
    """Outline of a rectangle of half sizes `hx`, `hy` with corners of a `radius`."""
    angles = np.concatenate([np.linspace(0, np.pi / 2, corner_points) + q * np.pi / 2 for q in range(4)])
    sign = np.repeat([(1, 1), (-1, 1), (-1, -1), (1, -1)], corner_points, axis=0)
    centres = sign * (np.array([hx, hy]) - radius)
    return centres + radius * np.stack([np.cos(angles), np.sin(angles)], -1)


def superellipse(hx: float, hy: float, exponent: float = 4.0, sides: int = 12) -> np.ndarray:
    """Outline of a rounded rectangle |x/hx|^n + |y/hy|^n = 1."""
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    c, s = np.cos(angles), np.sin(angles)
    radius = (np.abs(c) ** exponent + np.abs(s) ** exponent) ** (-1 / exponent)
    return np.stack([hx * radius * c, hy * radius * s], -1)


def stadium(start, end, radius_start: float, radius_end: float, sides: int = 8) -> np.ndarray:
    """Convex outline around two discs: the side view of a lever between two pivots."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    direction = np.arctan2(*(end - start)[::-1])
    half = (np.arange(sides // 2) - (sides // 2 - 1) / 2) * np.pi / (sides // 2 - 1)
    far, near = direction + half, direction + np.pi + half
    return np.concatenate(
        [
            end + radius_end * np.stack([np.cos(far), np.sin(far)], -1),
            start + radius_start * np.stack([np.cos(near), np.sin(near)], -1),
        ]
    )


def stack(
    outline: np.ndarray,
    profile: Sequence[tuple[float, float]],
    axis: str = "z",
    caps: str = "both",
    pos=(0, 0, 0),
) -> Surface:
    """Loft of one convex outline scaled along a profile of (height [m], scale)."""
    rings = np.zeros((len(profile), len(outline), 3))
    for ring, (height, scale) in zip(rings, profile):
        ring[:, _AXES[axis][:2]] = scale * outline
        ring[:, _AXES[axis][2]] = height
    return loft(rings + np.asarray(pos), caps)


def add_visual(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    material: str,
    *parts: Surface,
    texture_size: float | tuple[float, float] = 0.0,
) -> None:
    """Add the merged `parts` to `body` as one visual geom.

    No other one has its `name`: that of a body, or of a part of one behind a slash, which names of bodies lack.

    With a `texture_size` (x and y, or one for both) [m] the mesh is textured as seen from above, one repeat per
    `texture_size`.
    """
    use_material(spec, material)
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
