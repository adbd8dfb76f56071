"""Fills in the cards of `datasets_cards/`."""

from __future__ import annotations

import operator
import os
import shlex
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from huggingface_hub import constants

from cronos_lerobot.provenance import git_commit, package_versions

PACKAGED = Path(__file__).parent / "cards"
CHECKOUT = Path(__file__).parents[2] / "datasets_cards"


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
    environment.filters |= {"table": table, "code": code, "multiply": operator.mul, "sampling": describe_sampling}
    common = {"hub": constants.ENDPOINT, "versions": package_versions(), "commit": git_commit()}
    return environment.get_template(f"{kind}.md").render(common | values)


def table(rows: Iterable[Iterable[Any]], *header: str) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


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
    parts = [shlex.quote(_without_home(word)) for word in words[1:]]
    return " \\\n    ".join([words[0], *parts]) if words else ""


def _without_home(word: str) -> str:
    """`~` in place of the home folder: a card is public."""
    home = os.path.expanduser("~")
    return word.replace(home, "~") if len(home) > 1 else word
