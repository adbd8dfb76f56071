"""Agents by name: what `--algorithm.type=` picks, open to users as resets and task orders are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from cronos_lerobot.agents.base import LearningAgent
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.registry import Registry
from cronos_lerobot.stopwatch import Stopwatch


@dataclass(frozen=True)
class AgentContext:
    """What an agent is made from."""

    config: Any
    """`--algorithm.*`: the agent's own config class, with the command line's values."""
    policy: Any
    """The LeRobot policy, on its device, with the weights that the run begins with."""
    processors: PolicyProcessors
    """The policy's pre- and postprocessor."""
    num_streams: int
    """N, of all processes together."""
    update_interval: int
    """U: control steps of each stream between two updates."""
    task_switch_interval: int
    """K: control steps of each stream between two task switches; U is a multiple of it."""
    rng: Callable[[str], np.random.Generator]
    """Returns the NumPy generator of a name, this process's own. Ask for all of them when the agent is made: the
    checkpoint holds them and continues them."""
    torch_rng: Callable[[str], torch.Generator]
    """Returns the torch generator of a name, on the policy's device, in the same way."""
    observation_shapes: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Of what the environment shows, without the batch, by LeRobot's names; none if they are not known."""
    ranks: Ranks = field(default_factory=Ranks)
    """Those that train together. Gradients are averaged over them by the agent."""
    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    """To be told the time spent in `act` ("infer") and in `update` ("update")."""

    @property
    def streams(self) -> slice:
        """Of all N streams, those of this process."""
        return self.ranks.share_of(self.num_streams)


@dataclass
class AgentConfig(RLAlgorithmConfig):
    """What `--algorithm.*` sets, to be derived from: a dataclass with a default for every flag."""

    def check_reward(self, reward: str) -> None:
        """Raise a ValueError, if the agent makes no sense of this `--protocol.reward`."""

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> Self:
        """Return the defaults: what depends on the policy is asked of it when the agent is made."""
        return cls()


AgentFactory = Callable[[AgentContext], LearningAgent]

AGENTS: Registry[AgentFactory] = Registry("--algorithm.type", "cronos_lerobot.register_agent")
"""What makes the agent of an `--algorithm.type`."""


def register_agent(name: str) -> Callable[[AgentFactory], AgentFactory]:
    """Make an agent selectable as `--algorithm.type=name`.

    It decorates a class whose constructor, or a function that, takes an AgentContext. The config of the same name
    is registered with LeRobot: `@AgentConfig.register_subclass(name)`. If the policy cannot be trained by
    the agent, it raises a ValueError that says so.

    Raises:
        ValueError: the name is taken.
    """

    return AGENTS.register(name)


def make_agent(context: AgentContext) -> LearningAgent:
    """Return the agent of the context's config.

    Raises:
        ValueError: there is no agent of that name, or the policy cannot be trained by it.
    """
    AGENTS.check(context.config.type)
    return AGENTS[context.config.type](context)
