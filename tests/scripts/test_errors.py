"""What a user got wrong is one line, whichever library found it; text is the text that it is."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
from lerobot_env_cronos.simulation import rendering

from cronos_lerobot.command_line import parse_command_line
from cronos_lerobot.ranges import check_ranges, limits, ranged
from cronos_lerobot.scripts import publish, record_demos
from cronos_lerobot.scripts.errors import WORK_ERRORS, error_line, reason
from cronos_lerobot.scripts.subcommands import run_subcommand


@dataclass
class Inner:
    size: int = 1
    depth: float = 1.0
    share: float | None = ranged(0.5, above=0, maximum=1)

    def __post_init__(self):
        if self.size < 1:
            raise ValueError(f"inner.size must be >= 1,\n  got {self.size}.")


@dataclass
class Config:
    name: str = "a"
    fast: bool = False
    most: int | None = ranged(None, minimum=1)
    kind: str = ranged("one", choices=("one", "two"))
    counts: list[int] = field(default_factory=list, metadata=limits(minimum=1, below=10))
    inner: Inner = field(default_factory=Inner)


def parse(*arguments):
    with error_line():
        return parse_command_line(Config, arguments)


def test_a_right_command_line_is_read(tmp_path):
    assert parse("--name=b", "--inner.size", "3") == Config("b", inner=Inner(3))
    for name, text in (("file.yaml", "name: c\ninner: {size: 4}"), ("file.json", '{"inner": {"depth": 1e-05}}')):
        (tmp_path / name).write_text(text)
    assert parse(f"--config_path={tmp_path / 'file.yaml'}", "--name=b") == Config("b", inner=Inner(4))
    assert parse(f"--config_path={tmp_path / 'file.json'}").inner.depth == 1e-5


def test_a_plugin_may_be_one_file(monkeypatch, tmp_path):
    (tmp_path / "my_only_file.py").write_text("imported = []\nimported.append(__name__)\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert parse("--inner.discover_packages_path=my_only_file") == Config()
    assert sys.modules.pop("my_only_file").imported == ["my_only_file"]


@pytest.mark.parametrize(
    ("flag", "named"),
    [
        ("--nmae=b", "--nmae=b; --help"),
        ("--inner.size=0", r"inner\.size must be >= 1, got 0\.$"),  # draccus hides it
        ("--inner.size=big", r"inner\.size"),
        ("--config_path=/nowhere.json", "/nowhere.json"),
        ("--inner.discover_packages_path=no_such_file", "no_such_file"),
    ],
)
def test_what_is_wrong_with_a_flag_is_one_line(flag, named, capsys):
    with pytest.raises(SystemExit, match=f"^error: .*{named}") as ended:
        parse(flag)
    assert "\n" not in str(ended.value)
    assert capsys.readouterr().err == ""


def test_null_is_a_value_where_none_is():
    assert parse("--most=null", "--inner.share=null") == Config(inner=Inner(share=None))
    # A word is a word.
    assert parse("--name=none") == Config("none")


@pytest.mark.parametrize(
    ("flag", "config"),
    [
        ("--most", Config(most=0)),
        ("--kind", Config(kind="three")),
        ("--kind", Config(kind=None)),
        ("--counts", Config(counts=[1, 10])),
        (r"--inner\.share", Config(inner=Inner(share=0.0))),
        (r"--inner\.share", Config(inner=Inner(share=float("nan")))),
    ],
)
def test_a_value_out_of_its_range_is_named_by_its_flag(flag, config):
    check_ranges(Config(most=1, counts=[1, 9], inner=Inner(share=1.0)))
    with pytest.raises(ValueError, match=flag):
        check_ranges(config)


def test_bugs_keep_their_traceback():
    with pytest.raises(ZeroDivisionError), error_line():
        1 / 0  # noqa: B018
    with pytest.raises(SystemExit, match=r"^error: division by zero$"), error_line(ZeroDivisionError):
        1 / 0  # noqa: B018
    with pytest.raises(ValueError, match="a bug"), error_line(only=WORK_ERRORS):
        raise ValueError("a bug of the work")


def test_a_hub_that_is_not_reached_is_one_line(monkeypatch):
    def look(config):
        raise httpx.ConnectError("Name or service not known")

    said = r"^error: the Hub was not reached \(ConnectError"
    with pytest.raises(SystemExit, match=said), error_line():
        look(Config())
    monkeypatch.setattr(sys, "argv", ["cronos-streams", "check"])
    with pytest.raises(SystemExit, match=said):
        run_subcommand({"check": (Config, look)})


def test_an_error_that_says_nothing_is_named():
    assert reason(FileNotFoundError()) == "FileNotFoundError"


@dataclass
class Place:
    root: Path | None = None


@dataclass
class Titled:
    title: str = ""
    revision: str | None = None
    count: int = 0
    words: list[str] = field(default_factory=list)
    dataset: Place = field(default_factory=Place)


def parsed(monkeypatch, *arguments) -> Titled:
    found = []
    monkeypatch.setattr(sys, "argv", ["command", "show", *arguments])
    run_subcommand({"show": (Titled, found.append)})
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


def no_canvas(*_):
    raise ImportError("EGL")


@pytest.mark.parametrize(
    ("script", "flags", "folder", "advice"),
    [
        (
            record_demos,
            "--env.type=cronos --env.num_threads=1 --num_envs=1 --dataset.repo_id=me/d",
            "dataset.root",
            "",
        ),
        (publish, "benchmark --repo_id=me/d --dry_run=true", "output_dir", "--pictures=false publishes without"),
    ],
)
def test_that_nothing_can_be_drawn_is_told_before_anything_is_made(
    script, flags, folder, advice, tmp_path, monkeypatch
):
    monkeypatch.setattr(rendering, "Canvas", no_canvas)
    monkeypatch.setattr(sys, "argv", ["command", *flags.split(), f"--{folder}={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match=rf"^error: cannot open an OpenGL context.*{advice}"):
        script.main()
    assert not (tmp_path / "out").exists()


def test_demonstrations_from_the_state_draw_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "Canvas", no_canvas)
    flags = (
        "--env.type=cronos --env.num_threads=1 --env.obs_type=environment_state_agent_pos --num_envs=1"
        " --dataset.repo_id=me/d --dataset.num_episodes=1"
    )
    monkeypatch.setattr(sys, "argv", ["command", *flags.split(), f"--dataset.root={tmp_path / 'out'}"])
    record_demos.main()
    assert (tmp_path / "out/meta/info.json").is_file()
