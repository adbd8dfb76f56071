"""Imports point one way: cronos_lerobot -> lerobot_env_cronos; policy packages stand alone; rooms have floors."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "cronos_lerobot": ROOT / "cronos_lerobot",
    "lerobot_env_cronos": ROOT / "envs/lerobot_env_cronos/src/lerobot_env_cronos",
    "lerobot_robot_cronos": ROOT / "envs/lerobot_robot_cronos/src/lerobot_robot_cronos",
} | {path.name: path for path in sorted(ROOT.glob("policies/*/src/lerobot_policy_*")) if path.is_dir()}

MAY_IMPORT = {"cronos_lerobot": {"lerobot_env_cronos"}, "lerobot_robot_cronos": {"lerobot_env_cronos"}}


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


FLOORS = {
    "cronos_lerobot": (
        "lazy", "stopwatch", "registry", "ranks", "provenance", "locks", "whole_files", "ranges",
        "command_line", "dataset_metadata", "statistics", "environment_id", "bases", "agents", "protocol",
        "robot", "data", "evaluation", "training", "film", "report", "experiments", "hub", "scripts", "__init__",
    ),
    "lerobot_env_cronos": (
        "scene", "benchmark", "simulation", "vector_env", "episodic", "autoreset",
        "sequential", "config", "plugin", "expert", "__init__",
    ),
}  # fmt: skip
"""The rooms of a package from the ground up: what a file imports lies in its own room or below it."""


def imported_rooms(folder: Path, package: str) -> set[tuple[str, str, str]]:
    """(file, its room, room it imports) of a package; a room is a folder or file at its root."""
    found = set()
    for path in sorted(folder.rglob("*.py")):
        relative = path.relative_to(folder)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            rooms = [name.split(".")[1] for name in names if name.startswith(f"{package}.")]
            # `from package import Name` takes what the package itself exports.
            rooms = [room for room in rooms if (folder / room).is_dir() or (folder / f"{room}.py").is_file()]
            found |= {(str(relative), Path(relative.parts[0]).stem, room) for room in rooms}
    return found


@pytest.mark.parametrize("package", FLOORS)
def test_no_room_imports_from_a_floor_above(package):
    floor = {room: number for number, room in enumerate(FLOORS[package])}
    imports = imported_rooms(PACKAGES[package], package)
    assert len(imports) > 20
    upwards = {(path, target) for path, room, target in imports if floor[target] > floor[room]}
    assert not upwards


@pytest.mark.parametrize("package", PACKAGES)
def test_no_files_import_each_other(package):
    """Not even in functions, or for types: a circle of files is one file in several pieces."""
    folder = PACKAGES[package]
    graph = {}
    for path in sorted(folder.rglob("*.py")):
        if path.name == "__init__.py":
            continue
        module = ".".join((package, *path.relative_to(folder).with_suffix("").parts))
        nodes = [
            n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom) and n.level == 0
        ]
        graph[module] = {n.module for n in nodes}
    assert len(graph) > 3
    TopologicalSorter(graph).prepare()


def test_distribution_names_are_what_lerobot_discovers():
    """LeRobot imports the distribution's literal name: underscores, equal to the module."""
    import tomllib

    for package in set(PACKAGES) - {"cronos_lerobot"}:
        project = tomllib.loads((PACKAGES[package].parents[1] / "pyproject.toml").read_text())["project"]
        assert project["name"] == package
