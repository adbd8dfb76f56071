"""Bodies as oriented boxes in numpy: where they are, and how far a point is from them, for many streams at once.

Shapes: n streams, m boxes of all bodies of a scene, leading dimensions of points are free.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from lerobot_env_cronos.scene.rotations import quaternion_to_matrix
from lerobot_env_cronos.scene.scenes import Scene


@dataclass(frozen=True)
class SceneBoxes:
    """The colliding geoms of a scene's free bodies as boxes in the frames of their bodies."""

    body: np.ndarray
    """(m,) index of the box's body in `scene.bodies`."""
    centre: np.ndarray
    """(m, 3) in the body's frame [m]."""
    rotation: np.ndarray
    """(m, 3, 3) box to body."""
    half: np.ndarray
    """(m, 3) half extents [m]."""
    centre_of_mass: np.ndarray
    """(bodies, 3) in the body's frame [m]."""

    @classmethod
    def from_model(cls, model: mujoco.MjModel, scene: Scene) -> "SceneBoxes":
        """Read the boxes (a cylinder or mesh counts as its bounding box) from a compiled model."""
        body_ids = [model.body(name).id for name in scene.bodies]
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in body_ids and model.geom_contype[g] > 0]
        rotation = quaternion_to_matrix(model.geom_quat[geoms])
        bounding_boxes = model.geom_aabb[geoms]
        return cls(
            body=np.array([body_ids.index(model.geom_bodyid[g]) for g in geoms]),
            centre=model.geom_pos[geoms] + np.einsum("mij,mj->mi", rotation, bounding_boxes[:, :3]),
            rotation=rotation,
            half=bounding_boxes[:, 3:].copy(),
            centre_of_mass=model.body_ipos[body_ids].copy(),
        )

    def corners(self, body: int) -> np.ndarray:
        """The corners (8 k, 3) of one body's k boxes in its own frame."""
        return self.surface(body, np.inf)

    def surface(self, body: int, spacing: float) -> np.ndarray:
        """Points (p, 3) on one body's boxes in its own frame, edges included, at most `spacing` apart [m]."""
        points = []
        for m in np.flatnonzero(self.body == body):
            counts = np.ceil(2 * self.half[m] / spacing).astype(int) + 1
            axes = [np.linspace(-1, 1, max(count, 2)) for count in counts]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
            grid = grid[(np.abs(grid) == 1).any(1)]
            points.append((grid * self.half[m]) @ self.rotation[m].T + self.centre[m])
        return np.concatenate(points)


@dataclass(frozen=True)
class WorldBoxes:
    """The boxes of n streams in the world frame: `centre` (n, m, 3), `rotation` (n, m, 3, 3)."""

    boxes: SceneBoxes
    centre: np.ndarray
    rotation: np.ndarray

    @classmethod
    def at(cls, boxes: SceneBoxes, poses: np.ndarray) -> "WorldBoxes":
        """Place `boxes` at body poses (n, bodies, 7)."""
        R = quaternion_to_matrix(poses[:, boxes.body, 3:])
        centre = poses[:, boxes.body, :3] + np.einsum("nmij,mj->nmi", R, boxes.centre)
        return cls(boxes, centre, R @ boxes.rotation)

    def distance(self, points: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Signed distance (n, p, k) of points (n, p, 3) from the boxes `which` (k,), negative inside [m]."""
        which = np.arange(len(self.boxes.body)) if which is None else which
        if not len(which):
            return np.full((*points.shape[:2], 1), np.inf)
        rotation, centre = self.rotation[:, which], self.centre[:, which]
        local = points[:, None] @ rotation - centre[:, :, None] @ rotation
        q = np.abs(local) - self.boxes.half[which, None]
        x, y, z = np.moveaxis(q, -1, 0)
        inside = np.minimum(np.maximum(np.maximum(x, y), z), 0.0)
        np.maximum(q, 0.0, out=q)
        return (np.sqrt(x * x + y * y + z * z) + inside).transpose(0, 2, 1)

    def near(self, xy: np.ndarray, radius: float) -> np.ndarray:
        """Boxes (m,) that come within `radius` of the points xy (n, 2) in the plane in any of the streams."""
        gap = np.linalg.norm(self.centre[..., :2] - xy[:, None], axis=-1)
        return (gap - np.linalg.norm(self.boxes.half, axis=-1) < radius).any(0)

    def top(self) -> np.ndarray:
        """Height (n, m) of the highest corner of every box [m]."""
        return self.centre[..., 2] + (np.abs(self.rotation[..., 2, :]) * self.boxes.half).sum(-1)
