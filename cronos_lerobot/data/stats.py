"""Statistics of episodes and of whole datasets, as LeRobot names them, with three differences.

- Speed: `lerobot.datasets.compute_stats` builds a 5000-bin histogram per dimension, image channels included, which
  costs more than encoding the video. Sorting numbers and exact 256-bin histograms of images give the same.
- Quantiles of a dataset are those of all its frames. LeRobot 0.6.1 averages the quantiles of its episodes. Of
  images this remains so: both look at a sample of the frames.
- Standard deviations of a dataset have a floor, `STD_FLOOR`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.compute_stats import (
    DEFAULT_QUANTILES,
    aggregate_stats,
    auto_downsample_height_width,
    sample_indices,
)
from lerobot.utils.constants import ACTION, OBS_STR
from PIL import Image

Stats = dict[str, dict[str, np.ndarray]]

STD_FLOOR = 1e-3
"""Least standard deviation of a dimension of an action or of a vector observation [m, rad, 1].

A body that stands on the table in every demonstration has a height with a deviation of 1e-5 m. Divided by that, it
is hundreds of deviations away as soon as it rests on another body. Below the floor there is only rounding. It is
small because the small deviations of the proprioception tell where the hand touches something, and because
policies scale their exploration by those of the actions."""


def episode_stats(frames: Mapping[str, np.ndarray], features: Mapping[str, Mapping[str, Any]]) -> Stats:
    """Statistics of one episode by feature.

    Args:
        frames: arrays (T, ...) by feature; images are uint8 (T, H, W, 3).
        features: LeRobot's feature dictionary.

    Returns:
        For each feature: min, max, mean, std, q01, q10, q50, q90, q99 of its shape (images: (3, 1, 1), in [0, 1])
        and count (1,), the number of frames looked at.
    """
    return {
        key: image_stats(array) if features[key]["dtype"] in ("image", "video") else vector_stats(array)
        for key, array in frames.items()
    }


def vector_stats(array: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics per dimension of numbers (T, D) or (T,)."""
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


@dataclass(frozen=True)
class _Moments:
    """Of `count` values of D dimensions: mean, sum of squares about it, least and greatest value, (D,) each."""

    count: int
    mean: np.ndarray
    squares: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> _Moments:
        """Of values (D, n)."""
        count = values.shape[1]
        mean = values.sum(axis=1) / max(count, 1)
        squares = ((values - mean[:, None]) ** 2).sum(axis=1)
        return cls(count, mean, squares, values.min(axis=1, initial=np.inf), values.max(axis=1, initial=-np.inf))

    def joined(self, other: _Moments) -> _Moments:
        """Of both (Chan, Golub and LeVeque 1983)."""
        count = max(self.count + other.count, 1)
        difference = other.mean - self.mean
        return _Moments(
            self.count + other.count,
            self.mean + difference * (other.count / count),
            self.squares + other.squares + difference**2 * (self.count * other.count / count),
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )


class DatasetStats:
    """Statistics of a dataset that grows: what its `stats.json` says.

    The quantiles of numbers come from a mergeable summary (Manku, Rajagopalan and Lindsay 1998): blocks of sorted
    values, each of which stands for a power of two of the values. They are exact up to BLOCK frames. Beyond that,
    their rank is off by less than 1 / BLOCK of the frames for every doubling.

    Args:
        features: of the dataset, LeRobot's feature dictionary.
    """

    BLOCK = 8192
    """Frames in a block."""

    def __init__(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        self._features = features
        self._images: Stats = {}
        self._places, size = {}, 0
        for key, feature in features.items():
            if feature["dtype"] not in ("image", "video"):
                self._places[key] = slice(size, size := size + int(np.prod(feature["shape"])))
        self._moments = _Moments.of(np.empty((size, 0)))
        self._buffer = np.empty((size, self.BLOCK))
        self._used = 0
        self._blocks: dict[int, np.ndarray] = {}
        """(D, BLOCK) sorted values by level; each stands for 2**level values."""

    def add_rows(self, rows: pa.Table) -> None:
        """Take the numbers of rows of a data file. What comes of it does not depend on how rows come together."""
        values = np.empty((len(self._buffer), rows.num_rows))
        for key, place in self._places.items():
            values[place] = to_array(rows[key]).reshape(rows.num_rows, -1).T
        while values.shape[1]:
            part = values[:, : self.BLOCK - self._used]
            self._buffer[:, self._used : self._used + part.shape[1]] = part
            self._used += part.shape[1]
            values = values[:, part.shape[1] :]
            if self._used == self.BLOCK:
                self._moments = self._moments.joined(_Moments.of(self._buffer))
                self._add_block(np.sort(self._buffer.astype(np.float32), axis=1))
                self._used = 0

    def add_images(self, episodes: Iterable[Stats]) -> None:
        """Take the statistics of images in episodes; what is not of an image is ignored."""
        images = [{key: stats[key] for key in stats if key not in self._places} for stats in episodes]
        if images := [stats for stats in images if stats]:
            self._images = aggregate_stats([*([self._images] if self._images else []), *images])

    def stats(self) -> Stats:
        """Statistics of everything that was added; empty if that was nothing."""
        rest = self._buffer[:, : self._used]
        moments = self._moments.joined(_Moments.of(rest))
        if not moments.count:
            return {}
        values = np.concatenate([rest.astype(np.float32), *self._blocks.values()], axis=1)
        weights = [np.ones(self._used), *(np.full(self.BLOCK, 2.0**level) for level in self._blocks)]
        std = np.sqrt(moments.squares / moments.count)
        numbers = {"min": moments.low, "max": moments.high, "mean": moments.mean, "std": std}
        numbers |= _weighted_quantiles(values, np.concatenate(weights))
        stats = dict(self._images)
        for key, place in self._places.items():
            stats[key] = {name: value[place].copy() for name, value in numbers.items()}
            stats[key]["count"] = np.array([moments.count])
            if _is_read_by_policies(key, self._features[key]):
                stats[key]["std"] = np.maximum(stats[key]["std"], STD_FLOOR)
        return stats

    def _add_block(self, block: np.ndarray) -> None:
        level = 0
        while (other := self._blocks.pop(level, None)) is not None:
            # Every second value of both: from the first one on, at the next level from the second one on.
            block = np.sort(np.concatenate([block, other], axis=1), axis=1)[:, level % 2 :: 2]
            level += 1
        self._blocks[level] = block


def to_array(column: pa.ChunkedArray) -> np.ndarray:
    """A column of a data file as an array (T, ...)."""
    if pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type):
        values = column.combine_chunks()
        return np.asarray(values.flatten()).reshape(len(values), -1)
    return column.to_numpy()


def _weighted_quantiles(values: np.ndarray, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Quantiles (D,) of values (D, n) of which each stands for `weights` (n,) values."""
    order = np.argsort(values, axis=1)
    cumulative = np.cumsum(weights[order], axis=1)
    found = {}
    for quantile in DEFAULT_QUANTILES:
        column = (cumulative > _rank(quantile, int(weights.sum()))).argmax(axis=1)
        place = order[np.arange(len(values)), column]
        found[_name(quantile)] = values[np.arange(len(values)), place].astype(np.float64)
    return found


def _is_read_by_policies(key: str, feature: Mapping[str, Any]) -> bool:
    """Whether a policy may divide a feature by its standard deviation."""
    return key == ACTION or (key.startswith(OBS_STR) and feature["dtype"] not in ("image", "video"))


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
