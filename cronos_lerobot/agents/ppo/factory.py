"""Makes PPO's agent of a run: `--algorithm.type=ppo` and `ppo_paper`."""

from __future__ import annotations

from typing import Any

from cronos_lerobot.agents.adapters import builtin as _builtin  # noqa: F401 -- registers them
from cronos_lerobot.agents.adapters.privileged import PrivilegedCritic
from cronos_lerobot.agents.adapters.registry import Adapter, AdapterOptions, make_trainable
from cronos_lerobot.agents.base import decision_steps
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.registry import AgentContext, register_agent


@register_agent("ppo")
@register_agent("ppo_paper")
def make_ppo_agent(context: AgentContext) -> PPOAgent:
    """Return the agent.

    Raises:
        ValueError: the policy does not say how likely its decisions were, decides beyond a task switch, or has a
            critic of its own where the config asks for a privileged one.
    """
    config = context.config
    options = AdapterOptions(config.noise_std, config.noise_level, config.noise_steps)
    policy = make_trainable(context.policy, options)
    if config.critic_observation == "environment_state":
        policy = _with_privileged_critic(policy, context)
    if isinstance(policy, Adapter):
        context.ranks.copy_from_main([*policy.own_parameters().values()])
    mine = context.streams
    # Every process draws its own minibatches and actions.
    ppo = PPO(policy, context.processors, config, context.rng("minibatches"), context.ranks)
    steps = decision_steps(policy, context.task_switch_interval)
    buffer = RolloutBuffer(context.update_interval // steps, mine.stop - mine.start)
    return PPOAgent(ppo, buffer, context.torch_rng("actions"), context.stopwatch, mine)


def _with_privileged_critic(policy: Any, context: AgentContext) -> PrivilegedCritic:
    if not isinstance(policy, Adapter):
        raise ValueError(
            f"--algorithm.critic_observation is for policies without a critic; --policy.type={policy.config.type} "
            "has its own, and perhaps a --policy.critic_observation."
        )
    return PrivilegedCritic(policy, context.observation_shapes)
