"""Fills in the cards of `datasets_cards/`."""

from __future__ import annotations

import operator
import os
import re
import shlex
from collections.abc import Iterable
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

import jinja2
import yaml
from huggingface_hub import constants

from cronos_lerobot.provenance import git_commit, package_versions

PACKAGED = Path(__file__).parent / "cards"
CHECKOUT = Path(__file__).parents[2] / "datasets_cards"
PATHS = r"""(?<=['"])/[^'"]+|(?<=[\s=:,\[{(])/(?!/)[^\s'",\]})]+"""
"""Absolute paths among other things, as in a list; in quotes they may have spaces. No addresses, `https://...`."""


def render_card(kind: str, **values: Any) -> str:
    """The card `kind`.md with `values`; a value that is missing is an error.

    Raises:
        jinja2.UndefinedError: a value is missing.
    """
    folder = PACKAGED if PACKAGED.is_dir() else CHECKOUT
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters |= {
        "table": table, "code": code, "multiply": operator.mul, "sampling": describe_sampling, "yaml": yaml_scalar,
    }  # fmt: skip
    common = {"hub": constants.ENDPOINT, "versions": package_versions(), "commit": git_commit()}
    return environment.get_template(f"{kind}.md").render(common | values)


def table(rows: Iterable[Iterable[Any]], *header: str) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def yaml_scalar(text: Any) -> str:
    """Text as a value of YAML, in quotes where it would be read as something else."""
    return yaml.safe_dump(str(text), allow_unicode=True, width=float("inf")).removesuffix("...\n").strip()


def is_packaged(scene: str) -> bool:
    """Whether a scene comes with the package of the environments; any other is registered by somebody's module."""
    return resources.files("lerobot_env_cronos").joinpath(f"data/{scene}.json").is_file()


def describe_sampling(temperature: float | None) -> str:
    """How the actions of an evaluation were drawn, in words."""
    if temperature is None:
        return "the policy's own sampling"
    return f"temperature {temperature}" if temperature else "greedy"


def code(text: Any) -> str:
    """Inline code."""
    return f"`{text}`"


def command_line(words: Iterable[str]) -> str:
    """A command, one flag a line, without the folders of whoever ran it."""
    words = list(words)
    parts = [shlex.quote(without_folders(word)) for word in words[1:]]
    return " \\\n    ".join([words[0], *parts]) if words else ""


def without_folders(word: str) -> str:
    """A word of a command with `~` for the home folder, and `.../name` for absolute paths: a card is public."""
    home = os.path.expanduser("~")
    if len(home) > 1:
        word = re.sub(rf"(?<![\w.-]){re.escape(home)}(?![^/\s'\",\]])", "~", word)
    flag, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    if value.startswith("/"):
        return f"{flag}{equals}{_last_part(value)}"
    return re.sub(PATHS, lambda path: _last_part(path[0]), word)


def _last_part(path: str) -> str:
    return f".../{PurePosixPath(path).name}"
