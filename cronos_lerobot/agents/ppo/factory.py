"""Makes PPO's agent of a run: `--algorithm.type=ppo` and `ppo_paper`."""

from __future__ import annotations

from cronos_lerobot.agents.base import check_trainable, decision_steps
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.registry import AgentContext, register_agent


@register_agent("ppo")
@register_agent("ppo_paper")
def make_ppo_agent(context: AgentContext) -> PPOAgent:
    """Return the agent.

    Raises:
        ValueError: the policy does not say how likely its decisions were, or decides beyond a task switch.
    """
    try:
        check_trainable(context.policy)
    except TypeError as error:
        other = "--algorithm.type=imitation learns with any policy that lerobot-train trains."
        raise ValueError(f"{error} {other}") from error
    mine = context.streams
    # Every process draws its own minibatches and actions.
    ppo = PPO(context.policy, context.processors, context.config, context.rng("minibatches"), context.processes)
    steps = decision_steps(context.policy, context.task_switch_interval)
    buffer = RolloutBuffer(context.update_interval // steps, mine.stop - mine.start)
    return PPOAgent(ppo, buffer, context.torch_rng("actions"), context.stopwatch, mine)
