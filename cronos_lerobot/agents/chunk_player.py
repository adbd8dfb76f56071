"""LeRobot policies that plan chunks of actions or look back, with a memory for every stream of its own.

A policy's `select_action` has one queue for its whole batch. Of streams that switch tasks, diverge or end at
different times it would play the old task's actions to one of them. Here each stream has a queue and a history
of its own.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

from cronos_lerobot.agents.base import Batch

PLANS_FROM_PLANS = ("tdmpc", "lingbot_va")
"""Types of policies whose plans depend on the plans before them."""
Rows = Callable[[list[int]], Batch]
"""Makes the preprocessed batch of some observations by their numbers, ascending; see `PolicyProcessors.rows`."""


class Player(Protocol):
    """Chooses one action for each stream at a time; streams are numbered by whoever asks."""

    is_per_stream: bool
    """Whether the streams are kept apart; if not, it is asked for all of them at once, and `begin` is for all."""

    def begin(self, ids: Sequence[int]) -> None:
        """What streams `ids` see from now on has nothing to do with what they saw before."""
        ...

    def act(self, batch: Batch | Rows, ids: Sequence[int]) -> Tensor:
        """Return normalised actions (k, A) of streams `ids` (k,) for their preprocessed observations.

        Args:
            batch: k of them, or what makes them: it is not asked where nobody looks.
            ids: the streams.

        Raises:
            ValueError: some of the streams plan, and which of the batch is theirs cannot be said.
        """
        ...


class ChunkPlayer:
    """Plans a chunk for the streams that have none left, and plays it action by action.

    Args:
        plan: a preprocessed batch of B observations, with their history -> actions (B, n, A), normalised.
        history: observations that `plan` looks at; the first one is repeated where there were no more yet, as
            LeRobot's policies do.
        num_steps: how many of a chunk's actions are played, the first ones; None plays all.
    """

    is_per_stream = True

    def __init__(
        self, plan: Callable[[list[Batch]], Tensor], history: int = 1, num_steps: int | None = None
    ) -> None:
        self._plan = plan
        self._history = history
        self._num_steps = num_steps
        self._queues: dict[int, deque[Tensor]] = defaultdict(deque)
        self._frames: dict[int, deque[Batch]] = defaultdict(lambda: deque(maxlen=history))

    def begin(self, ids: Sequence[int]) -> None:
        """Forget what is left of the chunks and the history of streams `ids`."""
        for i in map(int, ids):
            self._queues.pop(i, None)
            self._frames.pop(i, None)

    def act(self, batch: Batch | Rows, ids: Sequence[int]) -> Tensor:
        """See `Player`."""
        ids = [int(i) for i in ids]
        idle = [row for row, i in enumerate(ids) if not self._queues[i]]
        if self._history > 1:
            self._look(_whole(batch, len(ids)), ids)
        if idle:
            frames = [_some(batch, idle, len(ids))] if self._history == 1 else self._past(ids, idle)
            chunks = self._plan(frames)[:, : self._num_steps]
            for row, chunk in zip(idle, chunks, strict=True):
                self._queues[ids[row]].extend(chunk)
        return torch.stack([self._queues[i].popleft() for i in ids])

    def _look(self, batch: Batch, ids: list[int]) -> None:
        for row, i in enumerate(ids):
            frames = self._frames[i]
            frames.extend([_some(batch, [row], len(ids))] * (1 if frames else self._history))

    def _past(self, ids: list[int], rows: list[int]) -> list[Batch]:
        """The observations of some rows, oldest first."""
        frames = zip(*(self._frames[ids[row]] for row in rows), strict=True)
        return [join_rows(frame) for frame in frames]


class SharedPlayer:
    """The policy's own `select_action`, for those whose memory is more than queues. One memory for all streams."""

    is_per_stream = False

    def __init__(self, policy: Any) -> None:
        self._policy = policy
        self._is_new = True

    def begin(self, ids: Sequence[int]) -> None:
        """Forget everything: LeRobot can only clear the memory for all streams at once."""
        self._is_new |= len(ids) > 0

    def act(self, batch: Batch | Rows, ids: Sequence[int]) -> Tensor:
        """See `Player`."""
        # Only now: an evaluation in between has left its own plans in the policy.
        if self._is_new:
            self._policy.reset()
            self._is_new = False
        return self._policy.select_action(_whole(batch, len(ids)))


def make_player(policy: Any) -> ChunkPlayer | SharedPlayer:
    """Return what plays a LeRobot policy as its own `select_action` does, each stream by itself where that can be.

    It cannot where a plan depends on the plans before it: ACT's temporal ensemble, TD-MPC's warm start, the cache
    of LingBot-VA.
    """
    config = policy.config
    if getattr(config, "temporal_ensemble_coeff", None) is not None or config.type in PLANS_FROM_PLANS:
        return SharedPlayer(policy)
    policy.reset()
    observed = {key: queue.maxlen or 1 for key, queue in _queues(policy).items() if key != ACTION}

    def plan(frames: list[Batch]) -> Tensor:
        # Whatever the policy remembers is of other streams.
        policy.reset()
        # A preprocessed observation has an empty action, for which these policies have a queue.
        frames = [{key: value for key, value in frame.items() if key != ACTION} for frame in frames]
        for frame in frames:
            if OBS_IMAGES in observed:
                frame[OBS_IMAGES] = torch.stack([frame[key] for key in config.image_features], dim=-4)
            if observed:
                populate_queues(_queues(policy), frame, exclude_keys=[ACTION])
        try:
            return policy.predict_action_chunk(frames[-1])
        except NotImplementedError:
            return policy.select_action(frames[-1]).unsqueeze(1)

    # GR00T plays fewer than its config says, where the model that it began with was made to.
    num_steps = getattr(policy, "_action_queue_steps", getattr(config, "n_action_steps", None))
    return ChunkPlayer(plan, max(observed.values(), default=1), num_steps)


def _whole(batch: Batch | Rows, count: int) -> Batch:
    return batch if isinstance(batch, dict) else batch(list(range(count)))


def _some(batch: Batch | Rows, rows: list[int], count: int) -> Batch:
    """Some rows of a batch of `count`. A text is padded to the longest of all, whoever plans."""
    whole = _whole(batch, count)
    if len(rows) == count:
        return whole
    packed = [key for key, value in whole.items() if isinstance(value, Tensor) and value.shape[:1] != (count,)]
    if not packed:
        return take_rows(whole, rows)
    if not isinstance(batch, dict):
        return batch(rows)
    # Such as all patches of all pictures, one after the other.
    raise ValueError(
        f"{packed[0]!r} has the shape {tuple(whole[packed[0]].shape)} for {count} observations, and does not say "
        "whose is what: give `PolicyProcessors.rows` in place of a batch, if the policy does not look back."
    )


def take_rows(batch: Batch, rows: list[int]) -> Batch:
    """Return some rows of a batch: of its tensors and of its lists."""
    taken: Batch = {}
    for key, value in batch.items():
        if isinstance(value, Tensor):
            taken[key] = value[rows]
        else:
            taken[key] = [value[row] for row in rows] if isinstance(value, list) else value
    return taken


def join_rows(batches: Sequence[Batch]) -> Batch:
    """Return batches of the same keys as one."""
    joined: Batch = {}
    for key, value in batches[0].items():
        if isinstance(value, Tensor):
            joined[key] = torch.cat([batch[key] for batch in batches])
        else:
            joined[key] = [v for batch in batches for v in batch[key]] if isinstance(value, list) else value
    return joined


def _queues(policy: Any) -> dict[str, deque]:
    """The queues of a policy that looks back, LeRobot's `populate_queues` fills them."""
    queues = getattr(policy, "_queues", None)
    return queues if isinstance(queues, dict) else {}
