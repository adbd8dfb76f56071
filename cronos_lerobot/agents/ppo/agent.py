"""The agent of Algorithm 1: a policy that acts, remembers and learns with PPO."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from cronos_lerobot.agents.base import ActionSample, Columns, LearningAgent
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.ppo.state import join_rollouts, set_optimizer
from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.agents.state import to_arrays, to_tensors
from cronos_lerobot.stopwatch import Stopwatch


class PPOAgent(LearningAgent):
    """Acts, stores and updates.

    Args:
        ppo: holds the policy, its processors and the optimizer.
        buffer: holds the transitions since the last update.
        generator: draws the actions.
        stopwatch: told the time spent in `act` ("infer") and `update` ("update").
        streams: of all N, those that this agent acts in; observations are of these, all else is of all N.
    """

    def __init__(
        self,
        ppo: PPO,
        buffer: RolloutBuffer,
        generator: torch.Generator,
        stopwatch: Stopwatch | None = None,
        streams: slice = slice(None),
    ) -> None:
        self.ppo = ppo
        self.policy, self.optimizer = ppo.policy, ppo.optimizer
        self.buffer = buffer
        self.generator = generator
        self.stopwatch = stopwatch or Stopwatch()
        self.streams = streams
        self._encoded: Columns = {}
        # Dropout and the like stay off in the update too, or the ratio would not be 1 before its first step.
        ppo.policy.eval()

    @torch.inference_mode()
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """Sample an action for each of its streams."""
        tau = tau[self.streams]
        with self.stopwatch("infer"):
            self._encoded = self.ppo.processors.encode(observation_columns(o_t), tau)
            batch = self.ppo.processors.encoded_batch(self._encoded, tau)
            sample = self.ppo.policy.sample_actions(
                batch, temperature=self.ppo.config.temperature, generator=self.generator
            )
            return ActionSample(
                action=self.ppo.processors.physical_actions(sample["action"]),
                tokens=sample["tokens"].cpu().numpy(),
                log_prob=sample["log_prob"].float().cpu().numpy(),
                value=sample["value"].float().cpu().numpy(),
            )

    def store(
        self,
        o_t: dict[str, Any],
        tau: list[str],
        a_t: ActionSample,
        r_t: np.ndarray,
        o_tp1: dict[str, Any],
        cut_t: np.ndarray,
        diverged_t: np.ndarray,
    ) -> None:
        """Keep one transition of each of its streams, with the value to bootstrap from where the trace is cut.

        `o_t` is kept as `act` encoded it.
        """
        mine = self.streams
        tau, r_t, cut_t, diverged_t = tau[mine], r_t[mine], cut_t[mine], diverged_t[mine]
        bootstrap = a_t.value
        if (cut_t & ~diverged_t).any():
            bootstrap = np.where(diverged_t, a_t.value, self._values(o_tp1, tau))
        self.buffer.add(self._encoded, tau, a_t, r_t, cut_t, bootstrap)

    def update(self) -> dict[str, float]:
        """Learn from the buffer and clear it."""
        with self.stopwatch("update"):
            metrics = self.ppo.update(self.buffer)
            self.buffer.clear()
            return metrics

    def state_dict(self) -> dict[str, Any]:
        """The rollout that a budget's end left, the base policy, the count of updates; see `LearningAgent`."""
        ppo = self.ppo
        base = {} if ppo.base_policy is None else ppo.base_policy.parameters
        return {
            "num_updates": ppo.num_updates,
            "config": {"policy_lr": ppo.config.policy_lr, "value_lr": ppo.config.value_lr},
            "base_policy": base,
            "rollout": to_tensors(join_rollouts(self.buffer.state_dict(), ppo.processes)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, with the streams of this process."""
        self.ppo.num_updates = state["num_updates"]
        set_optimizer(self.ppo.optimizer, self.ppo.config, state["config"])
        if self.ppo.base_policy is not None:
            self.ppo.base_policy.load(state["base_policy"])
        self.buffer.load_state_dict(to_arrays(state["rollout"]), self.streams)

    @torch.inference_mode()
    def _values(self, observation: dict[str, Any], tau: list[str]) -> np.ndarray:
        encoded = self.ppo.processors.encode(observation_columns(observation), tau)
        batch = self.ppo.processors.encoded_batch(encoded, tau)
        return self.ppo.policy.predict_values(batch).float().cpu().numpy()
