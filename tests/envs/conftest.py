"""Shared by the tests of the environments."""

import gymnasium as gym
import pytest
from lerobot_env_cronos import SCENES
from lerobot_env_cronos.benchmark.configurations import _files
from lerobot_env_cronos.scene.bodies import SHAPES
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.scene.visuals.objects import LOOKS


@pytest.fixture
def registries():
    """All registries are afterwards what they were before."""
    registries = (SCENES, BODIES, SHAPES, LOOKS, _files, gym.registry)
    before = [dict(registry) for registry in registries]
    yield
    for registry, content in zip(registries, before, strict=True):
        registry.clear()
        registry.update(content)
