"""The version of the environments, and the refusal of what another version made.

Physics, grasp and success test, rewards, configurations and orderings together are one version: a change of any
of them changes every result. It is the end of the Gymnasium ids, and datasets, runs, results and benchmarks say
which one made them.
"""

import re

VERSION = 1
"""Of all environments."""

ENVIRONMENT_PATTERN = re.compile(r"(lerobot_env_cronos/)?(?P<scene>[a-z0-9_]+?)(-v(?P<version>\d+))?")
EARLIER = {0: "0.1"}
"""The release of the packages that has an earlier version of the environments."""


def gymnasium_id(scene: str) -> str:
    """Gymnasium id of a scene, with the version."""
    return f"lerobot_env_cronos/{scene}-v{VERSION}"


def check_environment_id(text: str | None, what: str, remedy: str = "make it anew") -> str:
    """Refuse what was not made with this version of the environments.

    Args:
        text: the environment id that was recorded, such as `lerobot_env_cronos/kitchen_2x2-v1`, or None where
            nothing was: version 0 did not record it everywhere.
        what: that it is of, as the sentence's subject: "dataset me/streams", "run outputs/train".
        remedy: what to do instead, such as "record it anew".

    Returns:
        The scene's name.

    Raises:
        ValueError: it is of another version or none, or no environment id.
    """
    match = ENVIRONMENT_PATTERN.fullmatch(text or "")
    if text and match is None:
        raise ValueError(f"{what} was made with {text!r}; expected an id such as {gymnasium_id('kitchen_2x2')}")
    version = None if match is None or match["version"] is None else int(match["version"])
    if match is not None and version == VERSION:
        return match["scene"]
    if version is not None and version > VERSION:
        raise ValueError(f"{what} was made with {text}; this is version {VERSION}: install newer packages")
    release, old = EARLIER.get(version or 0), version or 0
    made = "does not say which version of the environment made it" if version is None else f"was made with {text}"
    raise ValueError(
        f"{what} {made}; this is version {VERSION}, whose physics and success test differ: {remedy}, or use it "
        f"with cronos-lerobot {release}, which has version {old}"
    )
