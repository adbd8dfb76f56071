"""Rotations of many streams at once: vectors, quaternions and matrices."""

import numpy as np


def rotation_vector_to_matrix(w: np.ndarray) -> np.ndarray:
    """Exponential map SO(3), (..., 3) [rad] -> (..., 3, 3)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = _skew(w)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + a * K + b * (K @ K)


def matrix_to_rotation_vector(R: np.ndarray) -> np.ndarray:
    """Logarithm SO(3), (..., 3, 3) -> (..., 3) [rad], for angles below pi."""
    v = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    sin = np.linalg.norm(v, axis=-1)
    cos = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1)
    angle = np.arctan2(sin, cos)
    return v * np.where(sin > 1e-9, angle / np.maximum(sin, 1e-9), 1.0)[..., None]


def quaternion_to_matrix(quat: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) as (w, x, y, z) -> (..., 3, 3)."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=-2,
    )


def _skew(w: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(w, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], axis=-2)
