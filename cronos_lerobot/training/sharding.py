"""Streams shared out over processes: the main loop counts all of them, this process simulates its own.

Every process runs Algorithm 1 in step with the others, on the same counters and the same random numbers, so that
all decide alike: which task, which configuration, when to stop. The observations and the actions are each
process's own; rewards, successes and divergences are exchanged at every step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.ranks import Ranks

INFO = ("is_success", "is_grasped", "diverged", "intervened")
DESCRIBED = (
    "fps", "robot_type", "tasks", "reset_tasks", "identity", "single_observation_space", "single_action_space",
    "state_names", "action_names", "num_starts", "observe",
)  # fmt: skip
"""What all processes have alike, and the observation, which is this process's."""
OPTIONAL = ("observation_details", "observe_under")
OWN = ("action", "log_prob", "value")
"""Arrays of an ActionSample that have a row for each stream of this process."""


class ShardedEnv:
    """All N streams of a run to whoever counts and intervenes, this process's to whoever looks and acts.

    Stream ids are those of all N streams. Observations and actions have a row for each stream of this process,
    everything else for each of the N. All processes must make the same calls.

    Args:
        env: the streams of this process.
        ranks: that share out the streams; each has as many.

    Attributes:
        timer: that of `env`; it is told the time spent in waiting for the others ("wait").
    """

    def __init__(self, env: Any, ranks: Ranks) -> None:
        self._env = env
        self._ranks = ranks
        self.timer: Callable[[str], AbstractContextManager] = env.timer
        self.num_envs = env.num_envs * ranks.count
        self.mine = ranks.share_of(self.num_envs)
        for name in DESCRIBED:
            setattr(self, name, getattr(env, name))
        for name in OPTIONAL:
            if hasattr(env, name):
                setattr(self, name, getattr(env, name))

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict]:
        """Act on the streams of this process; the reward (N,) and the info's flags (N,) are of all."""
        observation, reward, _, _, info = self._env.step(actions)
        names = [name for name in INFO if name in info]
        table = self._concatenate(np.stack([reward, *(info[name] for name in names)], axis=1, dtype=np.float32))
        never = np.zeros(self.num_envs, np.bool_)
        flags = {name: table[:, i] > 0 for i, name in enumerate(names, start=1)}
        own = {name: info[name] for name in ("executed_action",) if name in info}
        return observation, table[:, 0], never, never.copy(), flags | own

    def find_complete(self, tasks: Sequence[Any]) -> np.ndarray:
        """Whether each of `tasks` is complete in each stream, (N, len(tasks)) bool."""
        return self._concatenate(self._env.find_complete(tasks))

    def set_task(self, ids: Iterable[int], tasks: Sequence[Any]) -> None:
        """Give the streams `ids` their tasks."""
        given = {int(i): task for i, task in zip(ids, tasks, strict=True)}
        own = self._own(list(given))
        if len(own):
            self._env.set_task(own - self.mine.start, [given[int(i)] for i in own])

    def scene_reset(self, ids: np.ndarray, starts: np.ndarray, split: str = "train") -> None:
        """Put the streams `ids` (k,) into the starts number `starts` (k,) of a split."""
        self._on_own(partial(self._env.scene_reset, split=split), ids, starts)

    def place_bodies(self, ids: np.ndarray, poses: np.ndarray) -> None:
        """Put every body of the streams `ids` at `poses` (k, bodies, 7), and the arm home."""
        self._on_own(self._env.place_bodies, ids, poses)

    def end_effector_reset(self, ids: np.ndarray) -> None:
        """Put the arm of the streams `ids` home."""
        self._on_own(self._env.end_effector_reset, ids)

    def unsuitable_bodies(self) -> np.ndarray:
        """Bodies that no task can reach any more, (N, bodies) bool."""
        return self._concatenate(self._env.unsuitable_bodies())

    def put_back(self, stream: int, body: int, rng: np.random.Generator) -> None:
        """Put one body of a stream at a free place; `rng` continues alike in all processes."""
        owner = stream // self._env.num_envs
        if owner == self._ranks.rank:
            self._env.put_back(stream - self.mine.start, body, rng)
        with self.timer("wait"):
            # How many numbers it takes to find a free place only the owner knows.
            rng.bit_generator.state = self._ranks.broadcast(rng.bit_generator.state, source=owner)

    def get_state(self) -> dict[str, np.ndarray]:
        """The state of all N streams, as one process with N streams has it."""
        return {name: self._concatenate(array) for name, array in self._env.get_state().items()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a state of all N streams."""
        self._env.set_state({name: array[self.mine] for name, array in state.items()})

    def _own(self, ids: Any) -> np.ndarray:
        ids = np.asarray(ids, np.int64)
        return ids[(ids >= self.mine.start) & (ids < self.mine.stop)]

    def _on_own(self, act: Callable[..., None], ids: np.ndarray, *values: np.ndarray) -> None:
        """Act on this process's streams of `ids`, with their rows of `values`."""
        own = self._own(ids)
        if len(own):
            act(own - self.mine.start, *(np.asarray(value)[np.isin(ids, own)] for value in values))

    def _concatenate(self, array: np.ndarray) -> np.ndarray:
        with self.timer("wait"):
            return self._ranks.concatenate(array)


def whole_step(step: Step, ranks: Ranks, num_recorded: int) -> Step:
    """Return `step` with the observations and actions of the recorded streams in the first process.

    Those are the first `num_recorded` of all N. If they are the first process's own, no observations are sent: the
    step has that process's only.
    """
    if ranks.count == 1:
        return step
    sent = {"action": {name: array for name in OWN if (array := getattr(step.action, name)) is not None}}
    if num_recorded > len(step.action.action):
        sent["observation"] = step.observation
    whole = _join(ranks.gather_to_main(sent))
    observation = step.observation | whole.get("observation", {})
    return replace(step, observation=observation, action=replace(step.action, **whole["action"]))


def _join(trees: list[Any]) -> Any:
    """Concatenate the arrays of dicts of the same keys."""
    if isinstance(trees[0], dict):
        return {name: _join([tree[name] for tree in trees]) for name in trees[0]}
    return np.concatenate(trees)
