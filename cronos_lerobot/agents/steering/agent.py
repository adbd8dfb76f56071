"""The agent that steers: it decides on noises, remembers all decisions, and learns from them off policy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cronos_lerobot.agents.adapters.registry import make_steerable
from cronos_lerobot.agents.base import Columns, decision_steps
from cronos_lerobot.agents.decisions import DecidingAgent, Decision
from cronos_lerobot.agents.registry import AgentContext, register_agent
from cronos_lerobot.agents.state import map_leaves
from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.agents.steering.replay import ReplayMemory
from cronos_lerobot.agents.steering.sac import SAC
from cronos_lerobot.agents.steering.steered import (
    SteeredPolicy,
    SteeringShape,
    feature_width,
    resolve_observation,
)


@register_agent("steering")
class SteeringAgent(DecidingAgent):
    """Acts on noise that its actor chooses; the policy stays as it is.

    Until there are decisions enough to learn from, it acts on the policy's own noise, and is evaluated and saved
    as the policy alone. No decision ends anything: what follows a task's last one counts as well,
    by the critics' word.

    Args:
        context: of the run; its config is a SteeringConfig.

    Raises:
        ValueError: the policy's noise cannot be chosen, or it decides beyond a task switch.
    """

    def __init__(self, context: AgentContext) -> None:
        self.config: SteeringConfig = context.config
        self.policy = context.policy.eval().requires_grad_(False)
        steerable = make_steerable(self.policy).eval().requires_grad_(False)
        super().__init__(steerable, self.config.gamma, context.streams, context.stopwatch)
        decision_steps(steerable, context.task_switch_interval)
        self._processors, self._ranks = context.processors, context.ranks
        self._rng, self._generator = context.rng("minibatches"), context.torch_rng("actions")
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
            context.torch_rng("critics"), self._ranks,
        )  # fmt: skip
        self._ranks.copy_from_main(self.sac.trained())
        self.optimizer = self.sac.optimizers
        self.memory = ReplayMemory(-(-self.config.memory_size // self._ranks.count))
        self.num_steps = 0
        self._new = 0
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

    def decide(self, columns: Columns, tau: list[str]) -> Decision:
        """See `DecidingAgent`; its trace is the choice, its inputs the features."""
        context, features = self.steered.observe(self._processors.batch(columns, tau))
        value = np.zeros(len(features), np.float32)
        if self.num_steps:
            whitened = self.steered.whitening(features)
            choice, log_prob = self.steered.actor(whitened, generator=self._generator)
            value = self.sac.value(features, choice).cpu().numpy()
        else:
            choice = self.steered.prior(len(features), self._generator)
            log_prob = features.new_zeros(len(features))
        actions = self.steered.denoise(context, choice)
        return Decision(
            actions=self._processors.physical_actions(actions.flatten(0, 1)).reshape(actions.shape),
            trace=choice.cpu().numpy(),
            log_prob=log_prob.cpu().numpy(),
            value=value,
            inputs={"features": features.cpu().numpy()},
        )

    @torch.inference_mode()
    def look(self, columns: Columns, tau: list[str]) -> np.ndarray:
        """The features (k, F)."""
        return self.steered.observe(self._processors.batch(columns, tau))[1].cpu().numpy()

    def seen(self, decision: Decision) -> np.ndarray:
        """See `DecidingAgent`."""
        return decision.inputs["features"]

    def begin(self, decision: Decision) -> None:
        """Where a decision went on until here, this is what follows it."""
        if self._waiting:
            self._remember(self.seen(decision))

    def keep(self, decision: Decision, tau: list[str]) -> None:
        """See `DecidingAgent`."""
        self._waiting = {
            "features": self.seen(decision),
            "choice": decision.trace,
            "reward": self.clock.reward,
            "discount": self.gamma**self.clock.duration,
            "next_features": self.clock.following,
        }
        if self.clock.cut.all():
            self._remember(self.seen(decision))

    def update(self) -> dict[str, float]:
        """Take the optimizer steps that the decisions since the last update are worth."""
        assert not self._waiting
        counts = self._ranks.concatenate(np.array([[self._new, len(self.memory)]])).sum(axis=0)
        new, self._new = int(counts[0]), 0
        metrics = {"decisions": float(counts[1]), "optimizer_steps": 0.0}
        if metrics["decisions"] < min(self.config.warmup_decisions, self.config.memory_size):
            return metrics
        with self.stopwatch("update"):
            if not self.num_steps:
                moments = self._ranks.concatenate(self.memory.moments()[None]).mean(0)
                self.steered.whitening.fit(*torch.from_numpy(moments).to(self._processors.device))
            steps = max(1, round(self.config.utd * new))
            done = [self.sac.step(self.memory.draw(self.config.batch_size, self._rng)) for _ in range(steps)]
        self.num_steps += steps
        means = np.array([[np.mean([step[name] for step in done]) for name in done[0]]])
        means = self._ranks.concatenate(means).mean(0)
        metrics |= dict(zip(done[0], means.tolist(), strict=True))
        return metrics | {"alpha": float(self.sac.log_alpha.detach().exp()), "optimizer_steps": float(steps)}

    def shared_tensors(self) -> Iterable[Tensor]:
        """All that is learned."""
        return self.sac.trained()

    def state_dict(self) -> dict[str, Any]:
        """Actor, critics and the memory; see `LearningAgent`."""
        return {
            "num_steps": self.num_steps,
            "new": self._new * self._ranks.count,
            "sac": self.sac.state_dict(),
            "memory": map_leaves(self.memory.state_dict(), np.ndarray, self._ranks.collect),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`, with this process's share of the memory."""
        self.num_steps = state["num_steps"]
        self._new = state["new"] // self._ranks.count
        self.sac.load_state_dict(state["sac"])
        memory = state["memory"]
        share = len(memory.get("reward", ())) // self._ranks.count
        mine = slice(self._ranks.rank * share, (self._ranks.rank + 1) * share)
        self.memory.load_state_dict({name: column[mine] for name, column in memory.items()})

    def _remember(self, next_features: np.ndarray) -> None:
        """Remember the decisions that are over; where they were not cut, `next_features` (N, F) follow."""
        waiting, self._waiting = self._waiting, {}
        cut = self.clock.cut[:, None]
        waiting["next_features"] = np.where(cut, waiting["next_features"], next_features)
        own = ~self.clock.intervened
        self.memory.add(**{name: column[own] for name, column in waiting.items()})
        self._new += int(own.sum())
