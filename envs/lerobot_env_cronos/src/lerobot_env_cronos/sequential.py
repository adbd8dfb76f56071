"""Chains of tasks without a reset in between: the sequential suite, after CALVIN (Mees et al. 2022).

An episode is one chain: a scene reset to a benchmark configuration, then the tasks of an ordering, each with a
window of control steps. The first task that is not complete in its window fails, and so do all after it.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_env_cronos.episodic import EpisodicVectorEnv
from lerobot_env_cronos.scene.scenes import Task, get_scene
from lerobot_env_cronos.vector_env import LEROBOT_OPTIONS, as_one_seed, check_options

ADVANCES = ("window", "on_success")


class SequentialVectorEnv(EpisodicVectorEnv):
    """`num_envs` chains of one ordering of tasks, each from one configuration (paper, Section 4).

    A task is complete if its success test holds after any step of its window. The reward is 1 for each completed
    task, so an episode's return is its chain length, and the mean return CALVIN's average chain length. A chain is
    `terminated` when its last task is complete and `truncated` when a task fails; from then on it is frozen, pays
    nothing and reports no success until the next start.

    Args:
        ordering: the tasks of every chain.
        advance: `window` starts the next task when its window is over; `on_success` (CALVIN's) as soon as the
            task is complete.
        end_effector_reset: send the arm home, gripper open, between tasks.
        window: control steps for each task; None for the scene's.
        **kwargs: see `EpisodicVectorEnv`.

    Attributes:
        chain_length: (n,) int, tasks completed so far. As a failure ends the chain, it says which ones.
        position: (n,) int, number of the current task in the ordering.
    """

    def __init__(
        self,
        num_envs: int,
        scene: str = "kitchen_2x2",
        *,
        ordering: Sequence[Task],
        advance: str = "window",
        end_effector_reset: bool = False,
        window: int | None = None,
        **kwargs,
    ):
        if advance not in ADVANCES:
            raise ValueError(f"unknown advance {advance!r}; valid values: {list(ADVANCES)}")
        window = get_scene(scene).steps_per_task if window is None else window
        if window < 1 or not ordering:
            raise ValueError(f"need a window of at least 1 step and a task, got {window} and {list(ordering)}")
        super().__init__(num_envs, scene, **kwargs)
        self.ordering = tuple(ordering)
        self.advance, self.window, self._sends_arm_home = advance, window, end_effector_reset
        self._max_episode_steps = window * len(self.ordering)
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

    def reset(self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None):
        """Start `ordering` everywhere, at starts number `seed + i` or `seeds[i]`, modulo their count."""
        check_options(options, LEROBOT_OPTIONS)
        gym.vector.VectorEnv.reset(self, seed=as_one_seed(seed))
        self.scene_reset(self._all, self._choose_starts(seed, self.starts), self.split)
        self.set_task(self._all, [self.ordering[0]] * self.num_envs)
        self.done[:] = self._is_complete[:] = False
        self.chain_length[:] = self.position[:] = self._elapsed[:] = 0
        nothing = np.zeros(self.num_envs, dtype=bool)
        return self.observe_running(self._all), self._chain_info(nothing, nothing)

    def step(self, actions: np.ndarray):
        """Step the running chains; the observation is under the task that comes next.

        Besides `is_success` (the whole chain, once, at its end), `is_grasped` and `diverged`, `info` holds (n,)
        arrays: `task_success` (the current task was completed by this step), `position` (of the task that was
        acted on) and `chain_length`.
        """
        running = ~self.done
        ids = self._all[running]
        _, diverged = self.step_streams(actions, ids)
        self._elapsed[ids] += 1
        # A simulation that broke down proves nothing, whatever it shows, and cannot go on.
        task_success = running & self.is_success & ~self._is_complete & ~diverged
        self._is_complete |= task_success
        self.chain_length += task_success
        window_over = self._elapsed >= self.window
        is_last = self.position + 1 >= len(self.ordering)
        success = task_success & is_last
        failure = running & (diverged | (window_over & ~self._is_complete))
        may_switch = window_over if self.advance == "window" else self._is_complete
        switched = running & self._is_complete & may_switch & ~is_last & ~failure
        self.done |= success | failure
        # Of the task that was acted on, not of the one that comes next.
        info = self._chain_info(success, task_success) | {"diverged": diverged}
        self._begin_next_task(self._all[switched])
        return self.observe_running(ids), task_success.astype(np.float32), success.copy(), failure, info

    def _begin_next_task(self, ids: np.ndarray) -> None:
        if not len(ids):
            return
        self.position[ids] += 1
        self._elapsed[ids], self._is_complete[ids] = 0, False
        if self._sends_arm_home:
            self.end_effector_reset(ids)
        self.set_task(ids, [self.ordering[k] for k in self.position[ids]])

    def _chain_info(self, success: np.ndarray, task_success: np.ndarray) -> dict[str, Any]:
        return {
            "is_success": success.copy(),
            "is_grasped": self.is_grasped.copy(),
            "task_success": task_success.copy(),
            "position": self.position.copy(),
            "chain_length": self.chain_length.copy(),
        }
