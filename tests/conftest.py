"""Shared by all tests: the OpenGL platform is chosen before any test imports mujoco."""

import email
import inspect
from functools import cache
from importlib import metadata
from types import SimpleNamespace

import lerobot_env_cronos  # noqa: F401
from draccus.wrappers import docstring, field_wrapper

# For each command line Draccus reads the source of every field's class and the signature of every action anew, and
# LeRobot, which looks for plugins, what every installed package says of itself: most of a test's second.
docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)
field_wrapper.inspect = SimpleNamespace(getfullargspec=cache(inspect.getfullargspec))
metadata.email = SimpleNamespace(message_from_string=cache(email.message_from_string))

LONGEST = ("test_wheels.py", "test_demo.py", "test_cronos_reproduce.py", "test_slurm.py", "test_distributed.py")


def pytest_collection_modifyitems(items):
    """Files whose few tests take longest begin, so that no worker is left with one of them at the end."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
