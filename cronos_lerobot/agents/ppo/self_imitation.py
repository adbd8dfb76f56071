"""Successes of the streams that are cloned beside PPO's loss, and demonstrations against forgetting them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cronos_lerobot.agents.base import Columns
from cronos_lerobot.agents.imitation.batches import Demonstrations, draw_batch
from cronos_lerobot.agents.imitation.memory import OpenSegments, Segment, SegmentMemory, own_share
from cronos_lerobot.agents.imitation.weights import Remembered, by_task
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.processes import Processes


class SelfImitation:
    """Remembers the segments that succeeded, and adds the gradient of cloning them to PPO's.

    A segment that was found complete is not remembered: nothing had to be done. Instructions are drawn equally
    often, so that the easy ones do not crowd out the others; the frames of one instruction uniformly. Segments go
    `max_age` updates after they were over, since a better policy has better ones.

    The loss is the policy's own `forward`, in `eval()` mode as all of PPO: what is cloned is what acts (ACT's
    latent is 0), and dropout does not part the ratio from 1.

    Args:
        policy: the LeRobot policy, without an adapter.
        processors: the policy's.
        config: see PPOConfig; its `self_imitation.coef` is above 0.
        num_streams: N of this process.
        rng: draws what is cloned.
        processes: each clones the successes of its own streams, by weights of all of them.
        shapes: of what the run observes.

    Raises:
        ValueError: the policy has no loss that `lerobot-train` trains it with, or the demonstrations lack what it
            reads.
    """

    def __init__(
        self,
        policy: Any,
        processors: PolicyProcessors,
        config: PPOConfig,
        num_streams: int,
        rng: np.random.Generator,
        processes: Processes | None = None,
        shapes: Mapping[str, tuple[int, ...]] | None = None,
    ) -> None:
        self._policy, self._processors, self._rng = policy, processors, rng
        self._processes = processes or Processes()
        self.config = config.self_imitation
        self._demos_share = config.demos_share
        self._cloned = _parameters_of_forward(policy)
        self._open = OpenSegments(num_streams, kept=config.demos_share < 1)
        drop_last = getattr(policy.config, "drop_n_last_frames", 0) or 0
        self.memory = SegmentMemory(int(self.config.memory_gib * 2**30), drop_last)
        self._weights: np.ndarray | None = None
        self._share = 1.0
        self._demos = None
        if config.demos_share:
            self._demos = Demonstrations(config.demos, policy.config, shapes if config.demos_share < 1 else None)

    def check(self, trained: Sequence[Tensor]) -> None:
        """Check that cloning trains any of the parameters that PPO trains.

        Raises:
            ValueError: it does not.
        """
        if not self._cloned & {id(param) for param in trained}:
            raise ValueError(_refusal(self._policy, "`forward` trains nothing of what acts"))

    def store(
        self, observation: Columns, tau: list[str], action: np.ndarray, reward: np.ndarray, diverged: np.ndarray
    ) -> None:
        """Take in one step of this process's streams, arrays (N, ...); the action in physical units."""
        inputs = self._policy.config.input_features or {}
        self._open.add(
            {name: col for name, col in observation.items() if name in inputs}, tau, action, reward, diverged
        )

    def end_step(self, success: np.ndarray) -> None:
        """Note where the task is complete after the step last stored, (N,) bool."""
        self._open.note(success)

    def end_segment(self, found_complete: np.ndarray, num_updates: int) -> None:
        """Remember the successful segments, which were over after so many updates."""
        for segment in self._open.close(found_complete, self.config.tail_steps):
            self.memory.add(Segment(segment.instruction, segment.columns, num_updates))

    def begin_update(self, num_updates: int) -> dict[str, float]:
        """Forget what is too old; returns what all processes have: segments, frames, mean age [updates]."""
        memory = self.memory
        memory.forget(num_updates - self.config.max_age)
        everyone = Remembered.of(memory, self._processes)
        weights = by_task(everyone.instructions, everyone.lengths)
        self._weights = everyone.split(weights)[self._processes.rank] if len(memory) else None
        # Of an instruction that all succeed under each has a part; one that has nothing adds nothing.
        masses = everyone.masses(weights)
        self._share = float(masses[self._processes.rank] / masses.mean()) if masses.any() else 1.0
        ages = sum(num_updates - segment.update for segment in memory.segments)
        each = self._processes.concatenate(np.array([[len(memory), memory.num_frames, ages]]))
        found = each.sum(axis=0)
        metrics = {"memory_segments": float(found[0]), "memory_frames": float(found[1])}
        return metrics | ({"memory_age": float(found[2] / found[0])} if found[0] else {})

    def add_gradients(self, params: Sequence[Tensor]) -> dict[str, float]:
        """Add the gradient of `coef` times the cloning loss of a new batch to those of `params`, and to no other.

        Returns:
            The loss and its gradient's norm, without the weight; {} if there is nothing to clone.
        """
        batch = draw_batch(
            self.memory, self._demos, self._demos_share, self.config.batch_size, self._rng, self._policy.config,
            self._weights,
        )  # fmt: skip
        if batch is None:
            return {}
        loss, _ = self._policy.forward(self._processors.preprocessor(batch))
        if not torch.isfinite(loss):
            raise FloatingPointError(f"The cloning loss is {loss.item()}.")
        trained = [param for param in params if param.requires_grad]
        gradients = torch.autograd.grad(loss, trained, allow_unused=True)
        pairs = [(param, grad) for param, grad in zip(trained, gradients, strict=True) if grad is not None]
        if not pairs:
            raise ValueError(_refusal(self._policy, "`forward` has no gradient for what acts"))
        weight = self._share * self.config.coef
        for param, grad in pairs:
            param.grad = weight * grad if param.grad is None else param.grad.add_(grad, alpha=weight)
        norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(grad) for _, grad in pairs]))
        return {"clone_loss": loss.item(), "clone_grad_norm": norm.item()}

    def state_dict(self) -> list[Any]:
        """The segments that each process remembers, in the first one; all call it between two segments."""
        return self._processes.gather_to_main(self.memory.state_dict())

    def load_state_dict(self, state: list[Any]) -> None:
        """Go on with the segments of this process, or its share if there are more or fewer processes now."""
        self.memory.load_state_dict(own_share(state, self._processes.rank, self._processes.count))


def _parameters_of_forward(policy: Any) -> set[int]:
    """Identities of the parameters that `lerobot-train` would train."""
    try:
        policy.config.get_optimizer_preset()
        return {id(param) for param in _tensors(policy.get_optim_params())}
    except NotImplementedError as error:
        raise ValueError(_refusal(policy, "lerobot-train does not train it")) from error


def _tensors(params: Any) -> Iterable[Tensor]:
    """The parameters in what an optimizer takes: tensors, groups of them, or several of either by name."""
    if isinstance(params, Tensor):
        yield params
    elif isinstance(params, dict):
        for value in [params["params"]] if "params" in params else params.values():
            yield from _tensors(value)
    elif isinstance(params, Iterable) and not isinstance(params, str):
        for value in params:
            yield from _tensors(value)


def _refusal(policy: Any, why: str) -> str:
    return (
        f"--algorithm.self_imitation.coef clones with the loss that lerobot-train has, and --policy.type="
        f"{policy.config.type} cannot be cloned so: {why}. Leave the flag at 0, or use a policy whose forward "
        "trains what acts."
    )
