"""The agent of Algorithm 1: a policy that decides, remembers and learns with PPO."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

from cronos_lerobot.agents.adapters.registry import Adapter, trained_tensors
from cronos_lerobot.agents.base import ActionSample, Columns, Decision, LearningAgent, decision_steps
from cronos_lerobot.agents.decisions import DecisionClock
from cronos_lerobot.agents.history import ObservationHistory, observation_steps
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.ppo.state import join_rollouts, set_optimizer
from cronos_lerobot.agents.processing import observation_columns, to_array
from cronos_lerobot.agents.state import to_arrays, to_tensors
from cronos_lerobot.stopwatch import Stopwatch


class PPOAgent(LearningAgent):
    """Acts, stores and updates.

    When streams decide, and what is learned from: see `DecisionClock`. What a policy that looks back has seen of a
    stream is forgotten where its trace is cut, so at an update nothing is left of it.

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
        self.clock = DecisionClock(self.num_steps)
        self.history = ObservationHistory(observation_steps(ppo.policy))
        self._seen: Columns = {}
        self._encoded: Columns = {}
        self._decision: Decision | None = None
        self._expert: np.ndarray | bool = False
        # Dropout and the like stay off in the update too, or the ratio would not be 1 before its first step.
        ppo.policy.eval()

    @torch.inference_mode()
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """The next action of each of its streams; a decision where none is left."""
        tau = tau[self.streams]
        with self.stopwatch("infer"):
            self._seen = self.history.see(observation_columns(o_t), range(len(tau)))
            if self.clock.step == 0:
                self._begin(*self._decide(self._seen, tau))
            elif self.clock.fresh.any():
                self._decide_anew(self._seen, tau)
            return ActionSample(self.clock.action(), self._log_prob, self._value)

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
        What an expert did is kept and marked: nothing is learned from it.
        """
        mine = self.streams
        tau, r_t, cut_t, diverged_t = tau[mine], r_t[mine], cut_t[mine], diverged_t[mine]
        if self.ppo.self_imitation is not None:
            self.ppo.self_imitation.store(observation_columns(o_t), tau, a_t.action, r_t, diverged_t)
        is_first, clock = self.clock.step == 0, self.clock
        expert = False if a_t.expert is None else a_t.expert
        self._expert = expert if is_first else self._expert | expert
        is_over = clock.store(
            r_t, cut_t, diverged_t, self.ppo.config.gamma,
            before=lambda: a_t.value if is_first else self._values(self._seen, tau),
            after=lambda: self._values(self.history.followed_by(observation_columns(o_tp1), range(len(tau))), tau),
        )  # fmt: skip
        self.history.begin(np.flatnonzero(cut_t))
        if is_over:
            assert self._decision is not None
            self.buffer.add(
                self._encoded, tau, self._decision, clock.reward, clock.cut, clock.following, clock.duration,
                self._expert,
            )  # fmt: skip

    def end_step(self, success: np.ndarray) -> None:
        """Note where the task is complete, if successes are kept."""
        if self.ppo.self_imitation is not None:
            self.ppo.self_imitation.end_step(success[self.streams])

    def end_segment(self, success: np.ndarray, found_complete: np.ndarray) -> None:
        """Keep the successes of its streams, if that is asked for."""
        if self.ppo.self_imitation is not None:
            self.ppo.self_imitation.end_segment(found_complete[self.streams], self.ppo.num_updates)

    def update(self) -> dict[str, float]:
        """Learn from the buffer and clear it."""
        with self.stopwatch("update"):
            metrics = self.ppo.update(self.buffer)
            self.buffer.clear()
            return metrics

    def predict_values(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """The policy's values of beginning the tasks `tau` now; see `ValuingAgent`."""
        mine = tau[self.streams]
        with self.stopwatch("infer"):
            columns = self.history.followed_by(observation_columns(o_t), range(len(mine)))
            values = self._values(columns, mine)
        return self.ppo.processes.concatenate(values)

    def shared_tensors(self) -> Iterable[torch.Tensor]:
        """The policy's parameters and those beside it."""
        return trained_tensors(self.ppo.policy)

    def state_dict(self) -> dict[str, Any]:
        """The rollout that a budget's end left, the base policy, successes, updates; see `LearningAgent`."""
        ppo, kept = self.ppo, self.ppo.self_imitation
        base = {} if ppo.base_policy is None else ppo.base_policy.parameters
        return {
            "num_updates": ppo.num_updates,
            "config": {"policy_lr": ppo.config.policy_lr, "value_lr": ppo.config.value_lr},
            "base_policy": base,
            "adapter": {} if self._adapter is None else self._adapter.own_parameters(),
            "rollout": to_tensors(join_rollouts(self.buffer.state_dict(), ppo.processes)),
            "self_imitation": [] if kept is None else to_tensors(kept.state_dict()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, with the streams of this process."""
        self.ppo.num_updates = state["num_updates"]
        set_optimizer(self.ppo.optimizer, self.ppo.config, state["config"], self.ppo.optimizer_settings)
        if self.ppo.base_policy is not None:
            self.ppo.base_policy.load(state["base_policy"])
        if self._adapter is not None:
            self._adapter.load_own_parameters(state["adapter"])
        self.buffer.load_state_dict(to_arrays(state["rollout"]), self.streams)
        # A flag may have switched it on since: it then begins with nothing.
        if self.ppo.self_imitation is not None and state["self_imitation"]:
            self.ppo.self_imitation.load_state_dict(to_arrays(state["self_imitation"]))

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
            trace=to_array("trace", sample["trace"]),
            log_prob=sample["log_prob"].float().cpu().numpy(),
            value=sample["value"].float().cpu().numpy(),
        )

    def _begin(self, encoded: Columns, decision: Decision) -> None:
        """All streams have decided."""
        # The environment may write the next observation where this one lies.
        self._encoded = {name: col.copy() for name, col in encoded.items()} if self.num_steps > 1 else encoded
        self._decision = decision
        self._log_prob, self._value = decision.log_prob.reshape(len(decision.value), -1).sum(1), decision.value
        self.clock.begin(decision.actions)

    def _decide_anew(self, columns: Columns, tau: list[str]) -> None:
        """Streams whose decision ended too early decide on what they do until the others decide."""
        who = np.flatnonzero(self.clock.fresh)
        _, decision = self._decide({name: col[who] for name, col in columns.items()}, [tau[i] for i in who])
        # What is learned from keeps the numbers of the decision that was cut.
        self._log_prob, self._value = self._log_prob.copy(), self._value.copy()
        self._log_prob[who], self._value[who] = decision.log_prob.reshape(len(who), -1).sum(1), decision.value
        self.clock.begin_anew(decision.actions)

    @torch.inference_mode()
    def _values(self, columns: Columns, tau: list[str]) -> np.ndarray:
        encoded = self.ppo.processors.encode(columns, tau)
        batch = self.ppo.processors.encoded_batch(encoded, tau)
        return self.ppo.policy.predict_values(batch).float().cpu().numpy()
