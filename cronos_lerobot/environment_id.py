"""Ids of environments, as Gymnasium has them: `lerobot_env_cronos/kitchen_2x2-v1`."""

from __future__ import annotations

import re

PATTERN = re.compile(r"(?P<namespace>[\w.-]{1,80})/(?P<name>[\w.-]{1,80})-v(?P<version>\d{1,9})")


def is_of_a_scene(environment: str) -> bool:
    """Whether an id is of a CRONOS scene."""
    return environment.startswith("lerobot_env_cronos/")


def check_environment_id(text: str | None, what: str, remedy: str = "make it anew") -> str:
    """The name in an environment id that was recorded: `kitchen_2x2`.

    Args:
        text: the id, or None where nothing was recorded.
        what: has the id, as the message's subject: "dataset me/streams", "run outputs/train".
        remedy: what to do instead, such as "record it anew".

    Raises:
        ValueError: it is no environment id, or one of CRONOS scenes of another version.
    """
    match = PATTERN.fullmatch(text or "")
    if match is None or is_of_a_scene(match[0]):
        # The versions that are known are those of the scenes that come with this project.
        from lerobot_env_cronos import check_environment_id as check_scene

        return check_scene(text, what, remedy)
    return match["name"]
