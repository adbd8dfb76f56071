"""The agents of this package; importing it registers them."""

from cronos_lerobot.agents.imitation import agent as imitation
from cronos_lerobot.agents.ppo import agent as ppo
from cronos_lerobot.agents.steering import agent as steering

__all__ = ["imitation", "ppo", "steering"]
