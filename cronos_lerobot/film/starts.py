"""Where everything lies at a start: a picture with names, and sheets of paper at true size.

On paper the arm stands at the top, as in the front camera's picture: x, forward, points down, and y to the right.
Lengths on paper are in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
from lerobot_env_cronos import Benchmark, CronosVectorEnv, Scene
from lerobot_env_cronos.benchmark.configurations import check_split
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.scene.scenes import BODIES
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from cronos_lerobot.film.sheets import caption_font

BATCH = 16
LABELLED = (960, 720)
"""Width and height of a picture with names [px]."""
A4, MARGIN = (210.0, 297.0), 12.0
"""Paper, and what is cut off on each side."""
MM_PER_INCH = 25.4
ROOM, AXIS = 15.0, 20.0
"""Around the outlines, for names and arrows; length of the axes that are drawn."""
FOOT_HEIGHT_M = 0.02
"""The outline of the arm's base is that of its lowest part."""
HOW_TO = (
    "Print at 100 %. The ruler on each sheet must be 100 mm long.",
    "Cut at the marks. Tape the sheets together as the plan shows.",
    "Put the arm's base on its outline. Its pan axis is where x and y meet, and x points ahead of it.",
    "Put every object on its outline. The picture shows which end the arrow points to.",
)


@dataclass(frozen=True)
class Outline:
    """What lies at one place, on paper."""

    name: str
    polygons: list[np.ndarray]
    """Each (n, 2): the outline of one part."""
    centre: np.ndarray
    heading: np.ndarray | None
    """From the centre to the end that the arrow points to, along the longer side; None if there is no such end."""


def render_poses(
    benchmark: Benchmark, poses: np.ndarray, size: tuple[int, int], cameras: tuple[str, ...] = ("front",)
) -> list[list[np.ndarray]]:
    """Frames (height, width, 3) uint8 of poses (n, bodies, 7) with the arm at home, one for each camera.

    `size` is (width, height) [px].
    """
    width, height = size
    env = CronosVectorEnv(
        min(BATCH, len(poses)),
        benchmark.scene.name,
        observation_height=height,
        observation_width=width,
        camera_name=",".join(cameras),
        num_threads=1,
    )
    frames: list[list[np.ndarray]] = []
    try:
        for start in range(0, len(poses), env.num_envs):
            some = poses[start : start + env.num_envs]
            ids = np.arange(len(some))
            env.place_bodies(ids, some)
            pixels = env.observe(ids)["pixels"]
            frames += [[pixels[camera][i] for camera in cameras] for i in ids]
    finally:
        env.close()
    return frames


def find_outlines(scene: Scene, poses: np.ndarray) -> list[Outline]:
    """The outline of the arm's base and of every body, seen from above.

    Args:
        scene: whose bodies they are.
        poses: (bodies, 7) of a configuration.
    """
    model = build_model(scene)
    data = mujoco.MjData(model)
    for body, pose in zip(scene.bodies, poses, strict=True):
        data.joint(body).qpos = pose
    mujoco.mj_kinematics(model, data)
    # What is drawn of that which is fixed to the world, and not of the world itself.
    fixed = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_bodyid != 0)
    foot = np.concatenate(
        [_points(model, data, geom) for geom in np.flatnonzero(fixed & (model.geom_contype == 0))]
    )
    outlines = [Outline("base of the arm", [_hull(foot[foot[:, 2] < FOOT_HEIGHT_M])], np.zeros(2), None)]
    for name in scene.bodies:
        body = model.body(name).id
        geoms = np.flatnonzero((model.geom_bodyid == body) & (model.geom_contype != 0))
        is_round = len(geoms) == 1 and model.geom_type[geoms[0]] == mujoco.mjtGeom.mjGEOM_CYLINDER
        longer = int(np.argmax(BODIES[name].size[:2]))
        axis = data.xmat[body].reshape(3, 3)[:, longer] * BODIES[name].size[longer] / 2
        polygons = [_hull(_points(model, data, geom)) for geom in geoms]
        outlines.append(Outline(name, polygons, _on_paper(data.xpos[body]), None if is_round else _on_paper(axis)))
    return outlines


def _points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Points (n, 3) of which a geom is the convex hull, in the base frame [m]; a box stands for unusual kinds."""
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        (radius, half), angles = model.geom_size[geom, :2], np.linspace(0, 2 * np.pi, 72, endpoint=False)
        points = np.array([[radius * np.cos(a), radius * np.sin(a), z] for a, z in product(angles, (-half, half))])
    else:
        centre, half = np.split(model.geom_aabb[geom], 2)
        points = centre + half * np.array(list(product((-1, 1), repeat=3)))
    return points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def _on_paper(points: np.ndarray) -> np.ndarray:
    """Points (..., 3) of the base frame [m] as (right, up) (..., 2) [mm]."""
    return 1000 * np.stack([points[..., 1], -points[..., 0]], axis=-1)


def _hull(points: np.ndarray) -> np.ndarray:
    flat = _on_paper(points)
    return flat[ConvexHull(flat).vertices]


def label_picture(scene: Scene, outlines: Sequence[Outline], frame: np.ndarray) -> Image.Image:
    """A frame of the front camera with the names of what lies there, each below its outline."""
    height, width = frame.shape[:2]
    projection = scene.robot.cameras["front"].projection(height, width)
    picture = Image.fromarray(frame)
    draw = ImageDraw.Draw(picture)
    for outline in outlines:
        right, up = np.concatenate(outline.polygons).T / 1000
        u, v, depth = projection @ (-up, right, 0 * up, 1 + 0 * up)
        place = (width * (1 + (u / depth).mean()) / 2, height * (1 + (v / depth).max()) / 2 + 3)
        font = caption_font(20)
        draw.text(place, outline.name, "black", font, "mt", stroke_width=3, stroke_fill="white")
    return picture


def write_sheets(path: Path, title: str, outlines: Sequence[Outline], picture: Image.Image) -> list[Figure]:
    """Write a PDF of A4 pages: what to do with them, and then sheets that show `outlines` at true size.

    Returns:
        The pages.
    """
    corners = np.concatenate([polygon for outline in outlines for polygon in outline.polygons])
    low, high = corners.min(axis=0) - ROOM, corners.max(axis=0) + ROOM
    # The fewest sheets, upright or across.
    sheets = {
        paper: np.ceil((high - low) / (np.array(paper) - 2 * MARGIN)).astype(int) for paper in (A4, A4[::-1])
    }
    paper = min(sheets, key=lambda paper: sheets[paper].prod())
    (columns, rows), size = sheets[paper], np.array(paper) - 2 * MARGIN
    first = (low + high - (columns, rows) * size) / 2
    tiles = {
        f"{chr(ord('A') + row)}{column + 1}": first + (column, rows - 1 - row) * size
        for row, column in product(range(rows), range(columns))
    }
    pages = [_draw_overview(title, outlines, picture, tiles, size)]
    pages += [_draw_sheet(f"{title}, sheet {name}", outlines, corner, paper) for name, corner in tiles.items()]
    with PdfPages(path) as pdf:
        for page in pages:
            pdf.savefig(page)
    return pages


def _add_axes(page: Figure, corner: np.ndarray, size: np.ndarray, low: np.ndarray, high: np.ndarray) -> Axes:
    """Axes from `low` to `high` without a frame, at `corner` of a page and of a `size` [mm]."""
    sides = page.get_size_inches() * MM_PER_INCH
    axes = page.add_axes((*(corner / sides), *(size / sides)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_axis_off()
    return axes


def _draw_plan(axes: Axes, outlines: Sequence[Outline], font: float) -> None:
    for outline in outlines:
        for polygon in outline.polygons:
            axes.fill(*polygon.T, facecolor="0.92", edgecolor="black", linewidth=0.8)
        if outline.heading is not None:
            _draw_arrow(axes, outline.centre, outline.centre + outline.heading)
        bottom = min(polygon[:, 1].min() for polygon in outline.polygons)
        axes.text(outline.centre[0], bottom - 2, outline.name, fontsize=font, ha="center", va="top", clip_on=True)
    for x, y, name in ((AXIS, 0, "y"), (0, -AXIS, "x")):
        _draw_arrow(axes, np.zeros(2), np.array([x, y]))
        axes.text(1.15 * x, 1.15 * y, name, fontsize=font, ha="center", va="center", clip_on=True)


def _draw_arrow(axes: Axes, start: np.ndarray, tip: np.ndarray) -> None:
    ends = [(float(x), float(y)) for x, y in (start, tip)]
    axes.add_patch(FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=8, shrinkA=0, shrinkB=0, color="black"))


def _draw_sheet(title: str, outlines: Sequence[Outline], corner: np.ndarray, paper: tuple[float, float]) -> Figure:
    sides = np.array(paper)
    page = Figure(figsize=tuple(sides / MM_PER_INCH))
    size, margin = sides - 2 * MARGIN, np.array([MARGIN, MARGIN])
    _draw_plan(_add_axes(page, margin, size, corner, corner + size), outlines, 9)
    marks = _add_axes(page, np.zeros(2), sides, np.zeros(2), sides)
    marks.text(MARGIN + 2, sides[1] - MARGIN - 2, title, fontsize=8, color="0.5", va="top")
    lines: list[tuple[list[float], list[float]]] = [([MARGIN, MARGIN + 100], [5, 5])]
    lines += [([MARGIN + mm] * 2, [5, 8 if mm % 50 else 10]) for mm in range(0, 101, 10)]
    for x, y in product((MARGIN, sides[0] - MARGIN), (MARGIN, sides[1] - MARGIN)):
        out_x, out_y = np.sign([x, y] - sides / 2)
        lines += [([x + 3 * out_x, x + 7 * out_x], [y, y]), ([x, x], [y + 3 * out_y, y + 7 * out_y])]
    for line in lines:
        marks.plot(*line, color="black", linewidth=0.5)
    marks.text(MARGIN + 103, 5, "100 mm", fontsize=8)
    return page


def _draw_overview(
    title: str,
    outlines: Sequence[Outline],
    picture: Image.Image,
    tiles: dict[str, np.ndarray],
    size: np.ndarray,
) -> Figure:
    page = Figure(figsize=tuple(np.array(A4) / MM_PER_INCH))
    text = _add_axes(page, np.zeros(2), np.array(A4), np.zeros(2), np.array(A4))
    text.text(MARGIN, 283, title, fontsize=14)
    for i, line in enumerate(HOW_TO):
        text.text(MARGIN, 275 - 5 * i, f"{i + 1}. {line}", fontsize=9)
    width, height = picture.size
    shown = _add_axes(
        page, np.array([MARGIN, 137]), np.array([152, 114]), np.array([0, height]), np.array([width, 0])
    )
    shown.imshow(picture)
    low = np.min(list(tiles.values()), axis=0)
    high = np.max(list(tiles.values()), axis=0) + size
    scale = min(*(np.array([A4[0] - 2 * MARGIN, 115]) / (high - low)))
    plan = _add_axes(page, np.array([MARGIN, MARGIN]), scale * (high - low), low, high)
    _draw_plan(plan, outlines, 7)
    for name, (x, y) in tiles.items():
        plan.add_patch(Rectangle((x, y), *size, fill=False, edgecolor="0.6"))
        plan.text(x + 3 / scale, y + size[1] - 3 / scale, name, fontsize=11, color="0.5", va="top")
    return page


def write_starts(benchmark: Benchmark, split: str, starts: Sequence[int] | None, folder: Path) -> None:
    """Write a picture, `<split>_<start>.png`, and sheets, `<split>_<start>.pdf`, of some configurations.

    Args:
        benchmark: whose configurations they are.
        split: train or held_out.
        starts: their numbers; None for all of the split.
        folder: to write to.

    Raises:
        ValueError: there is no such split or configuration.
    """
    check_split(split)
    numbers = range(benchmark.num_starts[split])
    if unknown := set(starts or ()) - set(numbers):
        raise ValueError(f"no start {min(unknown)}; valid: 0 to {numbers[-1]}")
    starts = starts or numbers
    scene, poses = benchmark.scene, benchmark.configurations[split][list(starts)]
    folder.mkdir(parents=True, exist_ok=True)
    for start, pose, (frame,) in zip(starts, poses, render_poses(benchmark, poses, LABELLED), strict=True):
        outlines, name = find_outlines(scene, pose), f"{split}_{start:02}"
        # The arm's base needs no name in a picture.
        picture = label_picture(scene, outlines[1:], frame)
        picture.save(folder / f"{name}.png")
        title = f"{scene.name}, {split.replace('_', '-')} start {start}"
        write_sheets(folder / f"{name}.pdf", title, outlines, picture)
