"""Storage for the decisions of N streams between two policy updates."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from cronos_lerobot.agents.base import Columns
from cronos_lerobot.agents.decisions import Decision
from cronos_lerobot.agents.ppo.gae import compute_gae

STORED = (
    "rewards", "values", "log_probs", "boundaries", "bootstrap_values", "durations", "instruction_ids", "traces",
    "intervened",
)  # fmt: skip
"""Arrays of a buffer that are filled as the streams go on."""


@dataclass(frozen=True)
class Minibatch:
    """B decisions in random order."""

    indices: np.ndarray
    """(B,) row * num_streams + stream."""
    observation: Columns
    instructions: list[str]
    trace: np.ndarray
    log_prob: np.ndarray
    value: np.ndarray
    advantage: np.ndarray
    return_: np.ndarray

    def split(self, max_bytes: int) -> list[Minibatch]:
        """The same decisions in as few even pieces as have at most `max_bytes` of observations, one at least each.

        They are views.
        """
        size, total = len(self.indices), sum(col.nbytes for col in self.observation.values())
        count = min(size, max(1, -(-total // max_bytes)))
        bounds = np.linspace(0, size, count + 1).astype(int).tolist()
        return [self._rows(slice(first, end)) for first, end in itertools.pairwise(bounds)]

    def _rows(self, rows: slice) -> Minibatch:
        observation = {name: col[rows] for name, col in self.observation.items()}
        arrays = (self.trace, self.log_prob, self.value, self.advantage, self.return_)
        parts = (array[rows] for array in arrays)
        return Minibatch(self.indices[rows], observation, self.instructions[rows], *parts)


class RolloutBuffer:
    """Preallocated at the first `add`; every column keeps its type and shape, instructions are kept as indices.

    Args:
        num_rows: decisions of each stream, U control steps' worth.
        num_streams: N.
    """

    def __init__(self, num_rows: int, num_streams: int) -> None:
        shape = (num_rows, num_streams)
        self.num_rows = num_rows
        self.num_streams = num_streams
        self.rows = 0
        """Rows in use."""
        self.rewards = np.zeros(shape, np.float32)
        self.values = np.zeros(shape, np.float32)
        self.boundaries = np.zeros(shape, np.bool_)
        self.bootstrap_values = np.zeros(shape, np.float32)
        self.durations = np.ones(shape, np.int64)
        self.intervened = np.zeros(shape, np.bool_)
        """A person or a script acted: nothing is learned from these."""
        self.advantages = np.zeros(shape, np.float32)
        self.returns = np.zeros(shape, np.float32)
        self.instruction_ids = np.zeros(shape, np.int64)
        self.traces: np.ndarray | None = None
        self.log_probs: np.ndarray | None = None
        self.observations: Columns = {}
        self._instructions: list[str] = []

    def __len__(self) -> int:
        """Decisions in the buffer, over all streams."""
        return self.rows * self.num_streams

    @property
    def num_own(self) -> int:
        """Decisions in the buffer that the policy's own actions followed, over all streams."""
        return len(self) - int(self.intervened[: self.rows].sum())

    def state_dict(self) -> dict[str, Any]:
        """The decisions in use, stream by stream: arrays (N, rows, ...) of their types; {} if there are none."""
        if not self.rows:
            return {}
        stored = {name: getattr(self, name) for name in STORED} | {"observations": self.observations}
        used = _map_arrays(stored, lambda array: np.ascontiguousarray(array[: self.rows].swapaxes(0, 1)))
        return used | {"instructions": list(self._instructions), "capacity": self.num_rows}

    def load_state_dict(self, state: dict[str, Any], streams: slice = slice(None)) -> None:
        """Go on from `state_dict`, with those of its streams that are this buffer's.

        If U has changed since, there is room for what is there and U rows more.
        """
        self.clear()
        if not state:
            return
        rows = state["rewards"].shape[1]
        if state["capacity"] != self.num_rows:
            self.__init__(rows + self.num_rows, self.num_streams)

        def restore(array: np.ndarray) -> np.ndarray:
            whole = np.zeros((self.num_rows, self.num_streams, *array.shape[2:]), array.dtype)
            whole[:rows] = array[streams].swapaxes(0, 1)
            return whole

        restored = _map_arrays({name: state[name] for name in (*STORED, "observations")}, restore)
        vars(self).update(restored)
        self.rows = rows
        self._instructions = list(state["instructions"])

    def add(
        self,
        decision: Decision,
        instructions: list[str],
        reward: np.ndarray,
        boundary: np.ndarray,
        bootstrap_value: np.ndarray,
        duration: np.ndarray | int = 1,
        intervened: np.ndarray | bool = False,
    ) -> None:
        """Copy one decision of every stream.

        Args:
            decision: of all N streams.
            instructions: N instructions decided under.
            reward: (N,), of several control steps the discounted sum.
            boundary: (N,) bool, the stream's trace is cut after this decision.
            bootstrap_value: (N,), read where `boundary` is set.
            duration: (N,) or a number, control steps that were played.
            intervened: (N,) bool or one, a person or a script acted at any of them.

        Raises:
            IndexError: the buffer is full.
            TypeError: a column has another type than in the rows before.
        """
        if self.traces is None:
            self._allocate(decision)
        assert self.traces is not None
        assert self.log_probs is not None
        row = self.rows
        for name, column in decision.inputs.items():
            # An assignment would write fractions into whole numbers: a policy may see others on another device.
            np.copyto(self.observations[name][row], column, casting="no")
        self.instruction_ids[row] = [self._instruction_id(text) for text in instructions]
        self.traces[row] = decision.trace
        self.log_probs[row] = decision.log_prob
        self.values[row] = decision.value
        self.rewards[row] = reward
        self.boundaries[row] = boundary
        self.bootstrap_values[row] = bootstrap_value
        self.durations[row] = duration
        self.intervened[row] = intervened
        self.rows += 1

    def compute_advantages(self, gamma: float, gae_lambda: float) -> None:
        """Fill `advantages` and `returns` of the rows in use.

        Where help begins or ends, the trace is cut and bootstrapped from the next row's value.
        """
        used = slice(0, self.rows)
        values, helped = self.values[used], self.intervened[used]
        handed_over = np.zeros_like(helped)
        handed_over[:-1] = (helped[1:] != helped[:-1]) & ~self.boundaries[used][:-1]
        following = np.where(handed_over, np.roll(values, -1, axis=0), self.bootstrap_values[used])
        self.advantages[used], self.returns[used] = compute_gae(
            self.rewards[used],
            values,
            self.boundaries[used] | handed_over,
            following,
            gamma,
            gae_lambda,
            self.durations[used],
        )

    def results(self) -> Columns:
        """Return what an update reads of the rows in use, (rows, N) each."""
        names = ("rewards", "values", "advantages", "returns", "intervened")
        return {name: getattr(self, name)[: self.rows] for name in names}

    def normalize_advantages(self, mean: float, std: float) -> None:
        """Shift and scale the advantages so that `mean` becomes 0 and `std` 1."""
        advantages = self.advantages[: self.rows]
        advantages[:] = (advantages - mean) / (std + 1e-8)

    def minibatches(
        self,
        batch_size: int,
        rng: np.random.Generator,
        observations: Columns | None = None,
        limit: int | None = None,
    ) -> Iterator[Minibatch]:
        """Yield every decision without help exactly once, in an order drawn from `rng`.

        The last batch may be smaller.

        Args:
            batch_size: decisions in one.
            rng: draws the order.
            observations: columns (rows, num_streams, ...) instead of the stored ones.
            limit: of so many decisions only, the first ones of that order.
        """
        observations = self.observations if observations is None else observations
        own = np.flatnonzero(~self.intervened[: self.rows])
        order = own[rng.permutation(len(own))[:limit]]
        for start in range(0, len(order), batch_size):
            yield self._gather(order[start : start + batch_size], observations)

    def map_observations(self, batch_size: int, function: Callable[[Columns, list[str]], Columns]) -> Columns:
        """Return what `function` makes of all observations, as columns (rows, num_streams, ...).

        Args:
            batch_size: of observations at a time, about.
            function: columns (B, ...) and B instructions -> columns (B, ...). It sees the buffer's own memory.
        """
        rows = max(1, batch_size // self.num_streams)
        parts = []
        for start in range(0, self.rows, rows):
            part = slice(start, min(start + rows, self.rows))
            size = (part.stop - part.start) * self.num_streams
            columns = {name: col[part].reshape(size, *col.shape[2:]) for name, col in self.observations.items()}
            texts = [self._instructions[i] for i in self.instruction_ids[part].reshape(-1)]
            parts.append(function(columns, texts))
        whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return {name: col.reshape(self.rows, self.num_streams, *col.shape[1:]) for name, col in whole.items()}

    def clear(self) -> None:
        """Forget the decisions; the memory is kept."""
        self.rows = 0

    def _gather(self, indices: np.ndarray, observations: Columns) -> Minibatch:
        assert self.traces is not None
        assert self.log_probs is not None
        row, stream = np.divmod(indices, self.num_streams)
        return Minibatch(
            indices=indices,
            observation={name: column[row, stream] for name, column in observations.items()},
            instructions=[self._instructions[i] for i in self.instruction_ids[row, stream]],
            trace=self.traces[row, stream],
            log_prob=self.log_probs[row, stream],
            value=self.values[row, stream],
            advantage=self.advantages[row, stream],
            return_=self.returns[row, stream],
        )

    def _allocate(self, decision: Decision) -> None:
        shape = (self.num_rows, self.num_streams)
        self.traces = np.zeros((*shape, *decision.trace.shape[1:]), decision.trace.dtype)
        self.log_probs = np.zeros((*shape, *decision.log_prob.shape[1:]), np.float32)
        self.observations = {
            name: np.zeros((*shape, *column.shape[1:]), column.dtype) for name, column in decision.inputs.items()
        }

    def _instruction_id(self, text: str) -> int:
        if text not in self._instructions:
            self._instructions.append(text)
        return self._instructions.index(text)


def _map_arrays(tree: dict[str, Any], convert: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    return {name: _map_arrays(v, convert) if isinstance(v, dict) else convert(v) for name, v in tree.items()}
