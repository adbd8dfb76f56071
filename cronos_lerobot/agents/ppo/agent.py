"""The agent of Algorithm 1: a policy that decides, remembers and learns with PPO."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from cronos_lerobot.agents.adapters.registry import Adapter, trained_tensors
from cronos_lerobot.agents.base import ActionSample, Columns, Decision, LearningAgent, decision_steps
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.ppo.state import join_rollouts, set_optimizer
from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.agents.state import to_arrays, to_tensors
from cronos_lerobot.stopwatch import Stopwatch


class PPOAgent(LearningAgent):
    """Acts, stores and updates.

    All streams decide at the same control steps, on n actions that are played open loop. A stream that diverges in
    between has ended its decision there; it decides anew, and what it does until the others decide, at most n - 1
    steps, is not learned from.

    Args:
        ppo: holds the policy, its processors and the optimizer.
        buffer: holds the decisions since the last update.
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
        self._adapter = ppo.policy if isinstance(ppo.policy, Adapter) else None
        self.policy, self.optimizer = getattr(self._adapter, "policy", ppo.policy), ppo.optimizer
        self.buffer = buffer
        self.generator = generator
        self.stopwatch = stopwatch or Stopwatch()
        self.streams = streams
        self.num_steps = decision_steps(ppo.policy)
        self._step = 0
        self._encoded: Columns = {}
        self._decision: Decision | None = None
        # Dropout and the like stay off in the update too, or the ratio would not be 1 before its first step.
        ppo.policy.eval()

    @torch.inference_mode()
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """The next action of each of its streams; a decision where none is left."""
        tau = tau[self.streams]
        with self.stopwatch("infer"):
            if self._step == 0:
                self._begin(*self._decide(observation_columns(o_t), tau))
            elif self._fresh.any():
                self._decide_anew(observation_columns(o_t), tau)
            assert self._decision is not None
            everyone = np.arange(len(tau))
            action = self._actions[everyone, self._step - self._since]
            log_prob = self._decision.log_prob
            return ActionSample(action, log_prob.reshape(len(tau), -1).sum(1), self._decision.value)

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
        """Take in one control step; with its last one a decision is kept, as `act` encoded what it was made on.

        Where the trace is cut, it is bootstrapped from the value of `o_tp1`, or of `o_t` if there is no outcome.
        """
        mine = self.streams
        tau, r_t, cut_t, diverged_t = tau[mine], r_t[mine], cut_t[mine], diverged_t[mine]
        self._reward += np.where(self._open, self.ppo.config.gamma**self._step * r_t, 0.0)
        self._duration += self._open
        cut = self._open & cut_t
        if (cut & ~diverged_t).any():
            self._bootstrap = np.where(cut & ~diverged_t, self._values(o_tp1, tau), self._bootstrap)
        if (cut & diverged_t).any():
            before = a_t.value if self._step == 0 else self._values(o_t, tau)
            self._bootstrap = np.where(cut & diverged_t, before, self._bootstrap)
        self._cut |= cut
        self._open &= ~cut_t
        self._fresh = cut_t.copy()
        self._step += 1
        if self._step == self.num_steps:
            assert self._decision is not None
            self.buffer.add(
                self._encoded, tau, self._decision, self._reward, self._cut, self._bootstrap, self._duration
            )
            self._step = 0

    def update(self) -> dict[str, float]:
        """Learn from the buffer and clear it."""
        with self.stopwatch("update"):
            metrics = self.ppo.update(self.buffer)
            self.buffer.clear()
            return metrics

    def shared_tensors(self) -> Iterable[torch.Tensor]:
        """The policy's parameters and those beside it."""
        return trained_tensors(self.ppo.policy)

    def state_dict(self) -> dict[str, Any]:
        """The rollout that a budget's end left, the base policy, the count of updates; see `LearningAgent`."""
        ppo = self.ppo
        base = {} if ppo.base_policy is None else ppo.base_policy.parameters
        return {
            "num_updates": ppo.num_updates,
            "config": {"policy_lr": ppo.config.policy_lr, "value_lr": ppo.config.value_lr},
            "base_policy": base,
            "adapter": {} if self._adapter is None else self._adapter.own_parameters(),
            "rollout": to_tensors(join_rollouts(self.buffer.state_dict(), ppo.processes)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, with the streams of this process."""
        self.ppo.num_updates = state["num_updates"]
        set_optimizer(self.ppo.optimizer, self.ppo.config, state["config"])
        if self.ppo.base_policy is not None:
            self.ppo.base_policy.load(state["base_policy"])
        if self._adapter is not None:
            self._adapter.load_own_parameters(state["adapter"])
        self.buffer.load_state_dict(to_arrays(state["rollout"]), self.streams)

    def _decide(self, columns: Columns, tau: list[str]) -> tuple[Columns, Decision]:
        encoded = self.ppo.processors.encode(columns, tau)
        batch = self.ppo.processors.encoded_batch(encoded, tau)
        sample = self.ppo.policy.sample_actions(
            batch, temperature=self.ppo.config.temperature, generator=self.generator
        )
        actions = sample["actions"]
        if actions.shape[1] != self.num_steps:
            raise ValueError(
                f"{type(self.ppo.policy).__name__} decided on {actions.shape[1]} actions; its decision_steps says "
                f"{self.num_steps}."
            )
        return encoded, Decision(
            actions=self.ppo.processors.physical_actions(actions.flatten(0, 1)).reshape(actions.shape),
            trace=sample["trace"].cpu().numpy(),
            log_prob=sample["log_prob"].float().cpu().numpy(),
            value=sample["value"].float().cpu().numpy(),
        )

    def _begin(self, encoded: Columns, decision: Decision) -> None:
        """All streams have decided."""
        n = len(decision.value)
        # The environment may write the next observation where this one lies.
        self._encoded = {name: col.copy() for name, col in encoded.items()} if self.num_steps > 1 else encoded
        self._decision, self._actions = decision, decision.actions
        self._since = np.zeros(n, np.int64)
        self._reward, self._bootstrap = np.zeros(n), np.zeros(n, np.float32)
        self._duration = np.zeros(n, np.int64)
        self._cut, self._fresh, self._open = np.zeros(n, bool), np.zeros(n, bool), np.ones(n, bool)

    def _decide_anew(self, columns: Columns, tau: list[str]) -> None:
        """Streams whose decision ended too early decide on what they do until the others decide."""
        who = np.flatnonzero(self._fresh)
        _, decision = self._decide({name: col[who] for name, col in columns.items()}, [tau[i] for i in who])
        self._actions = self._actions.copy()
        self._actions[who] = decision.actions
        self._since[who] = self._step

    @torch.inference_mode()
    def _values(self, observation: dict[str, Any], tau: list[str]) -> np.ndarray:
        encoded = self.ppo.processors.encode(observation_columns(observation), tau)
        batch = self.ppo.processors.encoded_batch(encoded, tau)
        return self.ppo.policy.predict_values(batch).float().cpu().numpy()
