import numpy as np
import pytest
from lerobot.datasets.compute_stats import get_feature_stats, sample_indices
from synthetic_segments import images

from cronos_lerobot.data.stats import episode_stats, image_stats, vector_stats

RNG = np.random.default_rng(0)


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


def test_strings_have_no_stats():
    features = {"a": {"dtype": "string", "shape": (1,)}, "b": {"dtype": "float32", "shape": (1,)}}
    assert set(episode_stats({"a": np.array(["x"]), "b": np.array([1.0])}, features)) == {"b"}
