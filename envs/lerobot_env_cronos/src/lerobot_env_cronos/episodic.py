"""Episodes for evaluation: independent tasks, each from a benchmark configuration within the steps of a task.

These environments are what `lerobot-eval` and `gym.make` run; training streams use `CronosVectorEnv` itself.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from lerobot_env_cronos.benchmark.configurations import check_split
from lerobot_env_cronos.scene.scenes import Task, get_scene
from lerobot_env_cronos.vector_env import LEROBOT_OPTIONS, CronosVectorEnv, as_one_seed, check_options


class EpisodicVectorEnv(CronosVectorEnv):
    """Episodes that end, and are frozen from then on until the next `reset`.

    What is over is neither simulated nor rendered any more: its observation stays the last one.

    Args:
        split: `train` or `held_out`.
        configurations: where episodes start, indices into the split; None for all of them.
        **kwargs: see `CronosVectorEnv`.

    Attributes:
        done: (n,) bool, the episodes that are over.
        starts: (k,) int, the configurations; episode i of `reset(seed=s)` starts from `starts[(s + i) % k]`.
    """

    def __init__(
        self,
        num_envs: int,
        scene: str = "kitchen_2x2",
        *,
        split: str = "train",
        configurations: Sequence[int] | None = None,
        **kwargs,
    ):
        check_split(split)
        self.split = split
        super().__init__(num_envs, scene, **kwargs)
        self.starts = _choose(configurations, len(self.benchmark.configurations[split]))
        self.done = np.zeros(num_envs, dtype=bool)
        self._last: dict[str, Any] | None = None

    def _state_arrays(self) -> dict[str, np.ndarray]:
        return super()._state_arrays() | {"done": self.done}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """See `CronosVectorEnv.set_state`."""
        super().set_state(state)
        self._last = None

    def observe_running(self, running: np.ndarray) -> dict[str, Any]:
        """The observation of all environments, made anew for `running` (k,) only; arrays are fresh."""
        if self._last is None or len(running) == self.num_envs:
            self._last = self.observe()
        elif len(running):
            _scatter(self._last, running, self.observe(running))
        return _copy(self._last)


class IndependentVectorEnv(EpisodicVectorEnv):
    """`num_envs` independent episodes of one task (paper, Section 4, "Independent-task evaluation").

    An episode starts from configuration `starts[seed % len(starts)]` of `split`, by default `seed % 64`, with the
    arm at home. It is `terminated` when the task is complete and `truncated` after `max_episode_steps`; from then
    on it is frozen, pays no reward and reports no success until the next `reset`, as LeRobot's rollout expects.

    Args:
        task: the task of every episode.
        max_episode_steps: `task` for the steps that the scene gives a task, None for no limit.
        **kwargs: see `EpisodicVectorEnv`.
    """

    def __init__(
        self,
        num_envs: int,
        scene: str = "kitchen_2x2",
        *,
        task: Task,
        max_episode_steps: int | Literal["task"] | None = "task",
        **kwargs,
    ):
        if max_episode_steps == "task":
            max_episode_steps = get_scene(scene).steps_per_task
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1, got {max_episode_steps}")
        self.task = task
        self._max_episode_steps = np.inf if max_episode_steps is None else max_episode_steps
        super().__init__(num_envs, scene, **kwargs)
        self._elapsed = np.zeros(num_envs, dtype=int)

    def _state_arrays(self) -> dict[str, np.ndarray]:
        return super()._state_arrays() | {"elapsed": self._elapsed}

    def reset(self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None):
        """Start new episodes everywhere, at starts number `seed + i` or `seeds[i]`, modulo their count."""
        check_options(options, LEROBOT_OPTIONS)
        gym.vector.VectorEnv.reset(self, seed=as_one_seed(seed))
        self.scene_reset(self._all, self._choose_starts(seed, self.starts), self.split)
        self.set_task(self._all, [self.task] * self.num_envs)
        self.done[:] = False
        self._elapsed[:] = 0
        return self.observe_running(self._all), self._info()

    def step(self, actions: np.ndarray):
        """Step the unfinished episodes; see `CronosVectorEnv.step`."""
        running = self._all[~self.done]
        reward, diverged = self.step_streams(actions, running)
        reward[self.done] = 0.0
        # A diverged simulation cannot be judged any further, whatever it shows: its episode ends as a failure.
        success = self.is_success & ~self.done & ~diverged
        self._elapsed[running] += 1
        truncated = ~self.done & ~success & ((self._elapsed >= self._max_episode_steps) | diverged)
        self.done |= success | truncated
        info = {"is_success": success, "is_grasped": self.is_grasped.copy(), "diverged": diverged}
        return self.observe_running(running), reward, success.copy(), truncated, info


class LazyVectorEnv:
    """Builds its environment at the first use and frees it on `close`, as LeRobot's own lazy vector does.

    `lerobot-eval` creates the environments of all tasks up front and evaluates them one after the other; built
    lazily, only one of them occupies memory and an OpenGL context at a time.
    """

    def __init__(self, make: Callable[[], CronosVectorEnv], num_envs: int):
        self._make, self.num_envs = make, num_envs
        self._env: CronosVectorEnv | None = None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if self._env is None:
            self._env = self._make()
        return getattr(self._env, name)

    def close(self, **kwargs) -> None:
        """Free the environment; the next use builds it again."""
        if self._env is not None:
            self._env.close()
            self._env = None


class CronosEnv(gym.Env):
    """One episode at a time, Gymnasium's single-environment form of `IndependentVectorEnv`.

    Args:
        scene: name of the scene.
        task: an instruction such as "put the ketchup bottle on the cloth", or None to draw one per episode.
        split: `train` or `held_out`.
        render_mode: None or `rgb_array`.
        **kwargs: see `CronosVectorEnv`.

    `reset(options={"configuration": i})` picks the i-th of `configurations`; otherwise the seeded generator draws.
    An episode is terminated when its task is complete. `gymnasium.make` truncates it after `max_episode_steps`, by
    default the steps of a task; this class alone has no limit. What is terminated stays so until the next
    `reset`: further steps change nothing, pay nothing, and return the same observation. `info["task"]` is the
    number of the task in the scene's `tasks`; `task_description` is its instruction.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        scene: str = "kitchen_2x2",
        *,
        task: str | None = None,
        split: str = "train",
        render_mode: str | None = None,
        **kwargs,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; valid: None, 'rgb_array'")
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": get_scene(scene).fps}
        chosen = find_task(scene, task)
        self._tasks = get_scene(scene).tasks if chosen is None else (chosen,)
        self._env = IndependentVectorEnv(
            1, scene, task=self._tasks[0], split=split, max_episode_steps=None, **kwargs
        )
        self.observation_space = self._env.single_observation_space
        self.action_space = self._env.single_action_space
        self._over = (False, False)

    @property
    def task_description(self) -> str:
        """The current language instruction."""
        return self._env.instructions[0]

    task = task_description
    """The same, by the other name that LeRobot asks for."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode; see the class."""
        super().reset(seed=None if seed is None else int(seed))
        chosen = check_options(options, ("configuration", *LEROBOT_OPTIONS)).get("configuration")
        start, self._env.task = draw_start(self.np_random, len(self._env.starts), self._tasks, chosen)
        observation, info = self._env.reset(seed=[start])
        self._over = (False, False)
        return take_row(observation, 0), self._describe(info)

    def step(self, action: np.ndarray):
        """Apply an action (a,) in physical units."""
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"the action must have shape {self.action_space.shape}, got {np.shape(action)}")
        observation, reward, terminated, truncated, info = self._env.step(np.asarray(action)[None])
        if not any(self._over):
            self._over = (bool(terminated[0]), bool(truncated[0]))
        return take_row(observation, 0), float(reward[0]), *self._over, self._describe(info)

    def _describe(self, info: dict[str, Any]) -> dict[str, Any]:
        return {name: values[0].item() for name, values in info.items()} | {
            "task": self._env.scene.tasks.index(self._env.task)
        }

    def render(self) -> np.ndarray | None:
        """Frame (height, width, 3) uint8 at `render_size`, or None without a render mode."""
        return self._env.render()[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the renderers."""
        self._env.close()


def _choose(configurations: Sequence[int] | None, available: int) -> np.ndarray:
    """The configurations that episodes start from, all by default."""
    if configurations is None:
        return np.arange(available)
    chosen = np.asarray(configurations)
    is_list = chosen.ndim == 1 and chosen.size > 0 and np.issubdtype(chosen.dtype, np.integer)
    if not is_list or chosen.min() < 0 or chosen.max() >= available:
        raise ValueError(f"configurations must be one or more of 0..{available - 1}, got {configurations!r}")
    return chosen


def draw_start(
    rng: np.random.Generator, num_starts: int, tasks: Sequence[Task], chosen: int | None = None
) -> tuple[int, Task]:
    """Draw where an episode starts, unless it is `chosen`, and its task.

    Raises:
        ValueError: `chosen` is no number of a configuration.
    """
    start = int(rng.integers(num_starts)) if chosen is None else chosen
    if not isinstance(start, int | np.integer) or not 0 <= start < num_starts:
        raise ValueError(f"configuration must be in 0..{num_starts - 1}, got {start!r}")
    return int(start), tasks[int(rng.integers(len(tasks)))]


def find_task(scene: str, instruction: str | None) -> Task | None:
    """Task of a scene by its instruction; None stays None, and a ValueError names the valid ones."""
    if instruction is None:
        return None
    tasks = {task.instruction: task for task in get_scene(scene).tasks}
    if instruction not in tasks:
        raise ValueError(f"unknown task {instruction!r} of {scene}; valid tasks: {list(tasks)}")
    return tasks[instruction]


def _scatter(into: dict[str, Any], rows: np.ndarray, batch: dict[str, Any]) -> None:
    for key, value in batch.items():
        if isinstance(value, dict):
            _scatter(into[key], rows, value)
        else:
            into[key][rows] = value


def _copy(batch: dict[str, Any]) -> dict[str, Any]:
    return {key: _copy(value) if isinstance(value, dict) else value.copy() for key, value in batch.items()}


def take_row(batch: dict[str, Any], i: int) -> dict[str, Any]:
    """A copy of row `i` of a batch."""
    return {
        key: take_row(value, i) if isinstance(value, dict) else value[i].copy() for key, value in batch.items()
    }
