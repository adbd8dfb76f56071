"""What is exported can be imported, and importing it costs nothing until it is used."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ["cronos_lerobot", *(f"cronos_lerobot.{p.parent.name}" for p in ROOT.glob("cronos_lerobot/*/__init__.py"))]


@pytest.mark.parametrize("name", ROOMS)
def test_every_exported_name_is_there_and_says_what_it_is(name):
    package = import_module(name)
    for exported in getattr(package, "__all__", ()):
        assert getattr(package, exported).__doc__ or not callable(getattr(package, exported)), exported


def test_a_name_that_is_not_exported_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing"):
        import_module("cronos_lerobot").nothing  # noqa: B018


def test_importing_the_packages_imports_neither_torch_nor_lerobot():
    code = "import cronos_lerobot, sys; print(sorted({'torch', 'lerobot', 'mujoco'} & sys.modules.keys()))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
