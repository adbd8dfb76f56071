"""Makes PPO's agent of a run: `--algorithm.type=ppo` and `ppo_paper`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch

from cronos_lerobot.agents.adapters import builtin as _builtin  # noqa: F401 -- registers them
from cronos_lerobot.agents.adapters.privileged import PrivilegedCritic
from cronos_lerobot.agents.adapters.registry import Adapter, AdapterOptions, make_trainable
from cronos_lerobot.agents.base import decision_steps
from cronos_lerobot.agents.history import blank_columns
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.ppo.self_imitation import SelfImitation
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.registry import AgentContext, register_agent


@register_agent("ppo")
@register_agent("ppo_paper")
def make_ppo_agent(context: AgentContext) -> PPOAgent:
    """Return the agent.

    Raises:
        ValueError: the policy does not say how likely its decisions were, or decides beyond a task switch, or
            cannot be cloned though the config asks for it; or the config has what this policy does not follow.
    """
    config = context.config
    options = AdapterOptions(config.noise_std, config.noise_level, config.noise_steps)
    policy = make_trainable(context.policy, options)
    _check_followed(policy, config, options)
    if config.ratio == "factor":
        _check_factors(policy, context.processors)
    if config.critic_observation == "environment_state":
        policy = _with_privileged_critic(policy, context)
    if isinstance(policy, Adapter):
        context.processes.copy_from_main([*policy.own_parameters().values()])
    mine = context.streams
    # Every process draws its own minibatches and actions.
    rng, cloned = context.rng("minibatches"), _self_imitation(context)
    ppo = PPO(policy, context.processors, config, rng, context.processes, cloned)
    steps = decision_steps(policy, context.task_switch_interval)
    buffer = RolloutBuffer(context.update_interval // steps, mine.stop - mine.start)
    return PPOAgent(ppo, buffer, context.torch_rng("actions"), context.stopwatch, mine)


def _check_followed(policy: Any, config: Any, options: AdapterOptions) -> None:
    read = policy.options_read if isinstance(policy, Adapter) else frozenset()
    for name, default in asdict(AdapterOptions()).items():
        if name not in read and (given := getattr(options, name)) != default:
            raise ValueError(
                f"--algorithm.{name}={given} is not for --policy.type={policy.config.type}, which "
                + (f"reads {' and '.join(sorted(read))}." if read else "has no adapter that would read it.")
            )
    if config.denoising_discount < 1 and isinstance(policy, Adapter) and not policy.is_chain:
        raise ValueError(
            f"--algorithm.denoising_discount={config.denoising_discount} is between the steps of a denoising "
            f"chain, which --policy.type={policy.config.type} has not: give 1."
        )
    if isinstance(policy, Adapter) and getattr(policy.config, "gradient_checkpointing", False):
        raise ValueError(
            "--policy.gradient_checkpointing=true has no effect in PPO, which learns from policies as they act, "
            f"and LeRobot's {policy.config.type} computes anew only in training mode: give a smaller "
            "--algorithm.minibatch_size, with --algorithm.grad_accumulation."
        )
    if config.entropy_coef and not getattr(policy, "has_entropy", True):
        raise ValueError(
            f"--algorithm.entropy_coef={config.entropy_coef}: no entropy is known of what "
            f"--policy.type={policy.config.type} decides; give 0."
        )


def _check_factors(policy: Any, processors: PolicyProcessors) -> None:
    """A decision on nothing says whether those of this policy have factors."""
    policy.eval()
    texts = ["put it there"]
    with torch.inference_mode():
        batch = processors.encoded_batch(processors.encode(blank_columns(policy), texts), texts)
        log_prob = policy.sample_actions(batch, generator=torch.Generator(processors.device))["log_prob"]
    if log_prob.ndim == 1:
        raise ValueError(
            "--algorithm.ratio=factor clips each factor of a decision, such as the steps of a denoising chain: "
            f"--policy.type={policy.config.type} gives a decision one probability, which is what "
            "--algorithm.ratio=decision clips."
        )


def _self_imitation(context: AgentContext) -> SelfImitation | None:
    if not context.config.self_imitation.coef:
        return None
    num_streams = context.streams.stop - context.streams.start
    rng = context.rng("self_imitation")
    return SelfImitation(
        context.policy, context.processors, context.config, num_streams, rng, context.processes,
        context.observation_shapes,
    )  # fmt: skip


def _with_privileged_critic(policy: Any, context: AgentContext) -> PrivilegedCritic:
    if not isinstance(policy, Adapter):
        raise ValueError(
            f"--algorithm.critic_observation=environment_state is for policies without a critic; "
            f"--policy.type={policy.config.type} has one of its own, and perhaps a --policy.critic_observation."
        )
    return PrivilegedCritic(policy, context.observation_shapes)
