"""What is pushed: named files of a folder, and text without what is private.

A run or a dataset may come from somebody else, or have a token beside it. So only files that are known by name are
pushed, no link may lead out of the folder, and every text goes through `clean`.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from jinja2 import TemplateError

SECRETS = re.compile(r"\b(?:(?:hf_|gh[oprsu]_|AKIA)[A-Za-z0-9]{12,}|(?:github_pat_|sk-)[\w-]{12,})")
"""Access tokens, by how they begin."""
HOMES = re.compile(r"(?<![\w.-])(?:/home/|/Users/)[^/\s'\",\]})]+|(?<![\w.-])/root(?![\w.-])")
PATHS = re.compile(r"""(?<=['"])/[^'"\n]+|(?<=[\s=:,\[{(])/(?!/)[^\s'",\]})]+""")
"""Absolute paths in a text. In quotes they may have spaces. Addresses such as `https://...` are not among them."""
PRIVATE = ("wandb",)
"""Keys of a training config that concern only the person who trained."""
VOCABULARIES = ("tokenizer.json", "vocab.json", "added_tokens.json", "special_tokens_map.json")
"""JSON whose text is tokens, not settings; it stays as it is."""
MAX_JSON = 100_000_000
"""Bytes of a JSON file that is read."""


def clean(text: str) -> str:
    """Text without access tokens and folders: `~` for a home folder, `.../name` for other absolute paths."""
    home = os.path.expanduser("~")
    if len(home) > 1:
        text = re.sub(rf"(?<![\w.-]){re.escape(home)}(?![\w.-])", "~", text)
    text = HOMES.sub("~", SECRETS.sub("<token>", text))
    if text.startswith("/") and "\n" not in text:
        return _last_part(text)
    return PATHS.sub(lambda path: _last_part(path[0]), text)


def _last_part(path: str) -> str:
    return f".../{PurePosixPath(path).name}"


def clean_json(value: Any) -> Any:
    """JSON values with clean text, without the keys of `PRIVATE`."""
    if isinstance(value, dict):
        return {name: clean_json(item) for name, item in value.items() if name not in PRIVATE}
    if isinstance(value, list):
        return [clean_json(item) for item in value]
    return clean(value) if isinstance(value, str) else value


def write_text(file: Path, text: str) -> None:
    """Write a text file that is pushed, cleaned."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(clean(text))


def stage(
    source: Path, names: Collection[str], folder: Path, changes: Mapping[str, dict[str, Any]] | None = None
) -> None:
    """Put files of `source` into `folder` and print which others are left out.

    JSON is cleaned, other files become links to the ones in `source`.

    Args:
        source: folder of a policy or a dataset.
        names: files to push, relative to it.
        folder: where the tree to push is made.
        changes: values to replace, by JSON file.

    Raises:
        ValueError: a file is missing, is damaged JSON, or is a link that leads out of `source`.
    """
    root = source.resolve()
    for name in names:
        file, place = _inside(root, name), folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        is_settings = file.suffix == ".json" and file.name not in VOCABULARIES
        text = _changed(read_json(file), (changes or {}).get(name, {})) if is_settings else None
        if text is None:
            place.symlink_to(file)
        else:
            place.write_text(text)
    others = (path for path in root.rglob("*") if path.is_file() or path.is_symlink())
    left = sorted({str(path.relative_to(root)) for path in others} - {*names, "README.md"})
    if left:
        shown = ", ".join(name if name.isprintable() else ascii(name) for name in left[:20])
        print(f"not pushed: {shown}{f' and {len(left) - 20} more' if len(left) > 20 else ''}")


def _inside(root: Path, name: str) -> Path:
    """A file of a folder, after all links."""
    file = (root / name).resolve()
    if not file.is_relative_to(root):
        raise ValueError(f"{root / name} leads out of {root}: replace the link by what it points to")
    if not file.is_file():
        raise ValueError(f"{root / name} is missing")
    return file


def _changed(value: Any, changes: dict[str, Any]) -> str | None:
    """The text of a JSON file with changes and without what is private; None if it stays as it is."""
    cleaned = clean_json(value | changes if changes else value)
    return None if cleaned == value else json.dumps(cleaned, indent=4)


def read_json(file: Path) -> Any:
    """Read a JSON file of somebody else."""
    if file.stat().st_size > MAX_JSON:
        raise ValueError(f"{file} has more than {MAX_JSON // 10**6} MB")
    with readable(file):
        return json.loads(file.read_text())


@contextmanager
def readable(file: Path) -> Generator[None]:
    """Turn whatever goes wrong with the content of a file into a ValueError that names it."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, TemplateError) as error:
        raise ValueError(f"{file} is damaged: {f'{type(error).__name__}: {error}':.300}") from error
