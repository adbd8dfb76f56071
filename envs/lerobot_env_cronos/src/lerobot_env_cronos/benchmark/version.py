"""The version of the environments, their Gymnasium ids, and the check of what another version made.

Physics, grasp and success test, rewards, configurations and orderings together are one version: a change of any
of them changes every result. It ends the Gymnasium ids. Datasets, runs, results and benchmarks record the id.
"""

import re

import gymnasium as gym

from lerobot_env_cronos.scene.scenes import SCENES

VERSION = 1
"""Of all environments."""

ENVIRONMENT_PATTERN = re.compile(r"lerobot_env_cronos/(?P<scene>[a-z0-9_]+)-v(?P<version>\d{1,9})")


def gymnasium_id(scene: str) -> str:
    """Gymnasium id of a scene, with the version."""
    return f"lerobot_env_cronos/{scene}-v{VERSION}"


def register_gymnasium(*scenes: str) -> None:
    """Register scenes with Gymnasium, by default all of `SCENES`."""
    for scene in scenes or SCENES:
        gym.register(
            gymnasium_id(scene),
            "lerobot_env_cronos.episodic:CronosEnv",
            vector_entry_point="lerobot_env_cronos.autoreset:CronosGymVectorEnv",
            max_episode_steps=SCENES[scene].steps_per_task,
            kwargs={"scene": scene},
        )


def check_environment_id(text: str | None, what: str, remedy: str = "make it anew") -> str:
    """The scene of an environment id that was recorded, such as `lerobot_env_cronos/kitchen_2x2-v1`.

    Args:
        text: the id, or None where nothing was recorded.
        what: has the id, as the message's subject: "dataset me/streams", "run outputs/train".
        remedy: what to do instead, such as "record it anew".

    Raises:
        ValueError: it is of another version, or no environment id.
    """
    match = ENVIRONMENT_PATTERN.fullmatch(text or "")
    if match is None or int(match["version"]) != VERSION:
        made = f"was made with {text[:100]}" if text else "does not say which version of the environment made it"
        raise ValueError(f"{what} {made}; this is version {VERSION}: {remedy}")
    return match["scene"]
