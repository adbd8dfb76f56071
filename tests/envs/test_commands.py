"""The package's commands: what they write, and that a wrong flag ends in a sentence."""

import json
import subprocess
import sys
from importlib import resources

import pytest
from lerobot_env_cronos.benchmark import freeze
from lerobot_env_cronos.benchmark.configurations import load_configurations
from lerobot_env_cronos.expert import ceiling

from cronos_lerobot.studies import speed

DATA = resources.files("lerobot_env_cronos").joinpath("data")


def run(monkeypatch, command, *flags):
    monkeypatch.setattr(sys, "argv", ["command", *map(str, flags)])
    command.main()


@pytest.mark.parametrize(("what", "packaged"), [("configurations", "{}.json"), ("orderings", "orderings/{}.json")])
def test_what_is_written_is_what_is_packaged(tmp_path, monkeypatch, capsys, what, packaged):
    run(monkeypatch, freeze, what, "playroom_2x2", "--output", tmp_path)
    path = tmp_path / "playroom_2x2.json"
    assert path.read_bytes() == DATA.joinpath(packaged.format("playroom_2x2")).read_bytes()
    assert capsys.readouterr().out == f"wrote {path}\n"


def test_another_seed_writes_other_configurations(tmp_path, monkeypatch):
    run(monkeypatch, freeze, "configurations", "playroom_2x2", "--output", tmp_path, "--seed=0")
    content = json.loads((tmp_path / "playroom_2x2.json").read_text())
    assert content["seed"] == 0
    assert content["splits"]["train"] != load_configurations("playroom_2x2", "train").tolist()


def test_the_command_is_a_module_that_nothing_imports(tmp_path):
    """Python warns of `-m` with one that its package has imported."""
    flags = ("-W", "error::RuntimeWarning", "-m", "lerobot_env_cronos.benchmark.freeze")
    done = subprocess.run(
        [sys.executable, *flags, "orderings", "kitchen_2x2"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "wrote kitchen_2x2.json\n")
    assert "RuntimeWarning" not in done.stderr


@pytest.mark.parametrize(
    ("command", "flags", "message"),
    [
        (freeze, ("orderings", "garage"), "unknown scene 'garage'; valid scenes: ['kitchen_2x2'"),
        (freeze, ("configurations", "garage"), "unknown scene 'garage'"),
        (
            freeze,
            ("configurations", "kitchen_2x2", "--output=there/is/none"),
            "--output=there/is/none is no folder",
        ),
        (freeze, ("orderings", "kitchen_2x2", "--output=there/is/none"), "--output=there/is/none is no folder"),
        (freeze, ("orderings", "kitchen_2x2", "--seed=1"), "--seed is of configurations"),
        (
            freeze,
            ("configurations", "x", "--discover_packages_path=nobody_has_this"),
            "--discover_packages_path=nobody_has_this: No module named 'nobody_has_this'",
        ),
        (ceiling, ("--scene=garage",), "unknown scene 'garage'"),
        (
            ceiling,
            ("--discover_packages_path=nobody_has_this",),
            "--discover_packages_path=nobody_has_this: No mod",
        ),
        (ceiling, ("--num_streams=1",), "--num_streams must be at least 2"),
        (speed, ("--scene=garage",), "unknown scene 'garage'"),
    ],
)
def test_a_wrong_flag_ends_in_a_sentence(monkeypatch, capsys, command, flags, message):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, command, *flags)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "flags", "advice"),
    [
        (freeze, ("orderings", "garage"), "lerobot_env_<name>, or give --discover_packages_path=<package>\n"),
        (ceiling, ("--scene=garage",), "lerobot_env_<name>, or give --discover_packages_path=<package>\n"),
        # It has no such flag.
        (speed, ("--scene=garage",), "install it as lerobot_env_<name>\n"),
    ],
)
def test_the_advice_for_an_unknown_scene_works(monkeypatch, capsys, command, flags, advice):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, command, *flags)
    assert capsys.readouterr().err.endswith(advice)


@pytest.mark.usefixtures("registries")
def test_a_scene_of_an_installed_plugin_is_found(tmp_path, monkeypatch, capsys):
    (tmp_path / "lerobot_env_attic.py").write_text(
        "from lerobot_env_cronos import Scene, register_scene\n"
        'register_scene(Scene("attic", ("ketchup bottle",), ("cloth",)))\n'
    )
    installed = tmp_path / "lerobot_env_attic-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_env_attic\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    run(monkeypatch, freeze, "orderings", "attic", "--output", tmp_path)
    assert json.loads((tmp_path / "attic.json").read_text())["tasks"] == ["put the ketchup bottle on the cloth"]


def test_the_ceiling_has_its_folder_before_it_measures(tmp_path, monkeypatch, capsys):
    class MeasuredError(Exception):
        pass

    def measure(*_):
        raise MeasuredError

    monkeypatch.setattr(ceiling, "measure_independent", measure)
    with pytest.raises(MeasuredError):
        run(monkeypatch, ceiling, f"--output={tmp_path}/new/folder")
    assert (tmp_path / "new/folder").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, ceiling, f"--output={tmp_path}/file")
    assert f"File exists: '{tmp_path}/file'" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["configurations", "orderings"])
def test_a_module_of_the_library_that_is_run_says_which_command_it_is(what, monkeypatch):
    import runpy

    name = f"lerobot_env_cronos.benchmark.{what}"
    monkeypatch.delitem(sys.modules, name)
    with pytest.raises(SystemExit, match=f"`python -m lerobot_env_cronos.benchmark.freeze {what} SCENE` writes"):
        runpy.run_module(name, run_name="__main__")
