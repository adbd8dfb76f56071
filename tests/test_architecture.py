"""Imports point one way: cronos_lerobot -> lerobot_env_cronos; policy packages stand alone."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "cronos_lerobot": ROOT / "cronos_lerobot",
    "lerobot_env_cronos": ROOT / "envs/lerobot_env_cronos/src/lerobot_env_cronos",
} | {path.name: path for path in sorted(ROOT.glob("policies/*/src/lerobot_policy_*")) if path.is_dir()}

MAY_IMPORT = {"cronos_lerobot": {"lerobot_env_cronos"}}


def imported_packages(folder: Path) -> dict[str, set[str]]:
    """Top-level packages imported by each file of a folder."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        names = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                names.add(node.module.split(".")[0])
        found[str(path.relative_to(folder))] = names
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_point_one_way(package):
    files = imported_packages(PACKAGES[package])
    assert len(files) > 3
    forbidden = set(PACKAGES) - MAY_IMPORT.get(package, set()) - {package}
    offenders = {path: names & forbidden for path, names in files.items() if names & forbidden}
    assert not offenders


def test_distribution_names_are_what_lerobot_discovers():
    """LeRobot imports the distribution's literal name: underscores, equal to the module."""
    import tomllib

    for package in set(PACKAGES) - {"cronos_lerobot"}:
        project = tomllib.loads((PACKAGES[package].parents[1] / "pyproject.toml").read_text())["project"]
        assert project["name"] == package
