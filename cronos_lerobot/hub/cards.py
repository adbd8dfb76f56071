"""Fills in the cards of `datasets_cards/`."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from huggingface_hub import constants
from markupsafe import Markup

from cronos_lerobot.hub.stage import clean
from cronos_lerobot.provenance import package_versions

PACKAGED = Path(__file__).parent / "cards"
CHECKOUT = Path(__file__).parents[2] / "datasets_cards"


def render_card(kind: str, **values: Any) -> str:
    """The card `kind`.md with `values`.

    Values may come from files of other people. Each stays in its line and cannot end the code that it stands in.

    Raises:
        jinja2.UndefinedError: a value is missing.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PACKAGED if PACKAGED.is_dir() else CHECKOUT),
        undefined=jinja2.StrictUndefined,
        finalize=one_line,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.policies["json.dumps_kwargs"] = {"ensure_ascii": False}
    environment.filters |= {"table": table, "command": command}
    common = {"hub": constants.ENDPOINT, "versions": package_versions()}
    return environment.get_template(f"{kind}.md").render(common | values)


def one_line(value: Any) -> str:
    """A value as text in one line, without backticks; Markdown that is made here stays as it is."""
    return value if isinstance(value, Markup) else re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029`]+", " ", str(value))


def code(value: Any) -> Markup:
    """Inline code."""
    return Markup(f"`{clean(one_line(value))[:300] or ' '}`")


def table(rows: Iterable[Iterable[Any]], *header: str) -> Markup:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    cells = ([one_line(cell).replace("|", "\\|") for cell in line] for line in lines)
    return Markup("\n".join(f"| {' | '.join(line)} |" for line in cells))


def command(words: Iterable[str]) -> Markup:
    """A command for a shell, one flag a line."""
    name, *flags = words
    return Markup(" \\\n    ".join([name, *(shlex.quote(clean(one_line(flag))) for flag in flags)]))


def interval(rate: float, ci95: Iterable[float], digits: int = 3) -> str:
    """A number with its 95 % interval."""
    low, high = ci95
    return f"{rate:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def is_packaged(scene: str) -> bool:
    """Whether a scene comes with the environments' package; any other takes a module that registers it."""
    return resources.files("lerobot_env_cronos").joinpath(f"data/{scene}.json").is_file()


def describe_source(source: str) -> str:
    """Where a benchmark is from, without the folders of the person who used it."""
    return "a local folder" if Path(source.partition("@")[0]).exists() else clean(source)
