"""Episodes that follow one another by themselves: what `gymnasium.make_vec` makes of a scene."""

import json
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode

from lerobot_env_cronos.episodic import IndependentVectorEnv, draw_start, find_task, take_row
from lerobot_env_cronos.scene.scenes import get_scene
from lerobot_env_cronos.simulation.simulation import check_state
from lerobot_env_cronos.vector_env import LEROBOT_OPTIONS, as_one_seed, check_options


class CronosGymVectorEnv(IndependentVectorEnv):
    """`num_envs` episodes at a time, each the same as `CronosEnv`'s of its seed, reset by Gymnasium's rules.

    An episode is `terminated` when its task is complete and `truncated` after `max_episode_steps`, by default the
    steps of a task.
    `info["task"]` (n,) has the numbers of the tasks in the scene's `tasks`; `instructions` says what they mean.

    Args:
        num_envs: episodes at a time.
        scene: name of the scene.
        task: an instruction, or None to draw one for each episode.
        split: `train` or `held_out`.
        autoreset_mode: a `gymnasium.vector.AutoresetMode` or its value. `NextStep`: the step after an episode's
            end ignores the action, starts the next one, pays nothing and returns its first observation.
            `SameStep`: the ending step returns the next episode's first observation, and `info` the last one as
            `final_obs` and `final_info`, with masks `_final_obs` and `_final_info`. `Disabled`: what is over
            stays as it is until `reset(options={"reset_mask": ...})`.
        render_mode: None, with which `render` returns None, or `rgb_array`.
        **kwargs: see `CronosVectorEnv`.

    Of `reset`'s options, `configuration` is where all episodes start, and `reset_mask` (n,) bool who is reset.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scene: str = "kitchen_2x2",
        *,
        task: str | None = None,
        split: str = "train",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **kwargs,
    ):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; valid: None, 'rgb_array'")
        modes = [mode.value for mode in AutoresetMode]
        if autoreset_mode not in [*modes, *AutoresetMode]:
            raise ValueError(f"unknown autoreset_mode {autoreset_mode!r}; valid values: {modes}")
        chosen = find_task(scene, task)
        self._choices = get_scene(scene).tasks if chosen is None else (chosen,)
        super().__init__(num_envs, scene, task=self._choices[0], split=split, **kwargs)
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self._generators = [np_random()[0] for _ in range(num_envs)]

    def get_state(self) -> dict[str, np.ndarray]:
        """See `CronosVectorEnv.get_state`; with the generators that draw the next episodes, as JSON."""
        drawn = [json.dumps(generator.bit_generator.state) for generator in self._generators]
        return super().get_state() | {"generators": np.array(drawn)}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """See `CronosVectorEnv.set_state`."""
        check_state(state, {"generators": self._all})
        super().set_state(state)
        for generator, text in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = json.loads(str(text))

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None):
        """Start an episode in every environment; environment i is seeded with `seed + i` or `seeds[i]`."""
        gym.vector.VectorEnv.reset(self, seed=as_one_seed(seed))
        options = check_options(options, ("configuration", "reset_mask", *LEROBOT_OPTIONS))
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(f"reset_mask must be ({self.num_envs},) bool with a True in it, got {mask}")
        is_one = seed is None or isinstance(seed, int | np.integer)
        seeds = [None if seed is None else seed + i for i in self._all] if is_one else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"got {len(seeds)} seeds for {self.num_envs} environments")
        ids = self._all[mask]
        for i in ids:
            if seeds[i] is not None:
                self._generators[i] = np_random(int(seeds[i]))[0]
        self._begin(ids, options.get("configuration"))
        info = {"is_success": self.is_success.copy(), "is_grasped": self.is_grasped.copy()}
        return self.observe_running(ids), self._mark(info, mask)

    def step(self, actions: np.ndarray):
        """Step the running episodes, and start the next ones as `autoreset_mode` says."""
        starting = self.done.copy()
        observation, reward, terminated, truncated, info = super().step(actions)
        info = self._mark(info, np.ones(self.num_envs, dtype=bool))
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            starting = terminated | truncated
            names = ("is_success", "is_grasped", "diverged", "task")
            for i in self._all[starting]:
                last = {name: info[name][i].item() for name in names}
                info = self._add_info(info, {"final_obs": take_row(observation, i), "final_info": last}, i)
        if self.autoreset_mode is not AutoresetMode.DISABLED and starting.any():
            ids = self._all[starting]
            self._begin(ids)
            observation = self.observe_running(ids)
            new = {"is_success": self.is_success, "is_grasped": self.is_grasped, "task": self._task_numbers()}
            for name, value in new.items():
                info[name][ids] = value[ids]
            info["diverged"][ids] = False
        return observation, reward, terminated, truncated, info

    # None as by Gymnasium's VectorEnv; CronosVectorEnv, which has no such argument, always renders.
    def render(self) -> tuple[np.ndarray, ...] | None:  # ty: ignore[incompatible-method-override]
        """See `CronosVectorEnv.render`; None without a render mode."""
        return super().render() if self.render_mode == "rgb_array" else None

    def _begin(self, ids: np.ndarray, configuration: int | None = None) -> None:
        """Start an episode in each of the environments `ids`, drawn from its generator."""
        drawn = [draw_start(self._generators[i], len(self.starts), self._choices, configuration) for i in ids]
        self.scene_reset(ids, self.starts[[start for start, _ in drawn]], self.split)
        self.set_task(ids, [task for _, task in drawn])
        self.done[ids] = False
        self._elapsed[ids] = 0

    def _mark(self, info: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
        """Add the numbers of the tasks, and Gymnasium's masks of who has what."""
        info = info | {"task": self._task_numbers()}
        return info | {f"_{name}": mask.copy() for name in info}

    def _task_numbers(self) -> np.ndarray:
        return np.array([self.scene.tasks.index(task) for task in self.current_tasks])
