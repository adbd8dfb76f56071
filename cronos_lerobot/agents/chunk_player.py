"""Policies that plan chunks of actions or look back, with a memory for every stream of its own.

A policy's `select_action` has one queue for its whole batch. Of streams that switch tasks, diverge or end at
different times it would play the old task's actions to one of them.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

from cronos_lerobot.agents.base import Columns
from cronos_lerobot.agents.processing import PolicyProcessors

PLANS_FROM_PLANS = ("tdmpc", "lingbot_va")
"""Types of policies whose plans depend on the plans before them."""


class ObservationHistory:
    """The last observations of every stream, its own; streams are numbered by whoever asks.

    Where a stream has not seen so many since it began, the first one is repeated, as LeRobot's policies do.

    Args:
        length: H, how many observations a policy looks at; with 1 columns stay as they are.
    """

    def __init__(self, length: int = 1) -> None:
        self.length = length
        self._past: dict[int, Columns] = {}

    def begin(self, ids: Iterable[int]) -> None:
        """What streams `ids` see from now on has nothing to do with what they saw before."""
        for i in ids:
            self._past.pop(int(i), None)

    def see(self, columns: Columns, ids: Sequence[int]) -> Columns:
        """Remember the observations (k, ...) of streams `ids` (k,); returns `followed_by` them."""
        seen = self.followed_by(columns, ids)
        if self.length > 1:
            for row, i in enumerate(ids):
                self._past[int(i)] = {name: col[row] for name, col in seen.items()}
        return seen

    def followed_by(self, columns: Columns, ids: Sequence[int]) -> Columns:
        """What streams `ids` have seen once they see these observations (k, ...): (k, H, ...), oldest first."""
        if self.length == 1:
            return columns
        return {
            name: np.stack([self._row(name, col[row], int(i)) for row, i in enumerate(ids)])
            for name, col in columns.items()
        }

    def _row(self, name: str, newest: np.ndarray, i: int) -> np.ndarray:
        if i not in self._past:
            return np.repeat(newest[None], self.length, axis=0)
        return np.concatenate([self._past[i][name][1:], newest[None]])


class ChunkPlayer:
    """Plans a chunk for the streams that have none left, and plays it action by action.

    Args:
        plan: columns (B, ...), or (B, history, ...) oldest first, and B instructions -> actions (B, n, A),
            normalised.
        history: observations that `plan` looks at.
        num_steps: how many of a chunk's actions are played, the first ones; None plays all.
    """

    is_per_stream = True

    def __init__(
        self, plan: Callable[[Columns, list[str]], Tensor], history: int = 1, num_steps: int | None = None
    ) -> None:
        self._plan = plan
        self._history = ObservationHistory(history)
        self._num_steps = num_steps
        self._queues: dict[int, deque[Tensor]] = defaultdict(deque)

    def begin(self, ids: Sequence[int]) -> None:
        """Forget what is left of the chunks and the history of streams `ids`."""
        self._history.begin(ids)
        for i in ids:
            self._queues.pop(int(i), None)

    def act(self, columns: Columns, instructions: list[str], ids: Sequence[int]) -> Tensor:
        """Return normalised actions (k, A) of streams `ids` (k,), for raw observations (k, ...)."""
        queues = [self._queues[int(i)] for i in ids]
        seen = self._history.see(columns, ids)
        idle = [row for row, queue in enumerate(queues) if not queue]
        if idle:
            some = seen if len(idle) == len(queues) else {name: col[idle] for name, col in seen.items()}
            chunks = self._plan(some, [instructions[row] for row in idle])[:, : self._num_steps]
            for row, chunk in zip(idle, chunks, strict=True):
                queues[row].extend(chunk)
        return torch.stack([queue.popleft() for queue in queues])


class SharedPlayer:
    """The policy's own `select_action`, for those whose memory is more than queues. One memory for all streams."""

    is_per_stream = False

    def __init__(self, policy: Any, processors: PolicyProcessors) -> None:
        self._policy, self._processors = policy, processors
        self._is_new = True

    def begin(self, ids: Sequence[int]) -> None:
        """Forget everything: LeRobot can only clear the memory for all streams at once."""
        self._is_new |= len(ids) > 0

    def act(self, columns: Columns, instructions: list[str], ids: Sequence[int]) -> Tensor:
        """See `ChunkPlayer`; `ids` are all streams."""
        # Only now: an evaluation in between has left its own plans in the policy.
        if self._is_new:
            self._policy.reset()
            self._is_new = False
        return self._policy.select_action(self._processors.batch(columns, instructions))


def make_player(policy: Any, processors: PolicyProcessors) -> ChunkPlayer | SharedPlayer:
    """Return what plays a LeRobot policy as its own `select_action` does, each stream by itself where that can be.

    It cannot where a plan depends on the plans before it: ACT's temporal ensemble, TD-MPC's warm start, the cache
    of LingBot-VA.
    """
    config = policy.config
    if getattr(config, "temporal_ensemble_coeff", None) is not None or config.type in PLANS_FROM_PLANS:
        return SharedPlayer(policy, processors)
    policy.reset()
    observed = {key: queue.maxlen or 1 for key, queue in _queues(policy).items() if key != ACTION}
    history = max(observed.values(), default=1)

    def plan(columns: Columns, instructions: list[str]) -> Tensor:
        # Whatever the policy remembers is of other streams.
        policy.reset()
        batch = {}
        for step in range(history):
            frame = columns if history == 1 else {name: col[:, step] for name, col in columns.items()}
            # A preprocessed observation has an empty action, for which these policies have a queue.
            batch = {k: v for k, v in processors.batch(frame, instructions).items() if k != ACTION}
            if OBS_IMAGES in observed:
                batch[OBS_IMAGES] = torch.stack([batch[key] for key in config.image_features], dim=-4)
            if observed:
                populate_queues(_queues(policy), batch, exclude_keys=[ACTION])
        try:
            return policy.predict_action_chunk(batch)
        except NotImplementedError:
            return policy.select_action(batch).unsqueeze(1)

    # GR00T plays fewer than its config says, where the model that it began with was made to.
    num_steps = getattr(policy, "_action_queue_steps", getattr(config, "n_action_steps", None))
    return ChunkPlayer(plan, history, num_steps)


def _queues(policy: Any) -> dict[str, deque]:
    """The queues of a policy that looks back; LeRobot's `populate_queues` fills them."""
    queues = getattr(policy, "_queues", None)
    return queues if isinstance(queues, dict) else {}
