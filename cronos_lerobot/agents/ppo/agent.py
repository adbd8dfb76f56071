"""The agent of Algorithm 1: a policy that decides, remembers and learns with PPO."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from cronos_lerobot.agents.adapters.privileged import PrivilegedCritic
from cronos_lerobot.agents.adapters.registry import Adapter, AdapterOptions, make_trainable
from cronos_lerobot.agents.base import Columns, decision_steps
from cronos_lerobot.agents.decisions import DecidingAgent, Decision
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.agents.registry import AgentContext, register_agent
from cronos_lerobot.agents.state import map_leaves
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.stopwatch import Stopwatch


class PPOAgent(DecidingAgent):
    """Acts, stores and updates. Where a trace is cut, it is bootstrapped from the value of what follows.

    Args:
        ppo: holds the policy, its processors and the optimizer.
        buffer: holds the decisions since the last update.
        generator: draws the actions.
        stopwatch: see `DecidingAgent`, as `streams`.
    """

    def __init__(
        self,
        ppo: PPO,
        buffer: RolloutBuffer,
        generator: torch.Generator,
        stopwatch: Stopwatch | None = None,
        streams: slice = slice(None),
    ) -> None:
        super().__init__(ppo.policy, ppo.config.gamma, streams, stopwatch)
        self.ppo, self.buffer, self.generator = ppo, buffer, generator
        self._adapter = ppo.policy if isinstance(ppo.policy, Adapter) else None
        self.policy, self.optimizer = getattr(self._adapter, "policy", ppo.policy), ppo.optimizer
        # Dropout and the like stay off in the update too, or the ratio would not be 1 before its first step.
        ppo.policy.eval()

    def decide(self, columns: Columns, tau: list[str]) -> Decision:
        """See `DecidingAgent`."""
        processors, num_steps = self.ppo.processors, self.clock.num_steps
        encoded = processors.encode(columns, tau)
        batch = processors.encoded_batch(encoded, tau)
        sample = self.ppo.policy.sample_actions(
            batch, temperature=self.ppo.config.temperature, generator=self.generator
        )
        actions = sample["actions"]
        if actions.shape[1] != num_steps:
            raise ValueError(
                f"{type(self.ppo.policy).__name__} decided on {actions.shape[1]} actions; its decision_steps says "
                f"{num_steps}."
            )
        if num_steps > 1:
            # The environment may write the next observation where this one lies.
            encoded = {name: column.copy() for name, column in encoded.items()}
        return Decision(
            actions=processors.physical_actions(actions.flatten(0, 1)).reshape(actions.shape),
            trace=sample["trace"].cpu().numpy(),
            log_prob=sample["log_prob"].float().cpu().numpy(),
            value=sample["value"].float().cpu().numpy(),
            inputs=encoded,
        )

    @torch.inference_mode()
    def look(self, columns: Columns, tau: list[str]) -> np.ndarray:
        """The policy's values (k,)."""
        encoded = self.ppo.processors.encode(columns, tau)
        batch = self.ppo.processors.encoded_batch(encoded, tau)
        return self.ppo.policy.predict_values(batch).float().cpu().numpy()

    def seen(self, decision: Decision) -> np.ndarray:
        """See `DecidingAgent`."""
        return decision.value

    def keep(self, decision: Decision, tau: list[str]) -> None:
        """See `DecidingAgent`."""
        clock = self.clock
        self.buffer.add(decision, tau, clock.reward, clock.cut, clock.following, clock.duration, clock.intervened)

    def update(self) -> dict[str, float]:
        """Learn from the buffer and clear it."""
        with self.stopwatch("update"):
            metrics = self.ppo.update(self.buffer)
            self.buffer.clear()
            return metrics

    def predict_values(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """The policy's values (N,) float32 of beginning the tasks `tau` where `o_t` shows the streams.

        `o_t` is of this process's streams, as in `act`; the answer is of all N. All processes call it. It changes
        nothing and draws nothing at random.
        """
        mine = tau[self.streams]
        with self.stopwatch("infer"):
            columns = self.history.followed_by(observation_columns(o_t), range(len(mine)))
            values = self.look(columns, mine)
        return self.ppo.ranks.concatenate(values)

    def shared_tensors(self) -> Iterable[torch.Tensor]:
        """The policy's parameters and those beside it."""
        return (param for param in self.ppo.policy.parameters() if param.requires_grad)

    def state_dict(self) -> dict[str, Any]:
        """The rollout that a budget's end left, the base policy, updates; see `LearningAgent`."""
        ppo = self.ppo
        return {
            "num_updates": ppo.num_updates,
            "base_policy": {} if ppo.base_policy is None else ppo.base_policy.parameters,
            "adapter": {} if self._adapter is None else self._adapter.own_parameters(),
            "rollout": join_rollouts(self.buffer.state_dict(), ppo.ranks),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, with the streams of this process."""
        self.ppo.num_updates = state["num_updates"]
        if self.ppo.base_policy is not None:
            self.ppo.base_policy.load(state["base_policy"])
        if self._adapter is not None:
            self._adapter.load_own_parameters(state["adapter"])
        self.buffer.load_state_dict(state["rollout"], self.streams)


@register_agent("ppo")
@register_agent("ppo_paper")
def make_ppo_agent(context: AgentContext) -> PPOAgent:
    """Return the agent.

    Raises:
        ValueError: the policy does not say how likely its decisions were, decides beyond a task switch, or has a
            critic of its own where the config asks for a privileged one.
    """
    config = context.config
    options = AdapterOptions(config.noise_std, config.noise_level, config.noise_steps, config.noise_repeat)
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


def join_rollouts(rollout: dict[str, Any], ranks: Ranks) -> dict[str, Any]:
    """The rollouts of all processes as one, in the first of them; they number instructions each in its own way.

    Args:
        rollout: of `RolloutBuffer.state_dict`, as long in every process.
        ranks: all call it.
    """
    if not rollout:
        return {}
    texts = sorted(set().union(*ranks.gather(rollout["instructions"])))
    numbers = np.array([texts.index(text) for text in rollout["instructions"]])
    rollout = rollout | {"instruction_ids": numbers[rollout["instruction_ids"]]}
    return map_leaves(rollout, np.ndarray, ranks.collect) | {"instructions": texts}
