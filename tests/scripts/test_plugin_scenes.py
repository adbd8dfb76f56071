"""Commands know the scenes that installed plugins bring."""

import os
import sys

import pytest
from forked_commands import run_forked

from cronos_lerobot.scripts import streams

PLUGIN = """
from lerobot_env_cronos import Body, Scene, register_scene

coaster = Body("blue coaster", (0.09, 0.09, 0.005), 900, "disc", (0.1, 0.3, 0.8))
register_scene(Scene("study_1x1", ("ketchup bottle",), ("blue coaster",)), bodies=[coaster])
"""
CODE = """
import sys
from cronos_lerobot.scripts.{module} import main
from lerobot_env_cronos import SCENES

sys.argv = ["{module}", "{command}"]
try:
    main()
except SystemExit:
    pass
print("scenes:", *SCENES)
"""


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("check", ()),
        ("statistics", ()),
        ("filter", ("--output.repo_id=me/y",)),
        ("weights", ("--output=x.parquet",)),
    ],
)
def test_a_module_with_the_scene_of_streams_is_imported(tmp_path, monkeypatch, command, output):
    (tmp_path / f"my_scene_to_{command}.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    flags = ["--dataset.repo_id=me/x", f"--dataset.root={tmp_path}", *output]
    for module, said in (
        (f"my_scene_to_{command}", "no LeRobotDataset in"),
        ("nobody", "No module named"),
    ):
        argv = ["cronos-streams", command, *flags, f"--dataset.discover_packages_path={module}"]
        monkeypatch.setattr(sys, "argv", argv)
        with pytest.raises(SystemExit, match=f"^error: .*{said}"):
            streams.main()
    assert f"my_scene_to_{command}" in sys.modules


@pytest.mark.parametrize(("module", "command"), [("streams", "check"), ("publish", "benchmark")])
def test_a_command_imports_installed_plugins_before_it_looks_for_a_scene(tmp_path, module, command):
    package = tmp_path / "lerobot_env_study"
    package.mkdir()
    (package / "__init__.py").write_text(PLUGIN)
    installed = tmp_path / "lerobot_env_study-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_env_study\nVersion: 1.0\n")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = run_forked(
        [sys.executable, "-c", CODE.format(module=module, command=command)], env=environment, check=True
    )
    assert "study_1x1" in done.stdout.rpartition("scenes:")[2].split()
