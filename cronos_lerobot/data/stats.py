"""Per-episode statistics as LeRobot computes them, vectorised: from arrays in memory, without PNG files.

`lerobot.datasets.compute_stats` builds a 5000-bin histogram per dimension, image channels included, which
costs more than encoding the video. Sorting (vectors) and exact 256-bin histograms (images) give the same
numbers: minimum, maximum, mean, standard deviation and count to rounding, quantiles to one of its bins.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.datasets.compute_stats import DEFAULT_QUANTILES, auto_downsample_height_width, sample_indices
from PIL import Image

Stats = dict[str, dict[str, np.ndarray]]


def episode_stats(frames: Mapping[str, np.ndarray], features: Mapping[str, Mapping[str, Any]]) -> Stats:
    """Statistics of one episode by feature.

    Args:
        frames: arrays (T, ...) by feature; images are uint8 (T, H, W, 3).
        features: LeRobot's feature dictionary.

    Returns:
        For each feature that is not a string: min, max, mean, std, q01, q10, q50, q90, q99 of its shape
        (images: (3, 1, 1), in [0, 1]) and count (1,), the number of frames looked at.
    """
    stats = {}
    for key, array in frames.items():
        dtype = features[key]["dtype"]
        if dtype in ("image", "video"):
            stats[key] = image_stats(array)
        elif dtype != "string":
            stats[key] = vector_stats(array)
    return stats


def vector_stats(array: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics over the frames of a numeric array (T,) or (T, D): arrays (1,) or (D,)."""
    values = np.sort(array.reshape(len(array), -1).astype(np.float64), axis=0)
    stats = {"min": values[0], "max": values[-1], "mean": values.mean(axis=0), "std": values.std(axis=0)}
    stats["count"] = np.array([len(values)])
    for quantile in DEFAULT_QUANTILES:
        stats[_name(quantile)] = values[_rank(quantile, len(values))]
    return stats


def image_stats(images: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics per channel of uint8 images (T, H, W, 3), on the frames and pixels that LeRobot samples."""
    sampled = sample_indices(len(images))
    # One at a time: copies of a whole episode cost more than everything else here.
    counts = np.sum([_histogram(images[i]) for i in sampled], axis=0)
    return _histogram_stats(counts, num_images=len(sampled))


def _histogram(image: np.ndarray) -> np.ndarray:
    """How often each level occurs in each channel of an image (H, W, 3): (3, 256)."""
    # LeRobot's own rule for thinning out large images, on a channel-first view.
    thinned = auto_downsample_height_width(image.transpose(2, 0, 1)).transpose(1, 2, 0)
    histogram = Image.fromarray(np.ascontiguousarray(thinned)).histogram()
    return np.array(histogram, dtype=np.int64).reshape(3, 256)


def _histogram_stats(counts: np.ndarray, num_images: int) -> dict[str, np.ndarray]:
    levels = np.arange(256) / 255.0
    total = int(counts[0].sum())
    mean = counts @ levels / total
    std = np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0.0))
    cumulative = counts.cumsum(axis=1)
    present = counts > 0
    stats = {
        "min": present.argmax(axis=1) / 255.0,
        "max": (255 - present[:, ::-1].argmax(axis=1)) / 255.0,
        "mean": mean,
        "std": std,
    }
    for quantile in DEFAULT_QUANTILES:
        stats[_name(quantile)] = (cumulative > _rank(quantile, total)).argmax(axis=1) / 255.0
    stats = {name: value.reshape(3, 1, 1) for name, value in stats.items()}
    return stats | {"count": np.array([num_images])}


def _rank(quantile: float, count: int) -> int:
    """Position in the sorted values of the bin where LeRobot's cumulative histogram reaches the quantile."""
    return max(math.ceil(quantile * count) - 1, 0)


def _name(quantile: float) -> str:
    return f"q{int(quantile * 100):02d}"
