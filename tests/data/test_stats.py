"""Statistics of episodes against LeRobot's, of whole datasets against numpy on all frames."""

import numpy as np
import pyarrow as pa
import pytest
from lerobot.datasets.compute_stats import get_feature_stats, sample_indices
from synthetic_segments import images

from cronos_lerobot.data.stats import DatasetStats, image_stats, vector_stats

RNG = np.random.default_rng(0)
NAMES = ["body.x", "body.z", "body.r11", "shoulder.pos"]
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": NAMES},
    "action": {"dtype": "float32", "shape": (2,), "names": ["dx", "dy"]},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "index": {"dtype": "int64", "shape": (1,), "names": None},
}


@pytest.mark.parametrize(
    "array",
    [
        RNG.normal(size=(80, 7)).astype(np.float32),
        RNG.normal(size=80).astype(np.float32),
        RNG.random(80) < 0.3,
        np.arange(200),
        np.full((5, 2), 3.0, dtype=np.float32),
        np.ones((1, 2), dtype=np.float32),
    ],
    ids=["vector", "scalar", "bool", "int", "constant", "one frame"],
)
def test_vector_stats_are_lerobots(array):
    ours = vector_stats(array)
    theirs = get_feature_stats(array, axis=0, keepdims=array.ndim == 1)
    bin_width = float(np.ptp(array.astype(float))) / 5000
    assert set(ours) == set(theirs)
    for name, value in theirs.items():
        assert ours[name].shape == value.shape, name
        np.testing.assert_allclose(ours[name], value, atol=bin_width + 1e-5, err_msg=name)


@pytest.mark.parametrize("length", [1, 30, 150])
def test_image_stats_are_lerobots_on_the_same_sampled_frames(length):
    frames = images(length)
    sampled = frames[sample_indices(length)].transpose(0, 3, 1, 2)
    theirs = get_feature_stats(sampled, axis=(0, 2, 3), keepdims=True)
    ours = image_stats(frames)
    assert ours["count"] == theirs["count"] == min(length, 100)
    for name in set(theirs) - {"count"}:
        assert ours[name].shape == (3, 1, 1)
        np.testing.assert_allclose(ours[name], theirs[name][0] / 255, atol=2e-3, err_msg=name)


def test_large_images_are_thinned_out_as_lerobot_does():
    frames = RNG.integers(0, 255, (3, 480, 640, 3), dtype=np.uint8)
    frames[:, 1::2] = 0  # rows that LeRobot's stride of 4 never looks at
    assert image_stats(frames)["mean"].min() > 0.4


def rows(length: int, seed: int) -> dict[str, np.ndarray]:
    """Episodes that differ: each has its own centre and width, so that quantiles of episodes tell nothing."""
    rng = np.random.default_rng(seed)
    center, width = rng.normal(size=4), rng.exponential(size=4)
    return {
        "observation.state": (center + width * rng.normal(size=(length, 4))).astype(np.float32),
        "action": rng.exponential(size=(length, 2)).astype(np.float32) * rng.exponential(),
        "next.success": rng.random(length) < rng.random(),
        "index": np.arange(length) + 1000 * seed,
    }


def table(columns: dict[str, np.ndarray]) -> pa.Table:
    return pa.table({key: pa.array(list(value)) for key, value in columns.items()})


@pytest.mark.parametrize(("episodes", "tolerance"), [(40, 0), (400, 3 / DatasetStats.BLOCK)])
def test_quantiles_are_those_of_all_frames(episodes, tolerance):
    """Exact up to 8192 frames; of 40,000, off by less than 3 / 8192 of the frames."""
    parts = [rows(int(RNG.integers(1, 200)), seed) for seed in range(episodes)]
    stats = DatasetStats(FEATURES)
    for part in parts:
        stats.add_rows(table(part))
    found = stats.stats()
    for key in FEATURES:
        every = np.concatenate([part[key].reshape(len(part[key]), -1) for part in parts]).astype(float)
        assert found[key]["count"] == len(every)
        for name, share in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
            low, high = (np.quantile(every, np.clip(share + d, 0, 1), 0, method="inverted_cdf")
                         for d in (-tolerance, tolerance))  # fmt: skip
            assert (found[key][name] >= low - 1e-6 * abs(low)).all(), (key, name)
            assert (found[key][name] <= high + 1e-6 * abs(high)).all(), (key, name)
        for name in ("mean", "min", "max"):
            np.testing.assert_allclose(found[key][name], getattr(every, name)(0), rtol=1e-9, atol=1e-9)
    spread = np.concatenate([part["action"] for part in parts]).astype(float).std(0)
    np.testing.assert_allclose(found["action"]["std"], spread, rtol=1e-9)


def test_standard_deviations_have_a_floor_where_policies_read_them():
    still = {
        "observation.state": np.tile(np.float32([0.1, 0.02, 1, 30]), (20, 1)),
        "action": np.zeros((20, 2), np.float32),
        "next.success": np.zeros(20, bool),
        "index": np.zeros(20, int),
    }
    still["observation.state"][::2, 0] += 0.5
    stats = DatasetStats(FEATURES)
    stats.add_rows(table(still))
    found = stats.stats()
    # Half a metre to and fro stays as it is; what stands still has a millimetre, or a thousandth.
    np.testing.assert_allclose(found["observation.state"]["std"], [0.25, 0.001, 0.001, 0.001])
    np.testing.assert_allclose(found["action"]["std"], [0.001, 0.001])
    assert found["next.success"]["std"] == 0
