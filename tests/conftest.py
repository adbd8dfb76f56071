"""Shared by all tests: the OpenGL platform is chosen before any test imports mujoco."""

import signal
from functools import cache

import lerobot_env_cronos  # noqa: F401
from draccus.wrappers import docstring

# For each parser Draccus reads the source of every field's class anew, which is most of a test's second.
docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)

# What a shell runs in the background or under nohup ignores these, and tests that send them would wait in vain.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGTERM, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, handler)
