import gymnasium
import numpy as np
import pytest
from lerobot.configs import FeatureType
from lerobot.utils.feature_utils import dataset_to_policy_features
from synthetic_segments import observation_space

from cronos_lerobot.data.schema import demonstration_features, stream_features


def test_annotations_are_no_policy_features():
    policy_features = dataset_to_policy_features(stream_features(observation_space()))
    assert {key: feature.type for key, feature in policy_features.items()} == {
        "observation.images.front": FeatureType.VISUAL,
        "observation.state": FeatureType.STATE,
        "observation.environment_state": FeatureType.ENV,
        "action": FeatureType.ACTION,
    }
    assert policy_features["observation.images.front"].shape == (3, 64, 64)


@pytest.mark.parametrize("shape", [(63, 64, 3), (64, 64), (64, 64, 4)])
def test_pictures_that_cannot_be_encoded_are_refused(shape):
    pixels = gymnasium.spaces.Dict({"front": gymnasium.spaces.Box(0, 255, shape, np.uint8)})
    with pytest.raises(ValueError, match="pixels"):
        demonstration_features(gymnasium.spaces.Dict({"pixels": pixels}))
