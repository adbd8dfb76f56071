"""Where to put a held object down: free spots of a receptacle or of the table, scored by clearance.

Objects that are put on the middle of a receptacle get stacked in reset-free streams; a free spot beside it leaves
room for the next one.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_env_cronos.expert.body_boxes import WorldBoxes
from lerobot_env_cronos.expert.grasping import finger_points
from lerobot_env_cronos.expert.hands import Hand
from lerobot_env_cronos.scene.scenes import Scene

REACH = 0.045
"""Largest offset of an object from the middle of its receptacle [m]."""
OFFSETS = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), -1).reshape(-1, 2) * REACH
TURNS = np.deg2rad([0.0, -30.0, 30.0, -60.0, 60.0, 90.0])
ROOM = 0.010
"""Wanted distance from other things [m]."""
BLOCKED_DEPTH = 0.003
"""An overlap with another object from which on a receptacle counts as full [m]."""
PREFERRED_OFFSET = 0.03
"""Distance beside the middle at which an empty receptacle still holds a second object [m]."""
EDGE_ROOM = 0.015
"""Wanted distance of an object's centre from the receptacle's edge: what overhangs further may tip [m]."""
SPACING = 0.016
"""Of the points of the held object that are checked: closer than the thinnest side of an object, 18 mm [m]."""


@dataclass(frozen=True)
class Places:
    """Where to put the held objects of n streams."""

    xy: np.ndarray
    """(n, 2) of the object's centre, relative to `anchor` [m]."""
    anchor: np.ndarray
    """(n, 2) the receptacle's centre, or 0 for the table [m]."""
    closing: np.ndarray
    """(n, 2) the hand's closing axis when it lets go."""
    blocker: np.ndarray
    """(n,) index of the object that even this spot overlaps with, -1 for none."""


@dataclass(frozen=True)
class Held:
    """The hands and the objects in them, n streams."""

    position: np.ndarray
    """(n, 3) of the object [m]."""
    rotation: np.ndarray
    """(n, 3, 3) of the object."""
    hand: np.ndarray
    """(n, 3) middle of the pads [m]."""
    hand_yaw: np.ndarray
    """(n,) yaw of the closing axis [rad]."""
    arm: np.ndarray
    """(n, j) joint positions [rad]."""
    width: np.ndarray
    """(n,) of the side that is held [m]."""


def choose_places(
    kind: Hand, scene: Scene, obj: int, receptacle: int, world: WorldBoxes, receptacle_xy: np.ndarray, held: Held
) -> Places:
    """Pick the best spot for object `obj` in each of n streams.

    Args:
        kind: of hand.
        scene: whose bodies are indexed.
        obj: index of the held object.
        receptacle: index of the receptacle, -1 for the table.
        world: all boxes.
        receptacle_xy: (n, 2) centre of the receptacle [m]; ignored for the table.
        held: the hands and objects.
    """
    n = len(held.position)
    on_table = receptacle < 0
    anchor = np.zeros((n, 2)) if on_table else receptacle_xy
    offsets = _table_grid(scene) if on_table else OFFSETS
    spots = np.broadcast_to(offsets, (n, *offsets.shape))
    top = np.zeros(n) if on_table else world.top()[:, world.boxes.body == receptacle].max(1)
    turn = np.repeat(TURNS, len(offsets))
    spots = np.tile(spots, (1, len(TURNS), 1))
    goal = anchor[:, None] + spots
    which, gaps = _clearance(kind, world, obj, receptacle, goal, turn, top, held)
    cost = 150 * np.maximum(ROOM - gaps.min(-1), 0.0)
    cost += kind.wrist_cost(held.arm[:, None], goal, held.hand_yaw[:, None] + turn) + kind.reach_cost(goal)
    distance = np.linalg.norm(spots, axis=-1)
    if on_table:
        cost += 2.0 * np.linalg.norm(goal - held.position[:, None, :2], axis=-1)
    else:
        cost += 12 * np.abs(distance - PREFERRED_OFFSET) + 100 * np.maximum(distance - 0.05, 0.0)
        cost += 15 * _along(held, spots, turn, world, obj)
        cost += 100 * np.maximum(EDGE_ROOM - _inset(world, receptacle, goal), 0.0)
    best, i = cost.argmin(1), np.arange(n)
    yaw = held.hand_yaw + turn[best]
    nearest, gap = which[gaps[i, best].argmin(-1)], gaps[i, best].min(-1)
    blocker = np.where((gap < -BLOCKED_DEPTH) & (nearest < len(scene.objects)), nearest, -1)
    return Places(spots[i, best], anchor, np.stack([np.cos(yaw), np.sin(yaw)], 1), blocker)


def _inset(world: WorldBoxes, receptacle: int, goal: np.ndarray) -> np.ndarray:
    """How far inside the receptacle's bounding rectangle the points goal (n, s, 2) are, negative outside [m]."""
    boxes = np.flatnonzero(world.boxes.body == receptacle)
    offset = goal[:, :, None] - world.centre[:, None, boxes, :2]
    local = np.einsum("nbij,nsbi->nsbj", world.rotation[:, boxes, :2], offset)[..., :2]
    return (world.boxes.half[boxes, :2] - np.abs(local)).min(-1).max(-1)


def _table_grid(scene: Scene) -> np.ndarray:
    x = np.linspace(scene.spawn_low[0], scene.spawn_high[0], 7)
    y = np.linspace(scene.spawn_low[1], scene.spawn_high[1], 9)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return grid[scene.robot.serves(grid)]


def _turned(v: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Vectors (n, 1 or s, p, 3) turned about z by angles (s,)."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = v[..., 0], v[..., 1]
    return np.stack([c * x - s * y, s * x + c * y, np.broadcast_to(v[..., 2], (c * x).shape)], -1)


def _clearance(
    kind: Hand,
    world: WorldBoxes,
    obj: int,
    receptacle: int,
    goal: np.ndarray,
    turn: np.ndarray,
    top: np.ndarray,
    held: Held,
) -> tuple[np.ndarray, np.ndarray]:
    """The bodies (k,) of the boxes nearby, and how far the object and the opened fingers at each spot are from
    each of them, (n, s, k) [m]; one box at infinity if there is none."""
    surface = world.boxes.surface(obj, SPACING)
    body = np.einsum("nij,pj->npi", held.rotation, surface)
    lowest = body[..., 2].min(1)
    closing = np.stack([np.cos(held.hand_yaw), np.sin(held.hand_yaw), 0 * held.hand_yaw], 1)
    fingers = finger_points(kind, held.hand - held.position, closing, kind.pad_offsets(held.width)[:2])
    n, s = goal.shape[:2]
    height = (top - lowest + 0.002)[:, None, None]
    gaps = []
    others = (world.boxes.body != obj) & (world.boxes.body != receptacle)
    if receptacle >= 0:
        reach = np.linalg.norm(np.abs(surface).max(0)) + np.sqrt(2) * REACH + ROOM
        others &= world.near(goal.mean(1), reach)
    for points, thickness in ((body, 0.0), (fingers, kind.pad_half[1])):
        moved = _turned(points[:, None], turn)
        moved = np.concatenate([moved[..., :2] + goal[:, :, None], moved[..., 2:] + height[..., None]], -1)
        distance = world.distance(moved.reshape(n, -1, 3), np.flatnonzero(others))
        gaps.append(distance.reshape(n, s, -1, distance.shape[-1]).min(2) - thickness)
    return world.boxes.body[others] if others.any() else np.array([-1]), np.minimum(*gaps)


def _along(held: Held, spots: np.ndarray, turn: np.ndarray, world: WorldBoxes, obj: int) -> np.ndarray:
    """Offset (n, s) from the receptacle's middle along the object's longest side [m]: across it is steadier."""
    extent = np.abs(world.boxes.corners(obj)).max(0)
    axis = held.rotation[:, :2, extent.argmax()]
    angle = np.arctan2(axis[:, 1], axis[:, 0])[:, None] + turn
    return np.abs(spots[..., 0] * np.cos(angle) + spots[..., 1] * np.sin(angle))
