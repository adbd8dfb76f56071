"""What a run is made of, for task orders and reset strategies that ask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cronos_lerobot.agents.base import Agent
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.streams import Streams


@dataclass(frozen=True)
class RunContext:
    """What a run is made of, for a task order or a reset strategy with a method `bind`."""

    env: Streams
    """The streams: all N of them, whatever process they are in."""
    agent: Agent
    tasks: Sequence[Any]
    """Those that are evaluated, in the order of their indices; without learned reset tasks."""
    protocol: ProtocolConfig
    total_steps: int
    """S: interaction steps of the whole run, summed over the streams."""
