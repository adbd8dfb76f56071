"""The wheels build, work outside the checkout, and declare what they import."""

import ast
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from itertools import chain
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECTS = [ROOT, *sorted((ROOT / "envs").iterdir()), *sorted((ROOT / "policies").iterdir())]
OPTIONAL = {"peft", "transformers"}
"""Of policies that LeRobot itself does not load without them."""
WHEELS = (
    "cronos_lerobot", "lerobot_env_cronos", "lerobot_robot_cronos", "lerobot_policy_openvla",
    "lerobot_policy_pocketvla",
)  # fmt: skip

USE_THEM = """
import sys
from importlib.metadata import entry_points
import numpy as np
from lerobot_env_cronos import CronosVectorEnv
env = CronosVectorEnv(2, obs_type="environment_state_agent_pos")
env.reset(seed=0)
env.step(np.zeros((2, 7)))
import cronos_lerobot
print(cronos_lerobot.__file__)
from cronos_lerobot.bases import official_bases
assert official_bases() == ["kitchen_2x2_pixels", "kitchen_2x2_state"]
for script in entry_points(group="console_scripts"):
    if script.name.startswith("cronos-"):
        print(script.name)
        sys.argv = [script.name, "--help"]
        try:
            script.load()()
        except SystemExit as end:
            assert not end.code, end.code
"""


def find_uv() -> str:
    """The uv of the Makefile, or the one on the PATH."""
    local = ROOT / ".uv/bin/uv"
    found = str(local) if local.is_file() else shutil.which("uv")
    assert found, "uv is needed to build wheels; `make setup` installs it"
    return found


@pytest.fixture(scope="module")
def wheels(tmp_path_factory) -> Path:
    dist = tmp_path_factory.mktemp("dist")
    subprocess.run([find_uv(), "build", "--all-packages", "--wheel", "-q", "-o", dist], cwd=ROOT, check=True)
    return dist


def test_every_distribution_has_a_wheel_with_all_its_files(wheels):
    found = {path.name.split("-")[0]: set(ZipFile(path).namelist()) for path in wheels.glob("*.whl")}
    assert found.keys() == set(WHEELS)
    for project, name in zip(PROJECTS, WHEELS, strict=True):
        folder = next(project.glob(f"src/{name}"), project / name)
        files = {str(path.relative_to(folder.parent)) for path in folder.rglob("*") if path.is_file()}
        assert {file for file in files if "__pycache__" not in file} <= found[name]
    cards = {f"cronos_lerobot/hub/cards/{path.name}" for path in (ROOT / "datasets_cards").iterdir()}
    assert cards <= found["cronos_lerobot"]


def test_wheels_work_outside_the_checkout(wheels, tmp_path):
    """With the dependencies of this environment, but for its links to the checkout, which are in .pth files."""
    python = tmp_path / "venv/bin/python"
    subprocess.run([find_uv(), "venv", "-q", "--python", sys.executable, tmp_path / "venv"], check=True)
    install = [find_uv(), "pip", "install", "-q", "--no-deps", "--python", python]
    subprocess.run([*install, *sorted(wheels.glob("*.whl"))], check=True)
    (site,) = (tmp_path / "venv/lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    result = subprocess.run([python, "-c", USE_THEM], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert str(tmp_path) in result.stdout
    assert {"--protocol.scene_reset_interval", "pocketvla"} <= set(re.findall(r"[\w.-]+", result.stdout))
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert set(re.findall(r"^cronos-[a-z-]+$", result.stdout, re.MULTILINE)) == scripts.keys()
    assert all((tmp_path / "venv/bin" / name).is_file() for name in scripts)


def imported(tree: ast.AST) -> Iterator[str]:
    """Top-level names, but for those that may be missing: in a `try` that catches ImportError."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield str(node.module).split(".")[0]
        elif not (isinstance(node, ast.Try) and any("ImportError" in ast.dump(h) for h in node.handlers)):
            yield from imported(node)


@pytest.mark.parametrize("folder", PROJECTS, ids=WHEELS)
def test_what_is_imported_is_declared(folder):
    settings = tomllib.loads((folder / "pyproject.toml").read_text())
    project = settings["project"]
    requirements = [*project["dependencies"], *chain(*project.get("optional-dependencies", {}).values())]
    declared = {canonicalize_name(Requirement(one).name) for one in (project["name"], *requirements)}
    provided_by = packages_distributions()
    missing = set()
    for package in settings["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        for path in (folder / package).rglob("*.py"):
            for name in {*imported(ast.parse(path.read_text()))} - sys.stdlib_module_names - OPTIONAL:
                if not {canonicalize_name(one) for one in provided_by.get(name, [name])} & declared:
                    missing.add((name, str(path.relative_to(folder))))
    assert not missing
