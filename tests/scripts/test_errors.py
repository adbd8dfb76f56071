"""What a user got wrong is one line, whichever library found it."""

import sys
from dataclasses import dataclass, field

import httpx
import pytest

from cronos_lerobot.scripts.errors import error_line, parse_command_line, reason
from cronos_lerobot.scripts.subcommands import run_subcommand


@dataclass
class Inner:
    size: int = 1
    depth: float = 1.0
    share: float | None = 0.5

    def __post_init__(self):
        if self.size < 1:
            raise ValueError(f"inner.size must be >= 1,\n  got {self.size}.")


@dataclass
class Config:
    name: str = "a"
    fast: bool = False
    most: int | None = None
    inner: Inner = field(default_factory=Inner)


def parse(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with error_line():
        return parse_command_line(Config)


def test_a_right_command_line_is_read(monkeypatch):
    assert parse(monkeypatch, "--name=b", "--inner.size=3") == Config("b", inner=Inner(3))


def test_a_plugin_may_be_one_file(monkeypatch, tmp_path):
    (tmp_path / "my_only_file.py").write_text("imported = []\nimported.append(__name__)\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert parse(monkeypatch, "--inner.discover_packages_path=my_only_file") == Config()
    assert sys.modules.pop("my_only_file").imported == ["my_only_file"]
    with pytest.raises(SystemExit, match=r"^error: Failed to load plugin 'no_such_file'"):
        parse(monkeypatch, "--inner.discover_packages_path=no_such_file")


def test_the_reason_that_draccus_hides_is_the_line(monkeypatch):
    with pytest.raises(SystemExit, match=r"^error: inner\.size must be >= 1, got 0\.$"):
        parse(monkeypatch, "--inner.size=0")


def test_an_unknown_flag_is_one_line_and_status_2(monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(monkeypatch, "--nmae=b")
    assert ended.value.code == 2
    assert capsys.readouterr().err == "error: unrecognized arguments: --nmae=b; --help lists the flags\n"


def test_a_value_of_another_type_is_one_line(monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(monkeypatch, "--inner.size=big")
    assert ended.value.code == 1
    assert capsys.readouterr().err == "error: `inner.size`: Couldn't parse 'big' into an int\n"


def test_null_is_refused_where_it_is_no_value(monkeypatch):
    """draccus gives it to numbers and booleans, too, and what reads them later would not know the flag."""
    assert parse(monkeypatch, "--most=null", "--inner.share=null") == Config(inner=Inner(share=None))
    for flag in ("name", "fast", "inner.size", "inner.depth"):
        with pytest.raises(SystemExit, match=rf"^error: null is no value of --{flag}$"):
            parse(monkeypatch, f"--{flag}=null")
    # A word is a word.
    assert parse(monkeypatch, "--name=none") == Config("none")


def test_bugs_keep_their_traceback():
    with pytest.raises(ZeroDivisionError), error_line():
        1 / 0  # noqa: B018
    with pytest.raises(SystemExit, match=r"^error: division by zero$"), error_line(ZeroDivisionError):
        1 / 0  # noqa: B018


def test_a_hub_that_is_not_reached_is_one_line(monkeypatch):
    def look(config):
        raise httpx.ConnectError("Name or service not known")

    said = r"^error: the Hub was not reached \(ConnectError: Name or service not known\); what is not on this"
    with pytest.raises(SystemExit, match=said), error_line():
        look(Config())
    monkeypatch.setattr(sys, "argv", ["cronos-streams", "check"])
    with pytest.raises(SystemExit, match=said):
        run_subcommand("", {"check": (Config, look)})


def test_an_error_that_says_nothing_is_named():
    assert reason(FileNotFoundError()) == "FileNotFoundError"
