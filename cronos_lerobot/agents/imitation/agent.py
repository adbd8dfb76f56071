"""An agent that imitates what it did when it succeeded: for every policy that `lerobot-train` trains."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from cronos_lerobot.agents.base import ActionSample, Batch, Columns, LearningAgent, observation_steps, samples
from cronos_lerobot.agents.chunk_player import ChunkPlayer, SharedPlayer, make_player
from cronos_lerobot.agents.imitation.batches import Demonstrations, draw_batch
from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.agents.imitation.memory import (
    OpenSegments,
    Remembered,
    SegmentMemory,
    by_advantage,
    by_return,
    effective_share,
    own_share,
)
from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.agents.registry import AgentContext, register_agent
from cronos_lerobot.agents.weights import check_precision

FINE_TUNING = 0.1
"""Of the learning rate of cloning from scratch. The whole of it unlearns what the few successes do not show."""


@register_agent("imitation")
class ImitationAgent(LearningAgent):
    """Acts as the policy does, remembers the segments that succeeded, and clones them.

    With a weighting it remembers those that failed as well, and draws frames by weight: the gradient has the
    expectation of the weighted loss's, with any policy, and no forward pass is spent on what weighs nothing.

    The loss is the policy's own `forward`, the optimizer the one of its preset, the batches those that
    `lerobot-train` would make of a dataset of these segments. An update learns from the segments that were over
    before it.

    Args:
        context: of the run; its config is an ImitationConfig.

    Raises:
        ValueError: the policy has no optimizer preset, or the demonstrations lack what it reads.
    """

    def __init__(self, context: AgentContext) -> None:
        self.config: ImitationConfig = context.config
        self.policy = context.policy.eval()
        # What the optimizer trains: the policy itself, or where the policy is an average over its steps, a copy.
        self._learner = copy_trained(self.policy) if self.config.ema_decay else self.policy
        self._average = get_ema_multi_avg_fn(self.config.ema_decay)
        self._processors, self._ranks = context.processors, context.ranks
        self._stopwatch, self._streams = context.stopwatch, context.streams
        self._rng = context.rng("imitation")
        self._player = self._make_player(context.torch_rng("actions"))
        self._make_optimizer()
        policy_config = self.policy.config
        self._open = OpenSegments(self._streams.stop - self._streams.start, kept=self.config.demos_share < 1)
        drop_last = getattr(policy_config, "drop_n_last_frames", 0) or 0
        self.memory = SegmentMemory(int(self.config.memory_gib * 2**30), drop_last)
        self._weights: np.ndarray | None = None
        self._masses: np.ndarray | None = None
        self._has_success = self._is_warm = False
        self._demos = None
        if self.config.demos_share:
            self._demos = Demonstrations(self.config.demos, policy_config)

    @torch.no_grad()
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """Choose an action for each of its streams."""
        with self._stopwatch("infer"):
            mine = tau[self._streams]
            action = self._player.act(observation_columns(o_t), mine, range(len(mine)))
            action = self._processors.physical_actions(action)
        return ActionSample(action)

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
        """Keep one step of each of its streams, and forget what is left of the plans where the trace is cut."""
        mine = self._streams
        self._open.add(self._inputs(o_t), tau[mine], a_t.action, r_t[mine], diverged_t[mine])
        self._player.begin(np.flatnonzero(cut_t[mine]).tolist())

    def end_step(self, success: np.ndarray) -> None:
        """Note where the task is complete."""
        self._open.note(success[self._streams])

    def end_segment(self, success: np.ndarray, found_complete: np.ndarray) -> None:
        """Remember the successful segments of its streams, and the failed ones if they are weighted."""
        config = self.config
        for segment in self._open.close(
            found_complete[self._streams],
            config.tail_steps,
            config.lead_steps,
            with_failed=config.weighting != "none",
        ):
            self.memory.add(segment)

    def update(self) -> dict[str, float]:
        """Take the update's optimizer steps, once there are enough successes or if there are demonstrations."""
        memory = self.memory
        successes = sum(segment.success for segment in memory.segments)
        found = self._ranks.concatenate(np.array([[successes, memory.num_frames, len(memory)]]))
        metrics = {"segments": float(found[:, 0].sum()), "frames": float(found[:, 1].sum())}
        metrics |= self._weigh()
        # Failed segments that are remembered may push successes out again.
        self._is_warm |= self._demos is not None or bool(found[:, 0].sum() >= self.config.warmup_segments)
        self._has_success = bool(found[:, 0].any())
        # All processes take a step, or none; one that has nothing to clone takes that of the others.
        shares = self._shares(found[:, 2] > 0)
        if not self._is_warm or not shares.any():
            return metrics | {"optimizer_steps": 0.0}
        with self._stopwatch("update"):
            self._learner.train()
            own = float(shares[self._ranks.rank])
            steps = [self._step(own) for _ in range(self.config.steps_per_update)]
            self._learner.eval()
            # Running means, as those of batch normalization, are each process's own of the batches that it had.
            for module in dict.fromkeys((self._learner, self.policy)):
                self._ranks.copy_from(int(shares.argmax()), module.buffers())
        losses, norms = self._ranks.concatenate(np.array([steps])).mean(axis=1).T
        # That of a process counts by as much as its gradient does, not at all without a batch (NaN).
        loss = np.average(losses[shares > 0], weights=shares[shares > 0])
        metrics |= {"loss": float(loss), "grad_norm": float(norms.mean())}
        return metrics | {"optimizer_steps": float(len(steps))}

    def shared_tensors(self) -> Iterable[Tensor]:
        """What is trained, and the policy's buffers, which training may move."""
        return [*super().shared_tensors(), *self.policy.buffers()]

    def state_dict(self) -> dict[str, Any]:
        """The segments that each process remembers, in the first one, and what an average is of."""
        learner = {}
        if self.config.ema_decay:
            params = self.policy.named_parameters(remove_duplicate=False)
            frozen = {name for name, param in params if not param.requires_grad}
            learner = {name: value for name, value in self._learner.state_dict().items() if name not in frozen}
        memory = self._ranks.gather_to_main(self.memory.state_dict())
        return {"memory": memory, "learner": learner, "is_warm": self._is_warm}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on with the segments of this process, or with its share if there are more or fewer processes now."""
        ranks = self._ranks
        self._is_warm = state["is_warm"]
        self.memory.load_state_dict(own_share(state["memory"], ranks.rank, ranks.count))
        if self.config.ema_decay:
            self._learner.load_state_dict(self.policy.state_dict() | state["learner"])

    def _make_player(self, generator: torch.Generator) -> ChunkPlayer | SharedPlayer:
        if not samples(self.policy):
            return make_player(self.policy, self._processors)

        def plan(columns: Columns, instructions: list[str]) -> Tensor:
            batch = self._processors.batch(columns, instructions)
            sample = self.policy.sample_actions(batch, temperature=self.config.temperature, generator=generator)
            return sample["actions"]

        return ChunkPlayer(plan, observation_steps(self.policy))

    def _make_optimizer(self) -> None:
        try:
            preset = self.policy.config.get_optimizer_preset()
            params = self._learner.get_optim_params()
        except NotImplementedError as error:
            raise ValueError(
                f"--policy.type={self.policy.config.type} has no optimizer preset or parameters to optimise: "
                "--algorithm.type=imitation trains what lerobot-train trains."
            ) from error
        self.optimizer = preset.build(params)
        factor = FINE_TUNING if self.config.lr is None else self.config.lr / preset.lr
        for optimizer in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] *= factor
        self._max_grad_norm = preset.grad_clip_norm
        self._trained = [param for param in self._learner.parameters() if param.requires_grad]
        check_precision(self._trained, self.policy.config, self.config.type)

    @property
    def _optimizers(self) -> list[torch.optim.Optimizer]:
        assert self.optimizer is not None
        return [*self.optimizer.values()] if isinstance(self.optimizer, dict) else [self.optimizer]

    def _inputs(self, observation: dict[str, Any]) -> Columns:
        """The columns that the policy reads."""
        inputs = self.policy.config.input_features or {}
        return {name: column for name, column in observation_columns(observation).items() if name in inputs}

    def _weigh(self) -> dict[str, float]:
        """Weigh what all processes remember; returns metrics of it, none of memory that is not weighted."""
        config, memory = self.config, self.memory
        if config.weighting == "none":
            return {}
        failed = sum(not segment.success for segment in memory.segments)
        metrics = {"failed_segments": float(sum(self._ranks.gather(failed))), "effective_share": 0.0}
        everyone = Remembered.of(memory, self._ranks, config.gamma)
        self._weights = self._masses = None
        if len(everyone.returns):
            if config.weighting == "return":
                weights = by_return(everyone.returns, config.weighting_beta)
            else:
                weights = by_advantage(
                    everyone.returns, everyone.instructions, config.weighting_beta, config.max_weight
                )
            self._weights = everyone.split(weights)[self._ranks.rank]
            self._masses = everyone.masses(weights)
            metrics["effective_share"] = effective_share(weights, everyone.lengths)
        return metrics

    def _shares(self, has_segments: np.ndarray) -> np.ndarray:
        """(processes,) by how much the loss of each counts, 1 in the mean; 0 of one that has nothing to clone.

        A batch of a process is drawn by the weights of its own segments, which may be small beside the others'.
        """
        if self._masses is not None and self._has_success:
            return self._masses / self._masses.mean()
        if self._demos is not None:
            return np.ones(len(has_segments))
        has_batch = has_segments & self._has_success
        return has_batch / has_batch.mean() if has_batch.any() else np.zeros(len(has_batch))

    def _batch(self) -> Batch:
        config = self.config
        batch = draw_batch(
            self.memory, self._demos, config.demos_share, config.batch_size, self._rng, self.policy.config,
            self._weights, has_success=self._has_success,
        )  # fmt: skip
        assert batch is not None
        return batch

    def _step(self, share: float) -> tuple[float, float]:
        """One optimizer step, as `lerobot-train` takes it, with the mean gradient of the processes with a batch.

        Args:
            share: by how much this process's loss counts, see `_shares`; one of 0 takes no batch.

        Returns:
            The loss, NaN without a batch, and the gradient's norm.
        """
        value = float("nan")
        if share:
            loss, _ = self._learner.forward(self._processors.preprocessor(self._batch()))
            if not torch.isfinite(loss):
                raise FloatingPointError(f"The loss is {loss.item()}.")
            (share * loss).backward()
            value = loss.item()
        self._ranks.average_gradients(self._trained)
        norm = torch.nn.utils.clip_grad_norm_(self._trained, self._max_grad_norm or float("inf"))
        for optimizer in self._optimizers:
            optimizer.step()
            optimizer.zero_grad()
        # TD-MPC moves its target networks here.
        if callable(after_step := getattr(self._learner, "update", None)):
            after_step()
        if self.config.ema_decay:
            self._move_average()
        return value, float(norm)

    @torch.no_grad()
    def _move_average(self) -> None:
        """Move the policy a little towards what is trained; buffers are taken over."""
        averaged = [param for param in self.policy.parameters() if param.requires_grad]
        self._average(averaged, self._trained, 0)
        for buffer, new in zip(self.policy.buffers(), self._learner.buffers(), strict=True):
            buffer.copy_(new)


def copy_trained(policy: PreTrainedPolicy) -> PreTrainedPolicy:
    """A copy that shares the parameters that are not trained, which may be most of a large policy."""
    shared = {id(param): param for param in policy.parameters() if not param.requires_grad}
    return copy.deepcopy(policy, memo=shared)
