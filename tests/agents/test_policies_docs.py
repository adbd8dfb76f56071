"""docs/policies.md names every policy type that has an adapter, with the agents that can train it."""

import re
from pathlib import Path

from cronos_lerobot.agents import builtin as _agents  # noqa: F401 -- registers them
from cronos_lerobot.agents.adapters import builtin as _adapters  # noqa: F401 -- registers them
from cronos_lerobot.agents.adapters.registry import ADAPTERS
from cronos_lerobot.agents.registry import agent_names

PAGE = (Path(__file__).parents[2] / "docs/policies.md").read_text()
OWN = {"pocketvla", "openvla"}
"""They are trainable without an adapter; PocketVLA's flow head has one."""


def test_the_table_has_every_adapter_with_its_agents():
    lines = [line.split(" | ") for line in PAGE.splitlines() if line.startswith("| `")]
    table = [line for line in lines if len(line) == 7][1:]
    types = {name for line in table for name in re.findall(r"`([a-z0-9_]+)[` ]", line[0])}
    assert types - {"categorical"} == {*ADAPTERS, *OWN}
    for line in table:
        names = set(re.findall(r"`([a-z0-9_]+)[` ]", line[0])) & set(ADAPTERS)
        is_flow = "head=flow" in line[0] or (names - OWN and all(hasattr(ADAPTERS[n], "denoise") for n in names))
        expected = ["ppo", "ppo_paper", *(["steering"] if is_flow else [])]
        assert re.findall(r"`(\w+)`", line[4]) == expected, line[0]
        assert {*expected, "imitation"} <= set(agent_names())
