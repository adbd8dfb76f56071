"""What another version of the environments made is refused, in one sentence that says what to do."""

import gymnasium as gym
import pytest
from lerobot_env_cronos import VERSION, check_environment_id, gymnasium_id
from lerobot_env_cronos.scene.scenes import SCENES

DIFFER = (
    "; this is version 1, whose physics and success test differ: record it anew, or use it with cronos-lerobot"
    " 0.1, which has version 0"
)
UNSAID = "does not say which version of the environment made it" + DIFFER
NEWER = "was made with kitchen_2x2-v2; this is version 1: install newer packages"
FOREIGN = "was made with 'PushT-v1'; expected an id such as lerobot_env_cronos/kitchen_2x2-v1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lerobot_env_cronos/kitchen_2x2-v0", "was made with lerobot_env_cronos/kitchen_2x2-v0" + DIFFER),
        ("lerobot_env_cronos/kitchen_2x2", UNSAID),
        ("kitchen_2x2", UNSAID),
        (None, UNSAID),
        ("", UNSAID),
        ("kitchen_2x2-v2", NEWER),
        ("PushT-v1", FOREIGN),
    ],
)
def test_what_is_of_another_version_is_refused(text, message):
    with pytest.raises(ValueError, match=r"^dataset me/streams ") as raised:
        check_environment_id(text, "dataset me/streams", "record it anew")
    assert str(raised.value) == f"dataset me/streams {message}"


@pytest.mark.parametrize("scene", SCENES)
def test_this_version_is_accepted(scene):
    assert VERSION == 1
    assert gymnasium_id(scene) == f"lerobot_env_cronos/{scene}-v1"
    assert check_environment_id(gymnasium_id(scene), "run outputs/train") == scene
    assert check_environment_id(f"{scene}-v1", "run outputs/train") == scene
    assert gymnasium_id(scene) in gym.registry


@pytest.mark.filterwarnings("ignore:.*is out of date")
def test_gymnasium_knows_no_version_0():
    with pytest.raises(gym.error.DeprecatedEnv, match="Please use `lerobot_env_cronos/kitchen_2x2-v1` instead"):
        gym.make("lerobot_env_cronos/kitchen_2x2-v0")
