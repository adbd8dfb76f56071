"""Shared by all tests: the OpenGL platform is chosen before any test imports mujoco."""

import lerobot_env_cronos  # noqa: F401
