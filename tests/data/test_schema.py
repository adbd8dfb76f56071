import gymnasium
import numpy as np
import pytest
from lerobot.configs import FeatureType
from lerobot.utils.feature_utils import dataset_to_policy_features
from synthetic_segments import observation_space

from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.data.schema import EXPERT, STREAM_COLUMNS, demonstration_features, stream_features
from cronos_lerobot.protocol.interventions import Intervention


def test_annotations_are_no_policy_features():
    policy_features = dataset_to_policy_features(stream_features(observation_space()))
    assert {key: feature.type for key, feature in policy_features.items()} == {
        "observation.images.front": FeatureType.VISUAL,
        "observation.state": FeatureType.STATE,
        "observation.environment_state": FeatureType.ENV,
        "action": FeatureType.ACTION,
    }
    assert policy_features["observation.images.front"].shape == (3, 64, 64)


def test_a_stream_has_the_columns_of_a_demonstration_and_the_annotations():
    stream, demonstration = stream_features(observation_space()), demonstration_features(observation_space())
    assert set(stream) - set(demonstration) == {*STREAM_COLUMNS, EXPERT}
    assert all(stream[key] == demonstration[key] for key in demonstration)


def test_only_what_is_observed_is_stored():
    features = demonstration_features(observation_space(environment_state=None))
    assert "observation.environment_state" not in features


def test_codes_of_interventions_are_frozen():
    # Published datasets carry them.
    assert [(kind.name, int(kind)) for kind in Intervention] == [
        ("NONE", 0),
        ("TASK_SWITCH", 1),
        ("END_EFFECTOR_RESET", 2),
        ("HEURISTIC_RESET", 3),
        ("SCENE_RESET", 4),
        ("DIVERGENCE", 5),
        ("INITIAL", 6),
        ("TAKEOVER", 7),
    ]


@pytest.mark.parametrize("shape", [(63, 64, 3), (64, 64), (64, 64, 4)])
def test_pictures_that_cannot_be_encoded_are_refused(shape):
    pixels = gymnasium.spaces.Dict({"front": gymnasium.spaces.Box(0, 255, shape, np.uint8)})
    with pytest.raises(ValueError, match=r"pixels (must have the shape|are 63 and 64: .* even)"):
        demonstration_features(gymnasium.spaces.Dict({"pixels": pixels}))


def test_images_may_have_an_odd_size():
    pixels = gymnasium.spaces.Dict({"front": gymnasium.spaces.Box(0, 255, (63, 64, 3), np.uint8)})
    features = demonstration_features(gymnasium.spaces.Dict({"pixels": pixels}), video=False)
    assert features["observation.images.front"]["shape"] == (63, 64, 3)
    assert features["observation.images.front"]["dtype"] == "image"


def test_wrong_number_of_names_is_refused():
    with pytest.raises(ValueError, match="5 dimensions but 2 names"):
        demonstration_features(observation_space(), state_names=["a", "b"])


def test_unknown_observation_is_refused():
    space = gymnasium.spaces.Dict({"touch": gymnasium.spaces.Box(0, 1, (2,))})
    with pytest.raises(ValueError, match="unknown observation 'touch'"):
        demonstration_features(space)


def test_observation_columns_follow_the_features():
    space = gymnasium.vector.utils.batch_space(observation_space(), 4)
    columns = observation_columns(space.sample())
    features = demonstration_features(observation_space())
    assert set(columns) == {key for key in features if key.startswith("observation.")}
    assert all(column.shape == (4, *features[key]["shape"]) for key, column in columns.items())
