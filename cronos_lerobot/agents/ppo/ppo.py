"""Proximal policy optimisation (Schulman et al., 2017) of a TrainablePolicy."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from cronos_lerobot.agents.base import Columns, check_trainable
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.rollout_buffer import Minibatch, RolloutBuffer
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.processes import Processes


def clipped_objective(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """min(r A, clip(r, 1 - eps, 1 + eps) A), (B,), to be maximised; r = exp(log_ratio)."""
    ratio = log_ratio.exp()
    return torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)


def approximate_kl(log_ratio: Tensor) -> Tensor:
    """KL(old || new) from samples of old, (B,): (r - 1) - log r, unbiased and never negative [nats]."""
    return log_ratio.exp() - 1 - log_ratio


def value_error(value: Tensor, old_value: Tensor, return_: Tensor, config: PPOConfig) -> Tensor:
    """Loss of each value, (B,): Huber or half squared error, the worse of clipped and unclipped if clipping."""

    def loss(prediction: Tensor) -> Tensor:
        if config.value_loss == "huber":
            return huber_loss(prediction, return_, reduction="none", delta=config.huber_delta)
        return 0.5 * (prediction - return_).square()

    if config.value_clip is None:
        return loss(value)
    clipped = old_value + (value - old_value).clamp(-config.value_clip, config.value_clip)
    return torch.maximum(loss(value), loss(clipped))


def adapted_lr(lr: float, kl: float, config: PPOConfig) -> float:
    """Return a smaller learning rate if `kl` is above twice the target, a larger one if below half of it."""
    assert config.target_kl is not None
    if kl > 2 * config.target_kl:
        return max(lr / config.lr_factor, config.policy_lr_min)
    if kl < config.target_kl / 2:
        return min(lr * config.lr_factor, config.policy_lr_max)
    return lr


def explained_variance(values: np.ndarray, returns: np.ndarray) -> float:
    """Return 1 - Var[R - V] / Var[R]: 1 is a perfect critic, 0 one that knows the mean only."""
    variance = float(np.var(returns))
    return float("nan") if variance == 0 else 1 - float(np.var(returns - values)) / variance


class _Means:
    """Means and maxima of metrics over minibatches, weighted by their size."""

    def __init__(self) -> None:
        self.sums: dict[str, float] = {}
        self.weights: dict[str, float] = {}

    def add(self, metrics: dict[str, float], weight: float = 1.0) -> None:
        for name, value in metrics.items():
            if name.endswith("_max"):
                self.sums[name] = max(value, self.sums.get(name, value))
                self.weights[name] = 1.0
            else:
                self.sums[name] = self.sums.get(name, 0.0) + value * weight
                self.weights[name] = self.weights.get(name, 0.0) + weight

    def result(self) -> dict[str, float]:
        return {name: total / self.weights[name] for name, total in self.sums.items()}

    def result_of_all(self, processes: Processes) -> dict[str, float]:
        together = _Means()
        for result in processes.gather(self.result()):
            together.add(result)
        return together.result()


class PPO:
    """Updates a policy from rollouts.

    Args:
        policy: a TrainablePolicy, already on its device.
        processors: from stored observations to the policy's batches.
        config: see PPOConfig.
        rng: draws the order of the minibatches.
        processes: each learns from its own rollout, in minibatches of its own; they take every optimizer step
            together, with the mean of their gradients. Their rollouts have the same size.

    Raises:
        TypeError: the policy is not trainable.
    """

    def __init__(
        self,
        policy: Any,
        processors: PolicyProcessors,
        config: PPOConfig,
        rng: np.random.Generator,
        processes: Processes | None = None,
    ) -> None:
        check_trainable(policy)
        self.policy = policy
        self.processors = processors
        self.config = config
        self.rng = rng
        self.processes = processes or Processes()
        self.num_updates = 0
        lrs = {"policy": config.policy_lr, "value": config.value_lr}
        self._params: dict[str, list[Tensor]] = {"policy": [], "value": []}
        groups = policy.rl_parameter_groups()
        for group in groups:
            if group["name"] not in lrs:
                raise ValueError(f"Parameter groups are named {sorted(lrs)}, got {group['name']!r}.")
            group["lr"] = lrs[group["name"]]
            group["params"] = [p for p in group["params"] if p.requires_grad]
            self._params[group["name"]] += group["params"]
        betas = (config.beta1, config.beta2)
        self.optimizer = torch.optim.AdamW(groups, betas=betas, weight_decay=config.weight_decay)
        self.base_policy = _frozen_copy(policy) if config.kl_base_coef else None

    def update(self, buffer: RolloutBuffer) -> dict[str, float]:
        """Learn from every transition in `buffer`, which is left as it is, and return metrics."""
        config = self.config
        buffer.compute_advantages(config.gamma, config.gae_lambda)
        rollout = {name: self.processes.concatenate(array, axis=1) for name, array in buffer.results().items()}
        metrics = _describe_rollout(rollout)
        if config.normalize_advantage:
            buffer.normalize_advantages(rollout["advantages"].mean(), rollout["advantages"].std())
        means = _Means()
        warming_up = self.num_updates < config.value_warmup_updates
        epochs = 0 if warming_up else self._train_policy(buffer, means)
        for _ in range(max(config.value_epochs, config.epochs) if warming_up else config.value_epochs):
            self._value_epoch(buffer, means)
        self.num_updates += 1
        metrics |= means.result_of_all(self.processes) | {"policy_epochs": epochs, "policy_lr": self.policy_lr}
        return metrics | {"value_lr": self._group("value")["lr"]}

    @property
    def policy_lr(self) -> float:
        """The policy's learning rate now."""
        return self._group("policy")["lr"]

    @policy_lr.setter
    def policy_lr(self, lr: float) -> None:
        for group in self.optimizer.param_groups:
            if group["name"] == "policy":
                group["lr"] = lr

    def _train_policy(self, buffer: RolloutBuffer, means: _Means) -> float:
        """Train policy and value together; returns the epochs that were run, fractions included."""
        config, steps = self.config, 0
        num_minibatches = -(-len(buffer) // config.minibatch_size)
        steps_per_epoch = -(-num_minibatches // config.grad_accumulation)
        epoch_kl = _Means()
        for epoch in range(config.epochs):
            epoch_kl = _Means()
            for group in _batched(buffer.minibatches(config.minibatch_size, self.rng), config.grad_accumulation):
                kl = self._accumulate_gradients(group, means)
                epoch_kl.add({"kl": kl})
                if self._should_stop(kl):
                    self._adapt_lr("kl_step", kl)
                    self._adapt_lr("kl_update", kl)
                    return epoch + (steps - epoch * steps_per_epoch) / steps_per_epoch
                # Before the first step the policy is still the old one and its KL says nothing.
                if steps > 0:
                    self._adapt_lr("kl_step", kl)
                self._optimizer_step(means)
                steps += 1
        self._adapt_lr("kl_update", epoch_kl.result()["kl"])
        return float(config.epochs)

    def _accumulate_gradients(self, group: list[Minibatch], means: _Means) -> float:
        """Backpropagate the mean loss over a group of minibatches; returns the KL divergence of all processes'."""
        self.optimizer.zero_grad(set_to_none=True)
        size = sum(len(minibatch.indices) for minibatch in group)
        kl = 0.0
        for minibatch in group:
            weight = len(minibatch.indices) / size
            loss, metrics = self._loss(minibatch)
            if not torch.isfinite(loss):
                raise FloatingPointError(f"The loss of update {self.num_updates} is {loss.item()}: {metrics}.")
            (loss * weight).backward()
            means.add(metrics, len(minibatch.indices))
            kl += metrics["approx_kl"] * weight
        return float(self.processes.concatenate(np.array([kl])).mean())

    def _loss(self, minibatch: Minibatch) -> tuple[Tensor, dict[str, float]]:
        config = self.config
        batch = self.processors.encoded_batch(minibatch.observation, minibatch.instructions)
        tokens = self._tensor(minibatch.tokens)
        advantage = self._tensor(minibatch.advantage)
        new = self.policy.evaluate_actions(batch, tokens, temperature=config.temperature)
        log_ratio = new["log_prob"] - self._tensor(minibatch.log_prob)
        policy_loss = -clipped_objective(log_ratio, advantage, config.clip).mean()
        value_loss = value_error(
            new["value"], self._tensor(minibatch.value), self._tensor(minibatch.return_), config
        ).mean()
        entropy = new["entropy"].mean()
        loss = policy_loss + config.value_coef * value_loss - config.entropy_coef * entropy
        ratio = log_ratio.detach().exp()
        metrics = {
            "policy_loss": policy_loss.item(),
            "value_loss": value_loss.item(),
            "entropy": entropy.item(),
            "approx_kl": approximate_kl(log_ratio.detach()).mean().item(),
            "clip_fraction": ((ratio - 1).abs() > config.clip).float().mean().item(),
            "ratio_max": ratio.max().item(),
        }
        if self.base_policy is not None:
            with torch.no_grad():
                base = self.base_policy.evaluate_actions(batch, tokens, temperature=config.temperature)
            base_kl = approximate_kl(base["log_prob"] - new["log_prob"]).mean()
            loss = loss + config.kl_base_coef * base_kl
            metrics["base_kl"] = base_kl.item()
        return loss, metrics

    def _value_epoch(self, buffer: RolloutBuffer, means: _Means) -> None:
        config = self.config
        with _frozen(self._params["policy"]):
            for group in _batched(buffer.minibatches(config.minibatch_size, self.rng), config.grad_accumulation):
                self.optimizer.zero_grad(set_to_none=True)
                size = sum(len(minibatch.indices) for minibatch in group)
                for minibatch in group:
                    batch = self.processors.encoded_batch(minibatch.observation, minibatch.instructions)
                    old_value, return_ = self._tensor(minibatch.value), self._tensor(minibatch.return_)
                    error = value_error(self.policy.predict_values(batch), old_value, return_, config)
                    (error.sum() / size).backward()
                    means.add({"value_epochs_loss": error.mean().item()}, len(minibatch.indices))
                self._optimizer_step(means, "value_grad_norm")

    def _optimizer_step(self, means: _Means, norm_name: str = "grad_norm") -> None:
        params = self._params["policy"] + self._params["value"]
        self.processes.average_gradients(params)
        norm = torch.nn.utils.clip_grad_norm_(params, self.config.max_grad_norm)
        means.add({norm_name: norm.item()})
        self.optimizer.step()

    def _adapt_lr(self, when: str, kl: float) -> None:
        if self.config.lr_schedule == when:
            self.policy_lr = adapted_lr(self.policy_lr, kl, self.config)

    def _should_stop(self, kl: float) -> bool:
        target, factor = self.config.target_kl, self.config.kl_stop_factor
        return target is not None and factor is not None and kl > factor * target

    def _group(self, name: str) -> dict[str, Any]:
        return next(group for group in self.optimizer.param_groups if group["name"] == name)

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


def _batched(minibatches: Iterator[Minibatch], size: int) -> Iterator[list[Minibatch]]:
    while group := list(itertools.islice(minibatches, size)):
        yield group


def _frozen_copy(policy: Any) -> Any:
    base = copy.deepcopy(policy)
    base.requires_grad_(False)
    return base.eval()


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
