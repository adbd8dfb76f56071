"""What another version of the environments made is refused."""

import gymnasium as gym
import pytest
from lerobot_env_cronos import SCENES, check_environment_id, gymnasium_id


@pytest.mark.parametrize("text", ["lerobot_env_cronos/kitchen_2x2-v0", "kitchen_2x2", "PushT-v1", None, ""])
def test_what_is_of_another_version_is_refused(text):
    with pytest.raises(ValueError, match=r"^dataset me/streams .*record it anew"):
        check_environment_id(text, "dataset me/streams", "record it anew")


@pytest.mark.parametrize("scene", SCENES)
def test_this_version_is_accepted(scene):
    assert gymnasium_id(scene) == f"lerobot_env_cronos/{scene}-v1"
    assert check_environment_id(gymnasium_id(scene), "run outputs/train") == scene
    assert gymnasium_id(scene) in gym.registry
