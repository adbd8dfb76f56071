"""Where to grasp an object: candidate grasps of its boxes, scored in the state the scene is in.

A grasp is a point between the finger pads and a closing axis; the hand points straight down.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_env_cronos.expert.body_boxes import SceneBoxes, WorldBoxes
from lerobot_env_cronos.expert.hands import Hand

FINGER_ROOM, PALM_ROOM = 0.006, 0.004
"""Wanted distance from other things [m]."""
SLOTS = np.array([-0.75, -0.4, 0.0, 0.4, 0.75])
BLOCKED_DEPTH = 0.002
"""A hand that would be this deep in another object cannot grasp; that object has to be moved first [m]."""


@dataclass(frozen=True)
class GraspCandidates:
    """The grasps of one object in its own frame; c of them."""

    point: np.ndarray
    """(c, 3) [m]."""
    axis: np.ndarray
    """(c, 3) closing axis, signed (the left finger's side)."""
    box: np.ndarray
    """(c,) index of the grasped box in the scene's boxes."""
    rotation: np.ndarray
    """(c, 3, 3) of that box in the object's frame."""


def grasp_candidates(hand: Hand, boxes: SceneBoxes, body: int) -> GraspCandidates:
    """All grasps across a side of a box that fits between the fingers, at slots along another side."""
    points, axes, indices = [], [], []
    for m in np.flatnonzero(boxes.body == body):
        for closing in range(3):
            if 2 * boxes.half[m, closing] > hand.max_width:
                continue
            for along in (k for k in range(3) if k != closing):
                long_side = boxes.half[m, along] > hand.pad_half[2]
                for slot in SLOTS if long_side else (0.0,):
                    offset = slot * boxes.half[m, along] * boxes.rotation[m][:, along]
                    for sign in (1.0, -1.0):
                        points.append(boxes.centre[m] + offset)
                        axes.append(sign * boxes.rotation[m][:, closing])
                        indices.append(m)
    index = np.array(indices)
    return GraspCandidates(np.array(points), np.array(axes), index, boxes.rotation[index])


@dataclass(frozen=True)
class Grasps:
    """The chosen grasps of n streams."""

    point: np.ndarray
    """(n, 3) in the object's frame [m]."""
    axis: np.ndarray
    """(n, 3) closing axis in the object's frame."""
    floor: np.ndarray
    """(n,) height that the fingertips stay above [m]."""
    width: np.ndarray
    """(n,) of the grasped side [m]."""
    blocker: np.ndarray
    """(n,) index of the object that is in the way of the hand, -1 for none."""


def finger_points(
    hand: Hand, centre: np.ndarray, closing: np.ndarray, offsets: tuple[np.ndarray | float, ...]
) -> np.ndarray:
    """Points (..., p, 3) on the pads of a hand that points down.

    Args:
        hand: whose pads.
        centre: (..., 3) middle of the pads [m].
        closing: (..., 3) horizontal unit vector.
        offsets: signed distances (...) of the pads from the middle to look at [m].
    """
    across = np.stack([-closing[..., 1], closing[..., 0], np.zeros_like(closing[..., 0])], -1)
    length, _, width = hand.pad_half
    points = [
        centre + np.asarray(offset)[..., None] * closing + lateral * width * across + [0, 0, level * length]
        for offset in offsets
        for lateral in (-1, 0, 1)
        for level in (-1, 0, 1)
    ]
    return np.stack(points, -2)


def palm_points(hand: Hand, centre: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """Points (..., 5, 3) of the palm's underside, for a hand that points down."""
    across = np.stack([-closing[..., 1], closing[..., 0], np.zeros_like(closing[..., 0])], -1)
    along, aside = hand.palm_half
    up = [0, 0, hand.palm_height]
    corners = [(0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)]
    return np.stack([centre + up + a * along * closing + b * aside * across for a, b in corners], -2)


def choose_grasps(
    hand: Hand,
    candidates: GraspCandidates,
    obj: int,
    world: WorldBoxes,
    pose: tuple[np.ndarray, np.ndarray],
    arm: np.ndarray,
    avoid: np.ndarray,
    is_support: np.ndarray,
) -> Grasps:
    """Pick the cheapest grasp of an object in each of n streams.

    Args:
        hand: that grasps.
        candidates: of the object; `obj` is its index.
        world: all boxes.
        pose: of the object, position (n, 3) and rotation (n, 3, 3).
        arm: (n, j) joint positions [rad].
        avoid: (n, a, 3) grasp points that failed, in the object's frame; inf where there was none [m].
        is_support: (bodies,) True for receptacles, which the fingers may come close to from above.
    """
    p, R = pose
    point = p[:, None] + np.einsum("nij,cj->nci", R, candidates.point)
    axis = np.einsum("nij,cj->nci", R, candidates.axis)
    closing = axis * [1, 1, 0]
    closing /= np.maximum(np.linalg.norm(closing, axis=-1, keepdims=True), 1e-6)
    width = _width(world, candidates, R, closing)
    cost = 2.0 * np.abs(axis[..., 2]) + 50.0 * (np.abs(axis[..., 2]) > 0.7) + 10.0 * (width > hand.max_width)
    floor = _floor(hand, world, point, closing, is_support, width)
    centre = point.copy()
    centre[..., 2] = np.maximum(point[..., 2], floor + hand.tip_clearance + hand.pad_half[0])
    # Pads that pass over the grasp point by more than their half length do not hold it.
    cost += 200 * np.maximum(centre[..., 2] - point[..., 2] - 0.010, 0.0)
    cost += _collision_cost(hand, world, candidates, centre, closing, obj, is_support, width)
    yaw = np.arctan2(closing[..., 1], closing[..., 0])
    cost += hand.wrist_cost(arm[:, None], point, yaw) + hand.reach_cost(point)
    failed = np.linalg.norm(candidates.point[None, :, None] - avoid[:, None], axis=-1) < 0.012
    cost += 1.5 * failed.sum(-1)
    com = p + np.einsum("nij,j->ni", R, world.boxes.centre_of_mass[obj])
    cost += 8.0 * np.linalg.norm((point - com[:, None])[..., :2], axis=-1)
    best, n = cost.argmin(1), np.arange(len(p))
    width = width[n, best]
    blocker = find_blocker(hand, world, centre[n, best], closing[n, best], obj, is_support, width)
    return Grasps(candidates.point[best], candidates.axis[best], floor[n, best], width, blocker)


def _width(world: WorldBoxes, candidates: GraspCandidates, R: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """Extent (n, c) of the grasped box along the closing axis, over the pads' length along the box."""
    local = np.einsum("cji,nkj,nck->nci", candidates.rotation, R, closing)
    half = np.minimum(world.boxes.half[candidates.box], 0.026)
    return 2 * (np.abs(local) * half).sum(-1)


def _floor(
    hand: Hand,
    world: WorldBoxes,
    point: np.ndarray,
    closing: np.ndarray,
    is_support: np.ndarray,
    width: np.ndarray,
) -> np.ndarray:
    """Height (n, c) of the receptacle under the fingers, 0 on the table."""
    across = np.stack([-closing[..., 1], closing[..., 0], 0 * closing[..., 0]], -1) * hand.pad_half[2]
    near, far = (np.asarray(offset)[..., None] * closing for offset in hand.pad_offsets(width)[:2])
    thickness = hand.pad_half[1] * closing
    ends = (near - thickness, 0.0, far + thickness)
    feet = np.stack([point + end + b * across for end in ends for b in (-1, 1)], -2)
    n, c = point.shape[:2]
    floor = np.zeros((n, c))
    for m in np.flatnonzero(is_support[world.boxes.body]):
        offset = feet.reshape(n, -1, 3) - world.centre[:, None, m]
        normal = world.rotation[:, m, :, 2]
        up = np.where(np.abs(normal[:, 2]) < 0.3, 0.3, np.abs(normal[:, 2]))
        slope = normal[:, :2] / (up * np.sign(normal[:, 2]))[:, None]
        surface = world.centre[:, m, 2, None] + (world.boxes.half[m, 2] / up)[:, None]
        surface = surface - np.einsum("ni,npi->np", slope, offset[..., :2])
        local = np.einsum("nij,npi->npj", world.rotation[:, m], offset)
        over = np.abs(local[..., :2]) - world.boxes.half[m, :2]
        height = np.where(over.max(-1) < 0.004, np.minimum(surface, world.top()[:, m, None]), 0.0)
        floor = np.maximum(floor, height.reshape(n, c, -1).max(-1))
    return floor


def _collision_cost(
    hand: Hand,
    world: WorldBoxes,
    candidates: GraspCandidates,
    centre: np.ndarray,
    closing: np.ndarray,
    obj: int,
    is_support: np.ndarray,
    width: np.ndarray,
) -> np.ndarray:
    n, c = centre.shape[:2]
    support = is_support[world.boxes.body]
    fingers = finger_points(hand, centre, closing, hand.pad_offsets(width))
    gap = world.distance(fingers.reshape(n, -1, 3)).reshape(n, c, fingers.shape[2], -1).min(2)
    # The grasped box itself is between the fingers, and receptacles are handled by the floor.
    ignored = support | (np.arange(len(support)) == candidates.box[:, None])
    gap = np.where(ignored, np.inf, gap) - hand.pad_half[1]
    into_itself = (np.where(world.boxes.body == obj, gap, np.inf) < -BLOCKED_DEPTH).any(-1)
    gap = gap.min(-1)
    palm = palm_points(hand, centre, closing)
    palm_gap = world.distance(palm.reshape(n, -1, 3)).reshape(n, c, palm.shape[2], -1).min(2)
    palm_gap = np.where(support, np.inf, palm_gap).min(-1)
    # Something that lies on top of the object between the fingers comes up with it.
    above = centre[:, :, None] + np.array([[0, 0, 0.02], [0, 0, 0.035]])
    above_gap = world.distance(above.reshape(n, -1, 3)).reshape(n, c, 2, -1).min(2)
    above_gap = np.where(support | (world.boxes.body == obj), np.inf, above_gap).min(-1)
    cost = 120 * np.maximum(FINGER_ROOM - gap, 0.0) + 120 * np.maximum(PALM_ROOM - palm_gap, 0.0)
    return cost + 60 * np.maximum(0.008 - above_gap, 0.0) + 5.0 * into_itself


def find_blocker(
    hand: Hand,
    world: WorldBoxes,
    centre: np.ndarray,
    closing: np.ndarray,
    obj: int,
    is_support: np.ndarray,
    width: np.ndarray,
    margin: float = -BLOCKED_DEPTH,
) -> np.ndarray:
    """Index (n,) of the object that a hand around object `obj`, or what it would lift, runs into; -1 for none.

    Args:
        hand: that grasps.
        world: all boxes.
        centre: (n, 3) middle of the pads [m].
        closing: (n, 3) horizontal unit vector.
        obj: index of the object to grasp.
        is_support: (bodies,) True for receptacles, which block nothing.
        width: (n,) of the side to grasp [m].
        margin: distance below which another object is in the way [m].
    """
    fingers = finger_points(hand, centre, closing, hand.pad_offsets(width))
    palm = palm_points(hand, centre, closing)
    above = centre[:, None] + np.array([[0, 0, 0.02], [0, 0, 0.035]])
    room = np.repeat([hand.pad_half[1], 0.0, 0.0], [fingers.shape[1], palm.shape[1], 2])
    gap = (world.distance(np.concatenate([fingers, palm, above], 1)) - room[:, None]).min(1)
    body = world.boxes.body
    gap = np.where(is_support[body] | (body == obj), np.inf, gap)
    return np.where(gap.min(1) < margin, body[gap.argmin(1)], -1)
