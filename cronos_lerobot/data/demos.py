"""Demonstrations of the scripted expert, as a LeRobotDataset: every task, from many starts, in balance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from lerobot.utils.constants import ACTION, DONE, REWARD
from lerobot_env_cronos import CronosVectorEnv, Scene, Task

from cronos_lerobot.agents.processing import observation_columns
from cronos_lerobot.data.demo_starts import FREE_LAYOUTS, StartConfig, check_starts, other_tasks, tasks_before
from cronos_lerobot.data.perturbations import (
    ActionNoise,
    GraspMisses,
    MissConfig,
    MistakenGrasps,
    NoiseConfig,
    move_arm_at_random,
)
from cronos_lerobot.data.schema import CONFIGURATION, SUCCESS, TRUNCATED
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.ranges import ranged

MAX_FAILURES_IN_A_ROW = 200


class ExpertError(RuntimeError):
    """The expert cannot demonstrate what was asked for."""


class Expert(Protocol):
    """A reactive controller of a vector environment."""

    def reset(self, ids: np.ndarray) -> None:
        """Forget what happened in the streams `ids`; a new task begins there."""

    def act(self) -> np.ndarray:
        """Actions (n, 7) in physical units for the environment's state as it is now."""


@dataclass
class DemoConfig:
    """What a demonstration is."""

    max_steps: int | None = ranged(None, minimum=1)
    """Control steps until an episode counts as failed, also if its object has lain too short by then; null takes
    those of a task of the scene."""
    steps_after_release: int = ranged(3, minimum=0)
    """Frames kept after the object lies on its receptacle and is released."""
    keep_failures: bool = False
    """Also keep episodes that did not succeed within `max_steps`."""
    reset_tasks: bool = False
    """Demonstrate "put the [object] on the table" as well, as often as any other task, each from a receptacle."""
    record_perturbed: bool = True
    """Also record the frames of noise and misses, each with the action that the expert would have taken. With
    `false` a recording begins anew after them: for policies that predict chunks of actions, of which the later
    ones would lead where the expert was pushed."""
    start: StartConfig = field(default_factory=StartConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    misses: MissConfig = field(default_factory=MissConfig)


def check_arm(config: DemoConfig, scene: Scene) -> None:
    """Raise a ValueError for what is shown by the WidowX alone."""
    if scene.arm != "widowx" and config.start.arm_pose == "random":
        raise ValueError(f"--start.arm_pose=random is for the WidowX, {scene.name} has {scene.arm}")


@dataclass
class _Episode:
    """One attempt of a stream. Its `preludes` are carried out, unrecorded, before the task itself."""

    task: Task
    configuration: int
    preludes: list[Task]
    """Those that are not done yet, the next one first."""
    at_home: bool
    rng: np.random.Generator
    arm_goes_home: bool = False
    """After what was done before."""
    settling: bool = True
    steps: int = 0
    released: int = 0
    frames: dict[str, list] = field(default_factory=dict)


def tasks_of(config: DemoConfig, scene: Scene) -> Sequence[Task]:
    """What is demonstrated in a scene, unless the tasks are chosen."""
    return scene.tasks + (scene.reset_tasks if config.reset_tasks else ())


class DemoCollector:
    """Lets the expert act in all streams at once and writes each finished episode.

    A stream is reset on its own, as soon as its episode is over. It then spends one unrecorded step at rest:
    the observation after that step is the episode's first, and no frame is rendered twice.
    """

    def __init__(
        self,
        env: CronosVectorEnv,
        expert: Expert,
        writer: SegmentWriter,
        config: DemoConfig,
        *,
        seed: int = 0,
        tasks: Sequence[Task] | None = None,
    ) -> None:
        """Collect from all streams of `env` into `writer`, which may already hold episodes.

        Args:
            env: its layouts, arm poses and tasks are set by this class.
            expert: acts in `env`.
            writer: its features are those of `demonstration_features`.
            config: what a demonstration is.
            seed: decides layouts, noise, misses and starts.
            tasks: to demonstrate; all of the scene's when None, with its reset tasks if `config` says so.
        """
        self.env, self.expert, self.writer, self.config = env, expert, writer, config
        self.finished, self.successes = 0, 0
        self._started = 0
        self._seed = (seed, writer.num_episodes)
        tasks = tasks or tasks_of(config, env.scene)
        self._kept = {task: writer.episodes_before[task.instruction] for task in tasks}
        # A resumed dataset begins with the next configuration, as far as the attempts succeeded.
        self._tried = dict(self._kept)
        self._episodes: list[_Episode | None] = [None] * env.num_envs
        self._arm = env.scene.robot
        self._max_steps = config.max_steps or env.steps_per_task
        self._noise = ActionNoise(config.noise, env.num_envs, self._arm)
        self._misses = (GraspMisses if env.scene.arm == "widowx" else MistakenGrasps)(config.misses, env)
        self._failures_in_a_row = 0
        check_starts(config.start, env.scene, tasks)

    def collect(self, num_episodes: int, on_episode: Callable[[int], object] = lambda frames: None) -> None:
        """Write `num_episodes` more episodes: in the end each task has the same number, as far as that divides.

        Args:
            num_episodes: how many.
            on_episode: called with the number of frames of each episode written.

        Raises:
            ExpertError: the expert failed 200 times in a row.
        """
        self._on_episode = on_episode
        total = sum(self._kept.values()) + num_episodes
        self._start_idle_streams(total)
        observation = self.env.observe()
        while any(episode is not None for episode in self._episodes):
            arm = self._arm
            labels = np.clip(self.expert.act(), arm.action_low, arm.action_high).astype(np.float32)
            columns = observation_columns(observation) | {ACTION: labels}
            executed = self._perturb(labels)
            is_left_out = (executed != labels).any(1) & (not self.config.record_perturbed)
            observation, reward, _, _, info = self.env.step(executed)
            columns |= {REWARD: reward, SUCCESS: info["is_success"]}
            for stream in range(self.env.num_envs):
                self._after_step(stream, columns, info, is_left_out[stream])
            self._start_idle_streams(total)

    def _perturb(self, labels: np.ndarray) -> np.ndarray:
        recording = np.array([episode is not None and not episode.preludes for episode in self._episodes])
        executed = self._misses.apply(labels, recording)
        executed = self._noise.apply(executed, recording)
        resting = self._arm.hold(self.env.simulation.arm_target)
        for stream, episode in enumerate(self._episodes):
            if episode is None or episode.settling:
                executed[stream] = resting[stream]
        return executed

    def _after_step(
        self, stream: int, columns: Mapping[str, np.ndarray], info: Mapping[str, np.ndarray], is_left_out: bool
    ) -> None:
        episode = self._episodes[stream]
        if episode is None:
            return
        if episode.settling:
            episode.settling = False
            if not episode.preludes and info["is_success"][stream]:
                self._discard(stream, episode)
            return
        episode.steps += 1
        resting = info["is_success"][stream] and not info["is_grasped"][stream]
        episode.released = episode.released + 1 if resting else 0
        if is_left_out:
            episode.frames.clear()
        elif not episode.preludes:
            for key, column in columns.items():
                episode.frames.setdefault(key, []).append(column[stream].copy())
        succeeded = episode.released > self.config.steps_after_release
        is_late = episode.steps >= self._max_steps
        if info["diverged"][stream]:
            self._end(stream, episode, succeeded=False, keep=False)
        elif succeeded and episode.preludes:
            self._end_prelude(stream, episode)
        elif succeeded:
            self._end(stream, episode, succeeded=True, keep=True)
        elif is_late:
            self._end(stream, episode, succeeded=False, keep=self.config.keep_failures and not episode.preludes)

    def _end(self, stream: int, episode: _Episode, *, succeeded: bool, keep: bool) -> None:
        self._episodes[stream] = None
        self.finished += 1
        self.successes += succeeded
        if succeeded:
            self._failures_in_a_row = 0
        else:
            last = f"to {episode.task.instruction!r} within --max_steps={self._max_steps}"
            self._count_failure("the expert failed", last)
        if keep and episode.frames:
            frames = {key: np.stack(values) for key, values in episode.frames.items()}
            length = len(frames[ACTION])
            is_last = np.arange(length) == length - 1
            # The expert stops because its task is done; a failure that is kept ran out of time.
            frames |= {DONE: is_last & succeeded, TRUNCATED: is_last & (not succeeded)}
            # As in a stream: a failure may have lost again what it had put in its place.
            metadata = {CONFIGURATION: episode.configuration, SUCCESS: bool(frames[SUCCESS].any())}
            self.writer.add_segment(frames, episode.task.instruction, episode_metadata=metadata)
            self._kept[episode.task] += 1
            self._on_episode(length)

    def _end_prelude(self, stream: int, episode: _Episode) -> None:
        ids = np.array([stream])
        del episode.preludes[0]
        if episode.preludes:
            self._begin_prelude(ids, episode)
            return
        if episode.arm_goes_home:
            self.env.end_effector_reset(ids)
        self._begin_task(ids, episode)

    def _discard(self, stream: int, episode: _Episode) -> None:
        """Nothing can be shown: the task was complete from the start."""
        self._episodes[stream] = None
        self._count_failure("the start was complete, or the expert failed,", repr(episode.task.instruction))

    def _count_failure(self, what: str, last: str) -> None:
        """One more attempt came to nothing; give up after too many without a success between them."""
        self._failures_in_a_row += 1
        if self._failures_in_a_row >= MAX_FAILURES_IN_A_ROW:
            raise ExpertError(f"{what} {MAX_FAILURES_IN_A_ROW} times in a row, last {last}")

    def _start_idle_streams(self, total: int) -> None:
        """Give every idle stream an episode of the task that has the fewest, until enough are under way."""
        under_way = dict(self._kept)
        for episode in self._episodes:
            if episode is not None:
                under_way[episode.task] += 1
        for stream, episode in enumerate(self._episodes):
            if episode is None and sum(under_way.values()) < total:
                task = min(under_way, key=lambda task: under_way[task])
                under_way[task] += 1
                self._episodes[stream] = self._new_episode(stream, task)

    def _new_episode(self, stream: int, task: Task) -> _Episode:
        rng = np.random.default_rng((*self._seed, self._started))
        available = len(self.env.benchmark.configurations["train"])
        number = self._tried[task] % min(self.config.start.num_configurations, available)
        self._tried[task] += 1
        self._started += 1
        start, ids = self.config.start, np.array([stream])
        if start.layouts == "train":
            self.env.scene_reset(ids, np.array([number]))
        else:
            number = -1
            self.env.place_bodies(ids, FREE_LAYOUTS[start.layouts](self.env.scene, rng)[None])
        episode = _Episode(task, number, preludes=[], at_home=rng.random() >= start.share, rng=rng)
        # An object that lies on the table from the start would leave nothing to show of its reset task.
        if task.receptacle is None or (start.is_after_another and not episode.at_home):
            earlier = [] if episode.at_home else self._earlier(task, rng)
            episode.preludes = [*earlier, self._prelude(task, rng)]
            episode.arm_goes_home = episode.at_home or start.arm_pose == "home"
            if start.arm_pose == "either" and not episode.at_home:
                episode.arm_goes_home = bool(rng.random() < 0.5)
            self._begin_prelude(ids, episode)
        else:
            self._begin_task(ids, episode)
        return episode

    def _earlier(self, task: Task, rng: np.random.Generator) -> list[Task]:
        """What was done before the last task before; never the task itself, which would be found complete."""
        most = self.config.start.earlier_tasks
        if most <= 1:
            return []
        count, others = int(rng.integers(most)), other_tasks(task, self.env.scene)
        return [others[i] for i in rng.integers(len(others), size=count)]

    def _prelude(self, task: Task, rng: np.random.Generator) -> Task:
        """What was done before."""
        choices = tasks_before(task, self.env.scene, self.config.start)
        return choices[rng.integers(len(choices))]

    def _begin_prelude(self, ids: np.ndarray, episode: _Episode) -> None:
        self.env.set_task(ids, episode.preludes[:1])
        self.expert.reset(ids)
        episode.steps, episode.released = 0, 0

    def _begin_task(self, ids: np.ndarray, episode: _Episode) -> None:
        if self.config.start.arm_pose == "random" and not episode.at_home:
            move_arm_at_random(self.env, int(ids[0]), episode.rng)
        self.env.set_task(ids, [episode.task])
        self.expert.reset(ids)
        self._noise.reset(ids[0], episode.rng)
        self._misses.reset(ids[0], episode.rng)
        episode.settling, episode.steps, episode.released = True, 0, 0
