"""Chains of tasks without a reset in between: the sequential suite, after CALVIN (Mees et al. 2022).

An episode is one chain: a scene reset to a benchmark configuration, then the tasks of an ordering, each with a
window of 80 control steps. The first task that is not complete in its window fails, and so do all after it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_env_cronos.episodic import EpisodicVectorEnv
from lerobot_env_cronos.scene.scenes import STEPS_PER_TASK, Task
from lerobot_env_cronos.vector_env import LEROBOT_OPTIONS, as_one_seed, check_options

ADVANCES = ("window", "on_success")


@dataclass(frozen=True)
class ChainStep:
    """What one control step did to the chains, arrays (n,) bool but for `position`."""

    running: np.ndarray
    """Which chains were running before the step."""
    position: np.ndarray
    """Number (n,) in the ordering of the task that was acted on, from 0."""
    task_success: np.ndarray
    """The task was completed by this step; True once for each task."""
    success: np.ndarray
    """The last task was completed: the whole chain. It is over."""
    failure: np.ndarray
    """A task failed, or the simulation diverged. The chain is over."""
    switched: np.ndarray
    """The next task begins with the next step."""
    diverged: np.ndarray
    is_grasped: np.ndarray
    """The object of the task that was acted on is grasped after the step."""


class SequentialVectorEnv(EpisodicVectorEnv):
    """`num_envs` chains, each of one ordering of tasks from one configuration (paper, Section 4).

    A task is complete if its success test holds after any step of its window. The reward is 1 for each completed
    task, so an episode's return is its chain length, and the mean return CALVIN's average chain length. A chain is
    `terminated` when its last task is complete and `truncated` when a task fails; from then on it is frozen, pays
    nothing and reports no success until the next start.

    Args:
        ordering: the tasks of the chains that `reset` starts.
        advance: `window` starts the next task when the 80 steps are over; `on_success` (CALVIN's) as soon as the
            task is complete.
        end_effector_reset: send the arm home, gripper open, between tasks.
        window: control steps for each task.
        **kwargs: see `EpisodicVectorEnv`.

    Attributes:
        chain_length: (n,) int, tasks completed so far. As a failure ends the chain, it says which ones.
        position: (n,) int, number of the current task in its ordering.
    """

    def __init__(
        self,
        num_envs: int,
        scene: str = "kitchen_2x2",
        *,
        ordering: Sequence[Task],
        advance: str = "window",
        end_effector_reset: bool = False,
        window: int = STEPS_PER_TASK,
        **kwargs,
    ):
        if advance not in ADVANCES:
            raise ValueError(f"unknown advance {advance!r}; valid values: {list(ADVANCES)}")
        if window < 1 or not ordering:
            raise ValueError(f"need a window of at least 1 step and a task, got {window} and {list(ordering)}")
        super().__init__(num_envs, scene, **kwargs)
        self.ordering = tuple(ordering)
        self.advance, self.window, self._sends_arm_home = advance, window, end_effector_reset
        self._max_episode_steps = window * len(self.ordering)
        self._orderings = [self.ordering] * num_envs
        self.chain_length, self.position = np.zeros(num_envs, dtype=int), np.zeros(num_envs, dtype=int)
        self._elapsed = np.zeros(num_envs, dtype=int)
        self._is_complete = np.zeros(num_envs, dtype=bool)
        # Nothing runs before it is started.
        self.done[:] = True

    def _state_arrays(self) -> dict[str, np.ndarray]:
        return super()._state_arrays() | {
            "elapsed": self._elapsed,
            "chain_length": self.chain_length,
            "position": self.position,
            "is_complete": self._is_complete,
        }

    def get_state(self) -> dict[str, np.ndarray]:
        """See `CronosVectorEnv.get_state`; with the orderings (n, longest), padded with -1."""
        valid, longest = self.scene.tasks + self.scene.reset_tasks, max(map(len, self._orderings))
        numbers = [[valid.index(task) for task in ordering] for ordering in self._orderings]
        orderings = np.array([row + [-1] * (longest - len(row)) for row in numbers])
        return super().get_state() | {"orderings": orderings}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """See `CronosVectorEnv.set_state`."""
        super().set_state(state)
        valid = self.scene.tasks + self.scene.reset_tasks
        self._orderings = [tuple(valid[i] for i in row if i >= 0) for row in state["orderings"]]

    def reset(self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None):
        """Start `ordering` everywhere, at starts number `seed + i` or `seeds[i]`, modulo their count."""
        check_options(options, LEROBOT_OPTIONS)
        gym.vector.VectorEnv.reset(self, seed=as_one_seed(seed))
        self.start(self._all, [self.ordering] * self.num_envs, self._choose_starts(seed, self.starts))
        nothing = np.zeros(self.num_envs, dtype=bool)
        return self.observe_running(self._all), self._chain_info(nothing, nothing, self.position)

    def start(self, ids: np.ndarray, orderings: Sequence[Sequence[Task]], configurations: np.ndarray) -> None:
        """Start a chain in each of the environments `ids`; the others go on, or stay frozen.

        Args:
            ids: (k,) environments.
            orderings: the k chains' tasks, of any length above 0.
            configurations: (k,) indices into the split.

        Raises:
            ValueError: there is no such environment or configuration, or `ids` do not rise.
        """
        ids = np.asarray(ids)
        # First of all, because it refuses what are no environments.
        self.scene_reset(ids, configurations, self.split)
        for i, ordering in zip(ids, orderings, strict=True):
            self._orderings[i] = tuple(ordering)
        self.set_task(ids, [ordering[0] for ordering in orderings])
        self.done[ids] = self._is_complete[ids] = False
        self.chain_length[ids] = self.position[ids] = self._elapsed[ids] = 0

    def step(self, actions: np.ndarray):
        """Step the running chains; the observation is under the task that comes next.

        Besides `is_success` (the whole chain, once, at its end), `is_grasped` and `diverged`, `info` holds (n,)
        arrays: `task_success` (the current task was completed by this step), `position` (of the task that was
        acted on) and `chain_length`.
        """
        what = self.apply(actions)
        observation = self.observe_running(self._all[what.running])
        info = self._chain_info(what.success, what.task_success, what.position) | {"diverged": what.diverged}
        # Of the task that was acted on, not of the one that comes next.
        info["is_grasped"] = what.is_grasped
        return observation, what.task_success.astype(np.float32), what.success.copy(), what.failure, info

    def apply(self, actions: np.ndarray) -> ChainStep:
        """`step` without an observation: apply actions (n, 7) to the running chains and do the bookkeeping."""
        running, position = ~self.done, self.position.copy()
        ids = self._all[running]
        _, diverged = self.step_streams(actions, ids)
        self._elapsed[ids] += 1
        # A simulation that broke down proves nothing, whatever it shows, and cannot go on.
        task_success = running & self.is_success & ~self._is_complete & ~diverged
        self._is_complete |= task_success
        self.chain_length += task_success
        window_over = self._elapsed >= self.window
        is_last = self.position + 1 >= [len(ordering) for ordering in self._orderings]
        success = task_success & is_last
        failure = running & (diverged | (window_over & ~self._is_complete))
        may_switch = window_over if self.advance == "window" else self._is_complete
        switched = running & self._is_complete & may_switch & ~is_last & ~failure
        self.done |= success | failure
        is_grasped = self.is_grasped.copy()
        self._begin_next_task(self._all[switched])
        return ChainStep(running, position, task_success, success, failure, switched, diverged, is_grasped)

    def _begin_next_task(self, ids: np.ndarray) -> None:
        if not len(ids):
            return
        self.position[ids] += 1
        self._elapsed[ids], self._is_complete[ids] = 0, False
        if self._sends_arm_home:
            self.end_effector_reset(ids)
        self.set_task(ids, [self._orderings[i][self.position[i]] for i in ids])

    def _chain_info(self, success: np.ndarray, task_success: np.ndarray, position: np.ndarray) -> dict[str, Any]:
        return {
            "is_success": success.copy(),
            "is_grasped": self.is_grasped.copy(),
            "task_success": task_success.copy(),
            "position": position.copy(),
            "chain_length": self.chain_length.copy(),
        }
