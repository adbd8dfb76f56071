"""Shared by all tests: what each process of pytest does before it looks for them."""

import importlib

LONGEST = ("test_wheels.py", "test_demo.py", "test_cronos_reproduce.py", "test_slurm.py", "test_distributed.py")


def pytest_configure(config):
    """The OpenGL platform is chosen before any test imports mujoco; who only hands tests to workers needs none."""
    if config.getoption("dist", "no") == "no":
        importlib.import_module("lerobot_env_cronos")
        importlib.import_module("faster")


def pytest_collection_modifyitems(items):
    """Files whose few tests take longest begin, so that no worker is left with one of them at the end."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
