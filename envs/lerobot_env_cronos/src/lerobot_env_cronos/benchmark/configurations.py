"""Benchmark configurations: frozen poses of every body, 64 for training and 64 held out per scene.

They were drawn once by `python -m lerobot_env_cronos.benchmark.freeze configurations SCENE` from a fixed seed and
are data of this package (`data/<scene>.json`); a change of them is a new version of the environment id. Scenes
from outside the package come with a file of their own, or theirs are drawn from the same seed when they are first
used.
"""

import json
from collections.abc import Callable
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np

from lerobot_env_cronos.benchmark.poses import find_bad_row, find_shared_row, make_overlap_finder
from lerobot_env_cronos.scene.scenes import BODIES, SCENES, Scene, get_scene

SPLITS = ("train", "held_out")
NUM_CONFIGURATIONS = 64
POSES_VERSION = 0
"""Of the frozen poses. Version 1 of the environments has those of version 0, under other physics."""

CLEARANCE_M = 0.015
"""Smallest gap between the footprints of two bodies [m]."""
OBJECT_YAWS = np.array([0.0, 0.25, 0.5, 0.75]) * np.pi
RECEPTACLE_YAWS = np.array([0.0, 0.5]) * np.pi
MAX_ATTEMPTS, MAX_RESTARTS = 10_000, 20
MAX_RESTARTS_EACH = 6
"""Restarts for each configuration, on average over all so far: bodies that fit less often than that do not fit. To
draw them all would take many minutes, most of them in vain."""
SEED = 2026
"""Of the packaged configurations, and of those of scenes without a file."""


def check_split(split: str) -> None:
    """Raise a ValueError that names the valid splits, unless this is one."""
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; valid splits: {list(SPLITS)}")


_files: dict[str, Path] = {}
"""Files of scenes that are not part of the package."""


def load_configurations(scene_name: str, split: str) -> np.ndarray:
    """Poses (64, bodies, 7) of a split: position [m], quaternion (w, x, y, z), bodies in the scene's order."""
    check_split(split)
    return _load_splits(get_scene(scene_name), _files.get(scene_name))[split]


def set_configurations_file(scene: Scene, path: Path) -> None:
    """Read the configurations of `scene`, whose bodies are registered, from `path` from now on.

    Raises:
        ValueError: the scene has other configurations already; the file is of other bodies, a split has not 64
            configurations, or one of these cannot be used.
    """
    if scene.name in SCENES and _files.get(scene.name) != path:
        raise ValueError(f"{scene.name} has its configurations, not those of {path}: --env.benchmark takes others")
    _load_splits(scene, path)
    _files[scene.name] = path


def _packaged_file(scene: Scene) -> Traversable:
    return resources.files("lerobot_env_cronos").joinpath(f"data/{scene.name}.json")


@cache
def _load_splits(scene: Scene, path: Path | None) -> dict[str, np.ndarray]:
    packaged = _packaged_file(scene)
    if path is not None or packaged.is_file():
        content = json.loads((path or packaged).read_text())
        _check_content(scene, content, path or packaged)
    else:
        content = _generate(scene, SEED)
    splits = {split: np.array(content["splits"][split], dtype=float) for split in SPLITS}
    if path is not None:
        _check_poses(scene, splits, path)
    for poses in splits.values():
        poses.flags.writeable = False
    return splits


def _check_content(scene: Scene, content: dict, source: object) -> None:
    version, bodies, splits = (content.get(key) for key in ("version", "bodies", "splits"))
    if tuple(bodies or ()) != scene.bodies or version != POSES_VERSION:
        found = f"v{version} of bodies {bodies}"
        raise ValueError(
            f"{source} is {found}; {scene.name} needs v{POSES_VERSION} of bodies {list(scene.bodies)}"
        )
    shape = (NUM_CONFIGURATIONS, len(scene.bodies), 7)
    for split in SPLITS:
        if np.shape((splits or {}).get(split, ())) != shape:
            raise ValueError(f"split {split} of {source} must be of shape {shape}")


def _check_poses(scene: Scene, splits: dict[str, np.ndarray], source: Path) -> None:
    """What is checked of benchmarks in folders and on the Hub, of a file."""
    for split in SPLITS:
        if bad := find_bad_row(scene, splits[split]):
            raise ValueError(f"split {split} of {source}, row {bad[0]}: {bad[1]}")
    if shared := find_shared_row(splits["held_out"], splits["train"]):
        raise ValueError(f"split held_out of {source}, row {shared[0]}: {shared[1]}")


def footprint_corners(name: str, xy: np.ndarray, yaw: float) -> np.ndarray:
    """Corners (4, 2) of a body's bounding box on the table [m]."""
    half = np.array(BODIES[name].size[:2]) / 2
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half
    c, s = np.cos(yaw), np.sin(yaw)
    return corners @ np.array([[c, s], [-s, c]]) + xy


def footprint_gap(a: np.ndarray, b: np.ndarray) -> float:
    """Separation of two rectangles along their best separating axis [m]; negative if they overlap."""
    gaps = []
    for corners in (a, b):
        edges = np.roll(corners, -1, axis=0)[:2] - corners[:2]
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        pa, pb = normals @ a.T, normals @ b.T
        gaps.append(np.maximum(pa.min(1) - pb.max(1), pb.min(1) - pa.max(1)).max())
    return max(gaps)


Place = tuple[np.ndarray, float]
"""Where a body lies: its centre (2,) on the table [m] and its yaw [rad]."""
DrawPlace = Callable[[str, np.random.Generator], Place]
"""Draws a place for a body, free or not."""


def draw_spawn_place(scene: Scene, body: str, rng: np.random.Generator) -> Place:
    """Uniform over what the arm serves of the scene's spawn area, at one of the yaws that configurations have."""
    (x_low, y_low), (x_high, y_high) = scene.spawn_low, scene.spawn_high
    yaws = OBJECT_YAWS if body in scene.objects else RECEPTACLE_YAWS
    # The numbers that `rng.uniform` of arrays and `rng.choice` would draw, in a quarter of their time.
    xy = np.array([rng.uniform(x_low, x_high), rng.uniform(y_low, y_high)])
    while not scene.robot.serves(xy):
        xy = np.array([rng.uniform(x_low, x_high), rng.uniform(y_low, y_high)])
    return xy, yaws[rng.integers(len(yaws))]


def sample_place(
    scene: Scene,
    body: str,
    others: list[np.ndarray],
    rng: np.random.Generator,
    draw: DrawPlace | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a free place for `body`.

    Args:
        others: footprints (4, 2) that it must keep `CLEARANCE_M` away from.
        draw: draws places, free or not; from the spawn area if None.

    Returns:
        The pose (7,) on the table, and its footprint (4, 2).

    Raises:
        RuntimeError: no free place was found.
    """
    centres = np.array([other.mean(axis=0) for other in others]).reshape(-1, 2)
    # As far as the circles within them reach: where those are too near, so are the footprints.
    inner = np.array([np.linalg.norm(other[:2] - other[1:3], axis=1).min() / 2 for other in others])
    nearest = inner + min(BODIES[body].size[:2]) / 2 + CLEARANCE_M - 1e-9
    for _ in range(MAX_ATTEMPTS):
        xy, yaw = draw(body, rng) if draw else draw_spawn_place(scene, body, rng)
        if (((centres - xy) ** 2).sum(axis=1) < nearest**2).any():
            continue
        corners = footprint_corners(body, xy, yaw)
        if all(footprint_gap(corners, other) > CLEARANCE_M for other in others):
            pose = [*xy, BODIES[body].size[2] / 2, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
            return np.array(pose), corners
    raise RuntimeError(f"no free place for the {body} among {len(others)} bodies")


def sample_configuration(scene: Scene, rng: np.random.Generator, draw: DrawPlace | None = None) -> np.ndarray:
    """Draw poses (bodies, 7) of all bodies at rest on the table, no two touching.

    Args:
        draw: see `sample_place`.

    Raises:
        ValueError: the bodies do not fit into the spawn area, or into where `draw` puts them, clear of the arm at
            home.
    """
    find_overlap, overlap = make_overlap_finder(scene), None
    for _ in range(MAX_RESTARTS):
        poses = _try_configuration(scene, rng, draw)
        if poses is not None and (overlap := find_overlap(poses)) is None:
            return poses
    raise _no_fit(scene, overlap, draw)


def sample_configurations(scene: Scene, number: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses (number, bodies, 7) as `sample_configuration` does, rounded as they are in files.

    Raises:
        ValueError: the bodies do not fit into the spawn area, clear of the arm at home, or hardly ever.
    """
    find_overlap, overlap = make_overlap_finder(scene), None
    drawn, restarts = [], 0
    while len(drawn) < number:
        if (poses := _try_configuration(scene, rng)) is not None:
            poses = poses.round(6)
            if (overlap := find_overlap(poses)) is None:
                drawn.append(poses)
                continue
        restarts += 1
        if restarts >= max(MAX_RESTARTS, MAX_RESTARTS_EACH * (len(drawn) + 1)):
            raise _no_fit(scene, overlap)
    return np.stack(drawn)


def redraw_shared(scene: Scene, held_out: np.ndarray, train: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The held-out configurations (n, bodies, 7), others instead of those that are training configurations.

    Raises:
        ValueError: there are hardly any others.
    """
    held_out = held_out.copy()
    for _ in range(MAX_RESTARTS_EACH * len(held_out)):
        if (shared := find_shared_row(held_out, train)) is None:
            return held_out
        held_out[shared[0]] = sample_configurations(scene, 1, rng)[0]
    raise ValueError(
        f"{scene.name}: hardly any configuration is none of the {len(train)} training ones: widen the spawn area"
    )


def _try_configuration(scene: Scene, rng: np.random.Generator, draw: DrawPlace | None = None) -> np.ndarray | None:
    """Poses (bodies, 7), or None if the bodies that were placed first leave no room for another one."""
    poses, footprints = {}, []
    try:
        # Receptacles are large: placed first, they leave room for the objects.
        for body in scene.receptacles + scene.objects:
            poses[body], corners = sample_place(scene, body, footprints, rng, draw)
            footprints.append(corners)
    except RuntimeError:
        return None
    return np.stack([poses[body] for body in scene.bodies])


def _no_fit(scene: Scene, overlap: str | None, draw: DrawPlace | None = None) -> ValueError:
    area = "the places that are drawn" if draw else f"the spawn area {scene.spawn_low} to {scene.spawn_high}"
    return ValueError(
        f"{scene.name}: {len(scene.bodies)} bodies do not fit into {area} with {CLEARANCE_M} m between them"
        f"{f' and clear of the arm at home ({overlap})' if overlap else ''}"
    )


def _generate(scene: Scene, seed: int) -> dict:
    rng = np.random.default_rng(seed)
    drawn = sample_configurations(scene, len(SPLITS) * NUM_CONFIGURATIONS, rng)
    train, held_out = np.split(drawn, len(SPLITS))
    splits = {"train": train.tolist(), "held_out": redraw_shared(scene, held_out, train, rng).tolist()}
    return {"scene": scene.name, "version": POSES_VERSION, "seed": seed, "bodies": scene.bodies, "splits": splits}


def write_configurations(scene_name: str, folder: Path, seed: int = SEED) -> Path:
    """Draw the configurations of a scene and write them to `folder/<scene>.json`; returns the path."""
    scene = get_scene(scene_name)
    path = folder / f"{scene.name}.json"
    path.write_text(json.dumps(_generate(scene, seed)) + "\n")
    return path
