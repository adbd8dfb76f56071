"""Agents by name."""

from copy import copy
from types import SimpleNamespace

import pytest
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from cronos_lerobot.agents import builtin, registry

assert builtin


def test_a_name_is_taken_once_and_must_be_known(monkeypatch):
    monkeypatch.setattr(registry, "AGENTS", copy(registry.AGENTS))
    made = registry.register_agent("of_a_test")(lambda context: ("made of", context))
    context = SimpleNamespace(config=SimpleNamespace(type="of_a_test"))
    assert registry.make_agent(context) == ("made of", context)
    assert registry.AGENTS["of_a_test"] is made
    with pytest.raises(ValueError, match="ppo"):
        registry.register_agent("ppo")(made)
    with pytest.raises(ValueError, match=r"--algorithm\.type"):
        registry.AGENTS.check("sac")  # LeRobot's own algorithm has a config and no agent here.


def test_every_agent_of_this_package_has_a_config():
    assert set(registry.AGENTS) <= set(RLAlgorithmConfig.get_known_choices())
