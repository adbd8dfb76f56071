"""Who acts: the interface that evaluation, videos and recordings ask for actions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np

    from cronos_lerobot.agents.base import ActionSample

StreamSeed = Sequence[int]
"""Non-negative integers that seed the randomness of one stream."""


class Actor(Protocol):
    """Chooses actions for some of the streams. Streams are numbered by the caller."""

    is_per_stream: bool = True
    """Whether it keeps the streams apart. If not, `act` gets all streams, and `begin` forgets all of them."""
    temperature: float | None = None
    """Sampling temperature; None if it does not sample at one."""

    def seed(self, seed: int) -> None:
        """Seed the randomness that all streams share."""
        return

    def begin(self, ids: np.ndarray, seeds: Sequence[StreamSeed] | None = None) -> None:
        """Begin a new task in streams `ids`: forget plans and past observations.

        Args:
            ids: (k,) streams.
            seeds: k seeds of their own randomness; None continues with the randomness that they have.
        """
        return

    @abstractmethod
    def act(self, observation: dict[str, Any], instructions: list[str], ids: np.ndarray) -> ActionSample:
        """Choose the next action of streams `ids` (k,).

        Args:
            observation: raw, k rows.
            instructions: k current instructions.
            ids: (k,) streams.
        """
        ...
