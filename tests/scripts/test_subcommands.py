"""Titles, names and paths are the text that they are, though flags are read as YAML."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from cronos_lerobot.scripts.subcommands import run_subcommand


@dataclass
class Inner:
    root: Path | None = None


@dataclass
class Config:
    title: str = ""
    revision: str | None = None
    count: int = 0
    words: list[str] = field(default_factory=list)
    dataset: Inner = field(default_factory=Inner)


def parsed(monkeypatch, *arguments) -> Config:
    found = []
    monkeypatch.setattr(sys, "argv", ["command", "show", *arguments])
    run_subcommand({"show": (Config, found.append)})
    return found[0]


@pytest.mark.parametrize(
    "text", ["Kitchen: two plates", "Kitchen #2", "[draft] kitchen", "on", "1.10", "0123456", "it's", "plain", ""]
)
def test_text_stays_what_it_is(monkeypatch, text):
    assert parsed(monkeypatch, f"--title={text}", f"--revision={text or 'x'}").title == text
    if text:
        assert parsed(monkeypatch, "--title", text).title == text
        assert parsed(monkeypatch, f"--dataset.root=a/{text} #1/b").dataset.root == Path(f"a/{text} #1/b")


def test_all_else_is_read_as_ever(monkeypatch):
    config = parsed(monkeypatch, "--revision=null", "--count=3", "--words=[a, b]", "--dataset.root=null")
    assert (config.revision, config.count, config.words, config.dataset.root) == (None, 3, ["a", "b"], None)
    with pytest.raises(SystemExit, match=r"^error: "):
        parsed(monkeypatch, "--words=[a")
