"""Proximal policy optimisation (Schulman et al., 2017) of a TrainablePolicy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cronos_lerobot.agents.base import Columns
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.learning_rate import AdaptiveLR, target_kl
from cronos_lerobot.agents.ppo.losses import (
    BasePolicy,
    UpdateMetrics,
    approximate_kl,
    bounded_log_ratio,
    by_factor,
    clipped_objective,
    explained_variance,
    factor_weights,
    kl_to_base,
    value_error,
)
from cronos_lerobot.agents.ppo.rollout_buffer import Minibatch, RolloutBuffer
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.weights import check_precision
from cronos_lerobot.ranks import Ranks


@dataclass(frozen=True)
class Loss:
    """What a minibatch costs."""

    total: Tensor
    """Scalar, to be minimised."""
    means: dict[str, float]
    """For the log; to be averaged over minibatches."""
    maxima: dict[str, float] = field(default_factory=dict)
    """For the log; the largest of all minibatches counts."""
    kl: float | None = None
    """KL(old || new) of the policies [nats], if the policy is trained."""


PIECE_BYTES = 2**23
"""Observations that are backpropagated at once on a CPU. The mean over the pieces of a minibatch is that over the
minibatch; what convolutions make of 2048 pictures does not fit into a cache, and costs half as much again."""


class PPO:
    """Updates a policy from rollouts.

    Args:
        policy: a TrainablePolicy, already on its device. Its parameters in no group are frozen.
        processors: from stored observations to the policy's batches.
        config: see PPOConfig.
        rng: draws the order of the minibatches.
        ranks: each process learns from its own rollout, in minibatches of its own; they take every optimizer step
            together, with the mean of their gradients. Their rollouts have the same size.

    Raises:
        ValueError: there is nothing to train, or no critic.
    """

    def __init__(
        self,
        policy: Any,
        processors: PolicyProcessors,
        config: PPOConfig,
        rng: np.random.Generator,
        ranks: Ranks | None = None,
    ) -> None:
        self.policy = policy
        self.processors = processors
        self.config = config
        self.rng = rng
        self.ranks = ranks or Ranks()
        self.num_updates = 0
        lrs = {"policy": config.policy_lr, "value": config.value_lr}
        self._max_norms = {"policy": config.max_grad_norm, "value": config.value_max_grad_norm}
        self._params: dict[str, list[Tensor]] = {"policy": [], "value": []}
        groups = policy.rl_parameter_groups()
        for group in groups:
            group["lr"] = lrs[group["name"]]
            group["params"] = [p for p in group["params"] if p.requires_grad]
            self._params[group["name"]] += group["params"]
        for name, params in self._params.items():
            if not params:
                raise ValueError(
                    f"PPO has no {name} to train: all of it is frozen in {type(policy).__name__}, as adapters of "
                    "--peft.* leave what they do not name."
                )
        trained = self._params["policy"] + self._params["value"]
        check_precision(trained, getattr(policy, "config", None), config.type)
        _freeze_all_but(trained, policy)
        betas = (config.beta1, config.beta2)
        # Without `fused`, a small network's step on a CPU costs as much as a tenth of its backward pass.
        fused = True if processors.device.type == "cpu" else None
        self.optimizer = torch.optim.AdamW(groups, betas=betas, weight_decay=config.weight_decay, fused=fused)
        self.lr = AdaptiveLR(self.optimizer, config)
        self.base_policy = BasePolicy(policy, self._params["policy"]) if config.kl_base_coef else None

    def update(self, buffer: RolloutBuffer) -> dict[str, float]:
        """Learn from every decision in `buffer` that the policy's actions followed, and return metrics.

        The buffer's `advantages` and `returns` are filled in, the advantages normalised if the config says so;
        all else in it stays as it is.
        """
        config = self.config
        buffer.compute_advantages(config.gamma, config.gae_lambda)
        rollout = {name: self.ranks.concatenate(array, axis=1) for name, array in buffer.results().items()}
        own = ~rollout.pop("intervened")
        if self._num_own(buffer) == 0:
            return {"policy_epochs": 0.0, "policy_lr": self.policy_lr, "value_lr": config.value_lr}
        rollout = {name: array[own] for name, array in rollout.items()}
        described = _describe_rollout(rollout)
        if config.normalize_advantage:
            buffer.normalize_advantages(rollout["advantages"].mean(), rollout["advantages"].std())
        if self.target_kl is not None:
            described["target_kl"] = self.target_kl
        metrics = UpdateMetrics()
        warming_up = self.num_updates < config.value_warmup_updates
        epochs = 0 if warming_up else self._train_policy(buffer, metrics)
        self._train_value(buffer, metrics, max(config.value_epochs, config.epochs * warming_up))
        self.num_updates += 1
        described |= metrics.result(self.ranks)
        return described | {"policy_epochs": epochs, "policy_lr": self.policy_lr, "value_lr": config.value_lr}

    @property
    def target_kl(self) -> float | None:
        """The KL divergence [nats] that the next update aims at."""
        return target_kl(self.config, self.num_updates)

    @property
    def policy_lr(self) -> float:
        """The policy's learning rate now."""
        return self.lr.value

    def _train_policy(self, buffer: RolloutBuffer, metrics: UpdateMetrics) -> float:
        """Train policy and value together; returns the epochs that were run, fractions included."""
        config, steps = self.config, 0
        steps_per_epoch = -(-self._num_own(buffer) // (config.minibatch_size * config.grad_accumulation))
        seen: list[float] = []
        self.lr.begin_update(self.target_kl)
        for _ in range(config.epochs):
            seen = []
            for group in self._groups(buffer):
                # Before the first step the policy is still the old one: its KL is rounding.
                kl = self._accumulate(group, self._loss, metrics, self._kl_limit if steps else math.inf)
                if steps and kl > self._kl_limit:
                    self.lr.stopped_early()
                    return steps / steps_per_epoch
                if steps:
                    seen.append(kl)
                    self.lr.see("kl_step", kl)
                norms = self._optimizer_step(metrics)
                self.lr.after_step(norms["policy"])
                steps += 1
        self.lr.see("kl_update", float(np.mean(seen)) if seen else None)
        self.lr.end_update()
        return float(config.epochs)

    def _train_value(self, buffer: RolloutBuffer, metrics: UpdateMetrics, epochs: int) -> None:
        """Train the value alone, on what the policy's layers, which stay as they are, make of the observations."""
        value_inputs = getattr(self.policy, "value_inputs", None)
        inputs = None
        if epochs and value_inputs is not None:
            inputs = buffer.map_observations(self.config.minibatch_size, self.processors.making(value_inputs))

        def loss_of(minibatch: Minibatch) -> Loss:
            columns, texts = minibatch.observation, minibatch.instructions
            make = self.processors.encoded_batch if inputs is None else self.processors.made_batch
            value = self.policy.predict_values(make(columns, texts))
            error = self._value_error(value, minibatch)
            return Loss(self.config.value_coef * error, {"value_epochs_loss": error.item()})

        with _frozen(self._params["policy"]):
            for _ in range(epochs):
                for group in self._groups(buffer, inputs):
                    self._accumulate(group, loss_of, metrics)
                    self._optimizer_step(metrics)

    def _groups(self, buffer: RolloutBuffer, observations: Columns | None = None) -> Iterator[list[Minibatch]]:
        """What is backpropagated for each optimizer step of one epoch: its minibatches, or pieces of them."""
        limit = self._num_own(buffer)
        minibatches = buffer.minibatches(self.config.minibatch_size, self.rng, observations, limit)
        on_cpu = self.processors.device.type == "cpu"
        while group := list(itertools.islice(minibatches, self.config.grad_accumulation)):
            yield [piece for minibatch in group for piece in minibatch.split(PIECE_BYTES)] if on_cpu else group

    def _num_own(self, buffer: RolloutBuffer) -> int:
        """Decisions that every process learns from: as many in all, or they would not step together."""
        return int(self.ranks.concatenate(np.array([buffer.num_own])).min())

    def _accumulate(
        self,
        group: list[Minibatch],
        loss_of: Callable[[Minibatch], Loss],
        metrics: UpdateMetrics,
        kl_limit: float = math.inf,
    ) -> float:
        """Backpropagate the mean loss over a group of minibatches.

        Returns the KL divergence over the minibatches of all processes. None is negative, so the sum may exceed
        `kl_limit` after the first ones: it stops there, without gradients.
        """
        self.optimizer.zero_grad(set_to_none=True)
        size = sum(len(minibatch.indices) for minibatch in group)
        kl = 0.0
        for minibatch in group:
            weight = len(minibatch.indices) / size
            loss = loss_of(minibatch)
            metrics.add_means(loss.means, len(minibatch.indices))
            metrics.add_maxima(loss.maxima)
            if loss.kl is not None:
                kl += weight * float(self.ranks.concatenate(np.array([loss.kl])).mean())
            if kl > kl_limit:
                self.optimizer.zero_grad(set_to_none=True)
                return kl
            if not torch.isfinite(loss.total):
                raise FloatingPointError(
                    f"The loss of update {self.num_updates} is {loss.total.item()}: {loss.means}."
                )
            (loss.total * weight).backward()
        return kl

    def _loss(self, minibatch: Minibatch) -> Loss:
        config = self.config
        batch = self.processors.encoded_batch(minibatch.observation, minibatch.instructions)
        trace, old_log_prob = self._tensor(minibatch.trace), self._tensor(minibatch.log_prob)
        new = self.policy.evaluate_actions(batch, trace, temperature=config.temperature)
        new_log_prob, old_log_prob = (by_factor(x, config.ratio) for x in (new["log_prob"], old_log_prob))
        log_ratio = bounded_log_ratio(new_log_prob, old_log_prob)
        advantage = self._tensor(minibatch.advantage)[:, None]
        weights = factor_weights(log_ratio, config.denoising_discount)
        policy_loss = -(weights * clipped_objective(log_ratio, advantage, config.clip)).sum(1).mean()
        value_loss = self._value_error(new["value"], minibatch)
        total = policy_loss + config.value_coef * value_loss
        ratio = log_ratio.detach().exp()
        # Factors are drawn one after the other: the divergences of all add up to the decision's.
        kl = approximate_kl(log_ratio.detach()).sum(1).mean().item()
        means = {
            "policy_loss": policy_loss.item(),
            "value_loss": value_loss.item(),
            "approx_kl": kl,
            "clip_fraction": ((ratio - 1).abs() > config.clip).float().mean().item(),
        }
        if new["entropy"] is not None:
            entropy = new["entropy"].mean()
            total = total - config.entropy_coef * entropy
            means["entropy"] = entropy.item()
        elif config.entropy_coef:
            raise ValueError(
                f"algorithm.entropy_coef={config.entropy_coef}, but the policy's entropy is not known."
            )
        if self.base_policy is not None:
            base_log_prob = by_factor(self.base_policy.log_prob(batch, trace, config.temperature), config.ratio)
            base_kl = kl_to_base(new_log_prob, old_log_prob, base_log_prob).sum(1).mean()
            total = total + config.kl_base_coef * base_kl
            means["base_kl"] = base_kl.item()
        return Loss(total, means, {"ratio_max": ratio.max().item()}, kl)

    def _value_error(self, value: Tensor, minibatch: Minibatch) -> Tensor:
        old_value, return_ = self._tensor(minibatch.value), self._tensor(minibatch.return_)
        return value_error(value, old_value, return_, self.config).mean()

    def _optimizer_step(self, metrics: UpdateMetrics) -> dict[str, float]:
        """Step along the mean gradient of all processes; returns its norm in each group that has one."""
        self.ranks.average_gradients(self._params["policy"] + self._params["value"])
        norms = {}
        for name, params in self._params.items():
            if any(param.grad is not None for param in params):
                norms[name] = torch.nn.utils.clip_grad_norm_(params, self._max_norms[name]).item()
        metrics.add_means({f"{name}_grad_norm": norm for name, norm in norms.items()})
        self.optimizer.step()
        return norms

    @property
    def _kl_limit(self) -> float:
        """The KL divergence beyond which the policy's training in an update stops."""
        target, factor = self.target_kl, self.config.kl_stop_factor
        return math.inf if target is None or factor is None else factor * target

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.processors.device)


def _describe_rollout(rollout: Columns) -> dict[str, float]:
    return {
        "reward_mean": float(rollout["rewards"].mean()),
        "explained_variance": explained_variance(rollout["values"], rollout["returns"]),
        "value_mean": float(rollout["values"].mean()),
        "return_mean": float(rollout["returns"].mean()),
        "advantage_std": float(rollout["advantages"].std()),
    }


def _freeze_all_but(params: Sequence[Tensor], policy: torch.nn.Module) -> None:
    trained = {id(param) for param in params}
    for param in policy.parameters():
        if id(param) not in trained:
            param.requires_grad_(False)


@contextmanager
def _frozen(params: list[Tensor]) -> Generator[None]:
    """No gradient reaches `params` inside, so the optimizer leaves them alone."""
    for param in params:
        param.requires_grad_(False)
    try:
        yield
    finally:
        for param in params:
            param.requires_grad_(True)
