"""Shared by all tests: the OpenGL platform is chosen before any test imports mujoco."""

from functools import cache

import lerobot_env_cronos  # noqa: F401
from draccus.wrappers import docstring

# For each parser Draccus reads the source of every field's class anew, which is most of a test's second.
docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)
