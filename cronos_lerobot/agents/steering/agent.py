"""The agent that steers: it decides on noises, remembers all decisions, and learns from them off policy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cronos_lerobot.agents.adapters.registry import make_steerable
from cronos_lerobot.agents.base import ActionSample, Columns, LearningAgent, decision_steps
from cronos_lerobot.agents.decisions import DecisionClock
from cronos_lerobot.agents.history import ObservationHistory, observation_steps
from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.agents.registry import AgentContext, register_agent
from cronos_lerobot.agents.state import map_leaves, to_arrays, to_tensors
from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.agents.steering.observation import feature_width, resolve_observation
from cronos_lerobot.agents.steering.replay import ReplayMemory
from cronos_lerobot.agents.steering.sac import SAC
from cronos_lerobot.agents.steering.steered import SteeredPolicy, SteeringShape


@register_agent("steering")
class SteeringAgent(LearningAgent):
    """Acts on noise that its actor chooses; the policy stays as it is.

    Until there are decisions enough to learn from, it acts on the policy's own noise, and is evaluated and saved
    as the policy alone. When streams decide, and what is learned from: see `DecisionClock`. No decision is the
    end of anything: what follows it counts, by the critics' word, in a task's last one as well.

    Args:
        context: of the run; its config is a SteeringConfig.

    Raises:
        ValueError: the policy's noise cannot be chosen, or it decides beyond a task switch.
    """

    # It learns which noise to choose, and what an expert does was made of none.
    learns_beside_expert = False

    def __init__(self, context: AgentContext) -> None:
        self.config: SteeringConfig = context.config
        self.policy = context.policy.eval().requires_grad_(False)
        self._processors, self._processes = context.processors, context.processes
        self._stopwatch, self._streams = context.stopwatch, context.streams
        self._rng, self._generator = context.rng("minibatches"), context.torch_rng("actions")
        steerable = make_steerable(self.policy).eval().requires_grad_(False)
        self.clock = DecisionClock(decision_steps(steerable, context.task_switch_interval))
        self.history = ObservationHistory(observation_steps(steerable))
        observation = resolve_observation(self.config.observation, self.policy.config)
        shape = SteeringShape(
            features=feature_width(observation, steerable, self._processors),
            observation=observation,
            noise_magnitude=self.config.noise_magnitude,
            noise_repeat=self.config.noise_repeat,
            hidden_width=self.config.hidden_width,
        )
        # An evaluation leaves it in the mode that it found, and with it the policy.
        self.steered = SteeredPolicy(steerable, shape).eval()
        device = self._processors.device
        self.sac = SAC(
            self.config, self.steered.actor, self.steered.whitening, shape.features, self.steered.dims, device,
            context.torch_rng("critics"), self._processes,
        )  # fmt: skip
        self._processes.copy_from_main(self.sac.trained())
        self.optimizer = self.sac.optimizers
        self.memory = ReplayMemory(-(-self.config.memory_size // self._processes.count))
        self.num_steps = 0
        self._new = 0
        self._seen: Columns = {}
        self._waiting: Columns = {}

    @property
    def acting(self) -> Any:
        """The policy, steered once anything was learned."""
        return self.steered if self.num_steps else self.policy

    def save_pretrained(self, folder: Path) -> None:
        """Save the policy as LeRobot does, and the actor beside it."""
        super().save_pretrained(folder)
        if self.num_steps:
            self.steered.save_pretrained(folder)

    @torch.inference_mode()
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """The next action of each of its streams; a decision where none is left."""
        tau = tau[self._streams]
        with self._stopwatch("infer"):
            self._seen = self.history.see(observation_columns(o_t), range(len(tau)))
            if self.clock.step == 0:
                self._begin(self._seen, tau)
            elif self.clock.fresh.any():
                who = np.flatnonzero(self.clock.fresh)
                columns = {name: col[who] for name, col in self._seen.items()}
                self._decide_anew(columns, [tau[i] for i in who], who)
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
        """Take in one control step; with its last one a decision is remembered.

        Where the trace is cut, `o_tp1` follows it, or `o_t` if there is no outcome.
        """
        mine, is_first = self._streams, self.clock.step == 0
        tau, cut_t = tau[mine], cut_t[mine]
        is_over = self.clock.store(
            r_t[mine], cut_t, diverged_t[mine], self.config.gamma,
            before=lambda: self._features if is_first else self._observe(self._seen, tau),
            after=lambda: self._observe(
                self.history.followed_by(observation_columns(o_tp1), range(len(tau))), tau
            ),
        )  # fmt: skip
        self.history.begin(np.flatnonzero(cut_t))
        if is_over:
            self._waiting = {
                "features": self._features,
                "choice": self._choice,
                "reward": self.clock.reward,
                "discount": self.config.gamma**self.clock.duration,
                "next_features": self.clock.following,
            }
            if self.clock.cut.all():
                self._remember(self._features)

    def update(self) -> dict[str, float]:
        """Take the optimizer steps that the decisions since the last update are worth."""
        assert not self._waiting
        new, self._new = self._new * self._processes.count, 0
        metrics = {"decisions": float(len(self.memory) * self._processes.count), "optimizer_steps": 0.0}
        if metrics["decisions"] < min(self.config.warmup_decisions, self.config.memory_size):
            return metrics
        with self._stopwatch("update"):
            if not self.num_steps:
                moments = self._processes.concatenate(self.memory.moments()[None]).mean(0)
                self.steered.whitening.fit(*torch.from_numpy(moments).to(self._processors.device))
            steps = max(1, round(self.config.utd * new))
            done = [self.sac.step(self.memory.draw(self.config.batch_size, self._rng)) for _ in range(steps)]
        self.num_steps += steps
        means = np.array([[np.mean([step[name] for step in done]) for name in done[0]]])
        means = self._processes.concatenate(means).mean(0)
        metrics |= dict(zip(done[0], means.tolist(), strict=True))
        return metrics | {"alpha": float(self.sac.log_alpha.detach().exp()), "optimizer_steps": float(steps)}

    @torch.inference_mode()
    def predict_values(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """The critics' word on the actor's likeliest choices, 0 until they have learned; see `ValuingAgent`."""
        mine = tau[self._streams]
        values = np.zeros(len(mine), np.float32)
        if self.num_steps:
            columns = self.history.followed_by(observation_columns(o_t), range(len(mine)))
            features = torch.from_numpy(self._observe(columns, mine)).to(self._processors.device)
            # The mean needs no draw, and those of other generators must not depend on who asks for values.
            unused = torch.Generator(self._processors.device)
            choice, _ = self.steered.actor(self.steered.whitening(features), 0.0, unused)
            values = self.sac.value(features, choice).float().cpu().numpy()
        return self._processes.concatenate(values)

    def shared_tensors(self) -> Iterable[Tensor]:
        """All that is learned."""
        return self.sac.trained()

    def state_dict(self) -> dict[str, Any]:
        """Actor, critics and the memory; see `LearningAgent`."""
        memory = map_leaves(self.memory.state_dict(), np.ndarray, self._processes.collect)
        return {
            "num_steps": self.num_steps,
            "new": self._new * self._processes.count,
            "sac": self.sac.state_dict(),
            "memory": to_tensors(memory),
            "gamma": self.config.gamma,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, with this process's share of the memory.

        Raises:
            ValueError: what is remembered was discounted otherwise.
        """
        if (gamma := state.get("gamma", self.config.gamma)) != self.config.gamma:
            raise ValueError(
                f"--algorithm.gamma={self.config.gamma}: the decisions that the run remembers are discounted by "
                f"{gamma}; leave it, or begin a new run."
            )
        self.num_steps = state["num_steps"]
        self._new = state.get("new", 0) // self._processes.count
        self.sac.load_state_dict(state["sac"])
        memory = to_arrays(state["memory"])
        share = len(memory.get("reward", ())) // self._processes.count
        mine = slice(self._processes.rank * share, (self._processes.rank + 1) * share)
        self.memory.load_state_dict({name: column[mine] for name, column in memory.items()})

    def _begin(self, columns: Columns, tau: list[str]) -> None:
        """All streams decide; where a decision went on until here, this is what follows it."""
        actions, features, choice, log_prob = self._decide(columns, tau)
        self._log_prob, self._value = log_prob.cpu().numpy(), self._worth(features, choice)
        self._features, self._choice = features.cpu().numpy(), choice.cpu().numpy()
        if self._waiting:
            self._remember(self._features)
        self.clock.begin(actions, self._features.shape[1:])

    def _decide_anew(self, columns: Columns, tau: list[str], who: np.ndarray) -> None:
        """Streams `who`, whose decision ended too early, decide on what they do until the others decide."""
        actions, features, choice, log_prob = self._decide(columns, tau)
        # Copies: steps that are being recorded hold the former ones.
        self._log_prob, self._value = self._log_prob.copy(), self._value.copy()
        self._log_prob[who], self._value[who] = log_prob.cpu().numpy(), self._worth(features, choice)
        self.clock.begin_anew(actions)

    def _worth(self, features: Tensor, choice: Tensor) -> np.ndarray:
        """The critics' word on choices, 0 until they have learned."""
        if not self.num_steps:
            return np.zeros(len(features), np.float32)
        return self.sac.value(features, choice).cpu().numpy()

    def _decide(self, columns: Columns, tau: list[str]) -> tuple[np.ndarray, Tensor, Tensor, Tensor]:
        """Actions (k, n, A) in physical units; of the decision features, choice and its log-density."""
        context, features = self.steered.observe(self._processors.batch(columns, tau))
        if self.num_steps:
            whitened = self.steered.whitening(features)
            choice, log_prob = self.steered.actor(whitened, generator=self._generator)
        else:
            choice = self.steered.prior(len(features), self._generator)
            log_prob = features.new_zeros(len(features))
        actions = self.steered.denoise(context, choice)
        physical = self._processors.physical_actions(actions.flatten(0, 1)).reshape(actions.shape)
        return physical, features, choice, log_prob

    @torch.inference_mode()
    def _observe(self, columns: Columns, tau: list[str]) -> np.ndarray:
        return self.steered.observe(self._processors.batch(columns, tau))[1].cpu().numpy()

    def _remember(self, next_features: np.ndarray) -> None:
        """Remember the decisions that are over; where they were not cut, `next_features` (N, F) follow."""
        waiting, self._waiting = self._waiting, {}
        cut = self.clock.cut[:, None]
        waiting["next_features"] = np.where(cut, waiting["next_features"], next_features)
        self.memory.add(**waiting)
        self._new += len(cut)
