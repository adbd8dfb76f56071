"""Flags of a command as words, in either of the two ways that they are written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

RESERVED = (
    "--steps",
    "--seed",
    "--output_dir",
    "--num_envs",
    "--save_freq",
    "--protocol.update_interval",
    "--policy.path",
    "--env.scene",
    "--env.obs_type",
    "--eval.split",
    "--eval.temperature",
    "--resume",
    "--config_path",
)
"""Flags of `cronos-train` that the experiment sets; a run with others would not be the one its folder says."""

DROPS_CHECKPOINTS = ("--keep_checkpoints", "--save_checkpoint")
"""Flags that may keep a run from having the checkpoints that are evaluated after it."""


def read_flags(words: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Name and value of `--name=value` and `--name value`.

    Raises:
        ValueError: a word is neither.
    """
    rest = list(words)
    while rest:
        flag, is_joined, value = rest.pop(0).partition("=")
        if not flag.startswith("--"):
            raise ValueError(f"flags begin with --, got {flag!r}")
        if not is_joined:
            if not rest or rest[0].startswith("--"):
                raise ValueError(f"{flag} needs a value")
            value = rest.pop(0)
        yield flag.removeprefix("--"), value


def join_flags(words: Iterable[str]) -> list[str]:
    """The same as `--name=value`, one word a flag, as all plans have them."""
    return [f"--{name}={value}" for name, value in read_flags(words)]
