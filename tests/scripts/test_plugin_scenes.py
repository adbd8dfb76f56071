"""Commands know the scenes that installed plugins bring."""

import os
import re
import sys

import pytest
from forked_commands import run_forked

from cronos_lerobot.hub.checkpoint import environment_flags
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


def test_the_cards_of_a_scene_of_ones_own_name_its_module(tmp_path):
    (tmp_path / "my_scenes.py").write_text(PLUGIN)
    publish = [
        "cronos-publish", "benchmark", "--discover_packages_path=my_scenes", "--scene=study_1x1",
        "--repo_id=me/study", "--pictures=false", "--dry_run=true", f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    run_forked(publish, env=os.environ | {"PYTHONPATH": str(tmp_path)}, check=True)
    card = (tmp_path / "out/README.md").read_text()
    assert "import the module that registers it" in card
    commands = [
        line for line in card.replace("`", "\n").splitlines() if re.match(r"(lerobot|cronos)-\w+ -?", line)
    ]
    assert [line.split()[0] for line in commands if "discover_packages_path=<its module>" in line] == [
        "cronos-eval", "cronos-publish", "lerobot-eval",
    ]  # fmt: skip
    assert "import <its module>  # registers study_1x1\n\nenvs = make_env(" in card
    flags = environment_flags({}, {}, "study_1x1")
    assert flags[:2] == ["--env.discover_packages_path=<module of the scene>", "--env.type=cronos"]
    assert environment_flags({}, {}, "kitchen_3x3")[0] == "--env.type=cronos"
