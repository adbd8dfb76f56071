"""The native vector environment: all streams in one process, with explicit, counted interventions.

It never resets itself and never emits `terminated` or `truncated`: in reset-free training each intervention is
an event of the training loop. `lerobot_env_cronos.episodic` adds episodes for evaluation.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from lerobot_env_cronos.benchmark.configurations import check_split
from lerobot_env_cronos.benchmark.load import load_benchmark
from lerobot_env_cronos.benchmark.version import gymnasium_id
from lerobot_env_cronos.scene.scenes import BODIES, Task, get_scene
from lerobot_env_cronos.simulation.observations import ObservationBuilder, environment_state_names
from lerobot_env_cronos.simulation.simulation import Simulation, check_state
from lerobot_env_cronos.simulation.workspace import find_free_pose, find_unsuitable

GRASP_REWARD, SUCCESS_REWARD = 0.1, 1.0
LEROBOT_OPTIONS = ("lerobot_new_rollout",)
"""Of `reset`: what LeRobot's rollout says, which changes nothing here."""
REWARDS = ("difference", "level")


class EnvIdentity(NamedTuple):
    """What tells one environment from another: what both have in common is the same benchmark."""

    id: str
    """Gymnasium's, with the version."""
    fingerprint: str
    """Of the benchmark: configurations and chains."""
    source: str
    """Where these come from."""


class CronosVectorEnv(gym.vector.VectorEnv):
    """`num_envs` streams of one scene.

    Args:
        scene: name of the scene.
        obs_type: `pixels_agent_pos` or `environment_state_agent_pos`.
        privileged_state: add `environment_state` to pixel observations (for an asymmetric critic).
        observation_height, observation_width: size of the rendered observation [px].
        camera_name: camera(s) of the observation, comma-separated; `front`, and `bridge` or `wrist`, by the arm.
        reward: `level` pays 0.1 while the right object is grasped and 1.0 on success each step (paper, Section
            4); `difference` pays the change of that level between two steps (RL4VLA's code).
        num_threads: physics threads, and processes that draw in software; 0 for all cores; results do not depend
            on it.
        render_size: (height, width) of `render()` [px].
        renderer: `classic` (OpenGL) or `filament` (physically based, with shadows; slow without a GPU), of
            observations and of `render()`.
        benchmark: where the configurations come from: `<owner>/<repository>[@<revision>]` of a dataset on the Hub,
            or a folder; None for this package's.
        task_observation: `one_hot` appends which object and which receptacle is meant to `agent_pos`, for policies
            that read no instructions; `none` does not.
        flat_observation: put images beside the other observations, as `pixels_<camera>`, for libraries that take
            no nested observation space (Stable-Baselines3).

    Attributes:
        fps: control steps a second.
        steps_per_task: control steps that a task has.
        robot_type: LeRobot's, of datasets.
        tasks, reset_tasks: of the scene; `current_tasks` has the one of each stream.
        state_names, action_names: one for each number of `agent_pos` and of an action.
        num_starts: configurations by split.
        identity: what recordings, runs and results compare.
        timer: called with `physics`, `observe` or `reset`, returns the context in which that work is done; a
            training run hangs its stopwatch here.
    """

    metadata = {  # noqa: RUF012 - Gymnasium declares it this way
        "render_modes": ["rgb_array"],
        "autoreset_mode": gym.vector.AutoresetMode.DISABLED,
    }
    render_mode = "rgb_array"

    def __init__(
        self,
        num_envs: int,
        scene: str = "kitchen_2x2",
        *,
        obs_type: str = "pixels_agent_pos",
        privileged_state: bool = False,
        observation_height: int = 64,
        observation_width: int = 64,
        camera_name: str = "front",
        reward: str = "difference",
        num_threads: int = 0,
        render_size: tuple[int, int] = (480, 640),
        renderer: str = "classic",
        benchmark: str | None = None,
        task_observation: str = "none",
        flat_observation: bool = False,
    ):
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ValueError(f"num_envs must be a whole number of at least 1, got {num_envs!r}")
        if reward not in REWARDS:
            raise ValueError(f"unknown reward {reward!r}; valid rewards: {list(REWARDS)}")
        self.scene = get_scene(scene)
        self.benchmark = load_benchmark(benchmark, scene)
        self.num_envs = num_envs
        self.timer: Callable[[str], AbstractContextManager] = nullcontext
        self.reward = reward
        self._num_threads = num_threads
        self.simulation = Simulation(self.scene, num_envs, num_threads)
        self._observations = ObservationBuilder(
            self.simulation, obs_type, privileged_state, observation_height, observation_width, camera_name,
            render_size, renderer, task_observation, flat_observation,
        )  # fmt: skip
        self.state_names = list(self._observations.agent_pos_names)
        self.single_observation_space = self._observations.space
        arm = self.scene.robot
        # Rounded outwards: an action that was clipped to the bounds as float32 does exactly the same again.
        self._bounds = _round_outwards(arm.action_low, -np.inf), _round_outwards(arm.action_high, np.inf)
        self.single_action_space = gym.spaces.Box(*self._bounds, dtype=np.float32)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        self.fps, self.steps_per_task = self.scene.fps, self.scene.steps_per_task
        self.robot_type = self.scene.robot_type
        self.metadata = self.metadata | {"render_fps": self.fps}
        self.tasks, self.reset_tasks = self.scene.tasks, self.scene.reset_tasks
        self.action_names = list(arm.action_names)
        self.num_starts = self.benchmark.num_starts
        self.identity = EnvIdentity(gymnasium_id(scene), self.benchmark.fingerprint, self.benchmark.source)
        self.current_tasks: list[Task] = [self.scene.tasks[0]] * num_envs
        self.is_success = np.zeros(num_envs, dtype=bool)
        self.is_grasped = np.zeros(num_envs, dtype=bool)
        self._level = np.zeros(num_envs, dtype=np.float32)
        self._all = np.arange(num_envs)
        self.scene_reset(self._all, self._all % len(self.benchmark.configurations["train"]))

    @property
    def observation_details(self) -> dict[str, dict[str, Any]]:
        """What datasets say of the observations, by LeRobot's names: of what the numbers and the pictures are."""
        details: dict[str, dict[str, Any]] = {
            "observation.environment_state": {
                "names": list(environment_state_names(self.scene)),
                "keypoints": {
                    name.replace(" ", "_"): [list(point) for point in BODIES[name].keypoints]
                    for name in self.scene.bodies
                },
            }
        }
        # Without the bodies' poses, pictures are described as a real robot's are: LeRobot merges both.
        for camera in self._observations.cameras if self._observations.privileged else ():
            chosen = self.scene.robot.cameras[camera]
            # That of a camera that moves is another one in every picture.
            if chosen.body is None:
                projection = chosen.projection(*self._observations.size)
                details[f"observation.images.{camera}"] = {"projection": projection.tolist()}
        return details

    # Gymnasium --------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None):
        """Scene-reset every stream to a training configuration, of n: `(seed + i) % n`, or `seeds[i] % n`."""
        check_options(options, LEROBOT_OPTIONS)
        super().reset(seed=as_one_seed(seed))
        starts = np.arange(len(self.benchmark.configurations["train"]))
        self.scene_reset(self._all, self._choose_starts(seed, starts))
        return self.observe(), self._info()

    def _choose_starts(self, seed: int | Sequence[int] | None, starts: np.ndarray) -> np.ndarray:
        """One of the configurations `starts` (k,) for each stream, by its seed."""
        if seed is None:
            return starts[self.np_random.integers(len(starts), size=self.num_envs)]
        seeds = seed + self._all if isinstance(seed, int | np.integer) else np.asarray(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"got {len(seeds)} seeds for {self.num_envs} environments")
        if not np.issubdtype(seeds.dtype, np.integer):
            raise ValueError(f"seeds must be whole numbers, one for each environment, got {seed!r}")
        return starts[seeds % len(starts)]

    def step(self, actions: np.ndarray):
        """Apply actions (n, a) in physical units; out-of-bounds values are clipped.

        Returns the observation under the task that was acted on, the reward (n,), all-False `terminated` and
        `truncated`, and `info` with (n,) arrays `is_success`, `is_grasped`, `diverged`, and `executed_action`
        (n, a) float32: what was applied after clipping. Applied to the same state it does the same again.

        Raises:
            ValueError: wrong shape, or an action that is not finite.
        """
        reward, diverged = self.step_streams(actions, self._all)
        never = np.zeros(self.num_envs, dtype=bool)
        executed = np.clip(np.asarray(actions, dtype=np.float32), *self._bounds)
        info = self._info() | {"diverged": diverged, "executed_action": executed}
        return self.observe(), reward, never, never.copy(), info

    def step_streams(self, actions: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`step` for streams `ids` (k,) alone, without an observation; the others stay as they are.

        Returns the reward (n,) and `diverged` (n,); `is_success` and `is_grasped` are attributes.
        """
        ids = self._check_ids(ids, rising=True)
        actions = np.asarray(actions, dtype=np.float64)
        shape = (self.num_envs, len(self.action_names))
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, got {actions.shape}")
        bad = ~np.isfinite(actions[ids]).all(axis=1)
        if bad.any():
            raise ValueError(f"actions of environments {ids[bad].tolist()} are not finite: {actions[ids[bad]]}")
        arm, diverged = self.scene.robot, np.zeros(self.num_envs, dtype=bool)
        before = self._level.copy()
        with self.timer("physics"):
            diverged[ids] = self.simulation.step(np.clip(actions[ids], arm.action_low, arm.action_high), ids)
            self._judge(ids)
        reward = self._level - before if self.reward == "difference" else self._level.copy()
        return reward, diverged

    def observe(self, ids: np.ndarray | None = None) -> dict[str, Any]:
        """The observation now, under the current tasks: of all streams, or with one row for each of `ids`."""
        with self.timer("observe"):
            chosen = self._all if ids is None else self._check_ids(ids)
            return self._observations.observe(chosen, [self.current_tasks[i] for i in chosen])

    def observe_under(self, tasks: Sequence[Task]) -> list[dict[str, Any]]:
        """What `observe` would say of all streams under each of `tasks`; drawn once, so pictures are shared."""
        with self.timer("observe"):
            seen = self._observations.observe(self._all, self.current_tasks)
            return [self._observations.tell(seen, [task] * self.num_envs) for task in tasks]

    def find_complete(self, tasks: Sequence[Task]) -> np.ndarray:
        """Whether each of `tasks` is complete in each stream, (n, len(tasks)) bool, whatever its own task is."""
        return np.stack([self._holds(task) for task in tasks], axis=1)

    def _holds(self, task: Task) -> np.ndarray:
        sim = self.simulation
        return sim.is_on_table(task.object) if task.receptacle is None else sim.is_on(*_pair(task))

    def _info(self) -> dict[str, np.ndarray]:
        return {"is_success": self.is_success.copy(), "is_grasped": self.is_grasped.copy()}

    def _judge(self, ids: np.ndarray) -> None:
        """Evaluate success, grasp and the reward level of the current tasks of `ids`."""
        sim = self.simulation
        for task in {self.current_tasks[i] for i in ids}:
            mine = np.array([i for i in ids if self.current_tasks[i] == task])
            self.is_success[mine] = self._holds(task)[mine]
            self.is_grasped[mine] = sim.is_grasped(task.object)[mine]
        level = np.where(self.is_success, SUCCESS_REWARD, np.where(self.is_grasped, GRASP_REWARD, 0.0))
        self._level[ids] = level[ids]

    # Interventions ----------------------------------------------------------------------------------------

    def _check_ids(self, ids: Iterable[int], rising: bool = False) -> np.ndarray:
        """Return `ids` as an array (k,) of integers.

        Raises:
            ValueError: they are no numbers of streams; a mask, say, which would count as streams 0 and 1. Or they
                are not `rising`, each once, where MuJoCo needs them so.
        """
        ids = np.asarray(ids)
        if ids is self._all:
            return ids
        if ids.shape == (0,):
            return ids.astype(int)
        valid = ids.ndim == 1 and ids.dtype.kind in "iu" and ids.min() >= 0 and ids.max() < self.num_envs
        if not valid or (rising and (ids[1:] <= ids[:-1]).any()):
            order = ", rising, each once" if rising else ""
            raise ValueError(
                f"ids must be integers in 0..{self.num_envs - 1}{order}, got {ids.tolist()}; those of a mask (n,) "
                "bool are np.flatnonzero(mask)"
            )
        return ids

    def scene_reset(self, ids: np.ndarray, starts: np.ndarray, split: str = "train") -> None:
        """Put every body of streams `ids` at benchmark configurations `starts` (k,) of a split, and the arm home.

        Raises:
            ValueError: unknown split, or there is no such configuration or stream.
        """
        check_split(split)
        poses = self.benchmark.configurations[split]
        if np.max(starts, initial=0) >= len(poses) or np.min(starts, initial=0) < 0:
            valid = f"0 to {len(poses) - 1} of {split}, benchmark {self.benchmark.source}"
            raise ValueError(f"configurations must be {valid}, got {np.asarray(starts).tolist()}")
        self.place_bodies(ids, poses[starts])

    def place_bodies(self, ids: np.ndarray, poses: np.ndarray) -> None:
        """Put every body of streams `ids` at `poses` (k, bodies, 7), and the arm home."""
        ids = self._check_ids(ids, rising=True)
        with self.timer("reset"):
            self.simulation.place(ids, poses)
            self._judge(ids)

    def end_effector_reset(self, ids: np.ndarray) -> None:
        """Put the arm of streams `ids` home, gripper open; bodies stay (a held one drops and settles)."""
        ids = self._check_ids(ids, rising=True)
        with self.timer("reset"):
            self.simulation.send_arm_home(ids)
            self._judge(ids)

    def unsuitable_bodies(self) -> np.ndarray:
        """Bodies that no task can reach any more, (n, bodies) bool; see `workspace.find_unsuitable`."""
        return np.any(list(find_unsuitable(self.simulation).values()), axis=0)

    def put_back(self, stream: int, body: int, rng: np.random.Generator) -> None:
        """Put one body of a stream, by its number in the scene, at a free place drawn from `rng`.

        On a table without a free place it is let fall over a random one.
        """
        ids, name = self._check_ids([stream]), self.scene.bodies[body]
        pose = find_free_pose(self.simulation, stream, name, rng)
        self.simulation.move_body(ids, name, pose[None])
        self._judge(ids)

    def set_task(self, ids: Iterable[int], tasks: Sequence[Task]) -> None:
        """Give streams `ids` their tasks; the reward's level starts from the state as it is.

        Raises:
            ValueError: one is none of `scene.tasks` and `scene.reset_tasks`, there are not as many as streams, or
                there is no such stream; all streams keep theirs.
        """
        valid = self.scene.tasks + self.scene.reset_tasks
        ids = self._check_ids(ids)
        given = list(zip(ids, tasks, strict=True))
        if unknown := [task for task in tasks if task not in valid]:
            by_name = "a Task, not its instruction, is needed; " if isinstance(unknown[0], str) else ""
            raise ValueError(f"unknown task {unknown[0]!r}: {by_name}valid tasks: {list(valid)}")
        for i, task in given:
            self.current_tasks[i] = task
        self._judge(ids)

    def _state_arrays(self) -> dict[str, np.ndarray]:
        """What decides what steps do, besides the simulation and the tasks: live arrays (n, ...)."""
        return {"level": self._level, "is_success": self.is_success, "is_grasped": self.is_grasped}

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that decides what steps do, as numpy arrays; see `Simulation.get_state`.

        Not what a `reset()` without a seed will draw.
        """
        valid = self.scene.tasks + self.scene.reset_tasks
        own = {name: array.copy() for name, array in self._state_arrays().items()}
        return (
            self.simulation.get_state()
            | {"task": np.array([valid.index(task) for task in self.current_tasks])}
            | own
        )

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue, bit for bit, from a state taken by `get_state`.

        Raises:
            ValueError: it is of another scene, number of streams or kind of environment; nothing changes.
        """
        arrays = self._state_arrays()
        check_state(state, arrays | {"task": self._all})
        self.simulation.set_state(state)
        valid = self.scene.tasks + self.scene.reset_tasks
        self.current_tasks = [valid[i] for i in state["task"]]
        for name, array in arrays.items():
            array[:] = state[name]

    def __getstate__(self) -> dict[str, Any]:
        """For pickle and `copy.deepcopy`: a copy continues bit for bit, without the renderers and the timer."""
        kept = {name: value for name, value in self.__dict__.items() if name not in ("simulation", "timer")}
        return kept | {"simulation": self.simulation.get_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.timer = nullcontext
        self.simulation = Simulation(self.scene, self.num_envs, self._num_threads)
        self.simulation.set_state(state["simulation"])
        self._observations.simulation = self.simulation

    # LeRobot ----------------------------------------------------------------------------------------------

    @property
    def instructions(self) -> list[str]:
        """The language instruction of every stream."""
        return [task.instruction for task in self.current_tasks]

    def render(self) -> tuple[np.ndarray, ...]:
        """One frame (height, width, 3) uint8 per stream at `render_size`."""
        return tuple(self.render_streams(self._all))

    def render_streams(self, ids: np.ndarray) -> np.ndarray:
        """Frames (k, height, width, 3) uint8 of some streams."""
        return self.render_positions(self.positions(ids))

    def positions(self, ids: np.ndarray) -> np.ndarray:
        """All that a picture of streams `ids` shows: MuJoCo's generalised positions now, float64 (k, nq)."""
        return self.simulation.qpos[ids]

    def render_positions(self, qpos: np.ndarray) -> np.ndarray:
        """Frames (k, height, width, 3) uint8 at `render_size` of `positions`; any thread may ask for them."""
        return self._observations.render(qpos)

    def call(self, name: str, *args, **kwargs) -> Sequence:
        """What LeRobot asks of the sub-environments of a vector env."""
        if name == "render":
            return LazyFrames(self)
        return self.get_attr(name)

    def get_attr(self, name: str) -> tuple:
        """One value per stream: `task_description`, `task` or any attribute of this env."""
        if name in ("task_description", "task"):
            return tuple(self.instructions)
        return (getattr(self, name),) * self.num_envs

    def close_extras(self, **kwargs) -> None:
        """Free the renderers."""
        self._observations.close()


def _round_outwards(bound: np.ndarray, towards: float) -> np.ndarray:
    nearest = bound.astype(np.float32)
    inside = nearest > bound if towards < 0 else nearest < bound
    return np.where(inside, np.nextafter(nearest, np.float32(towards)), nearest)


def as_one_seed(seed: int | Sequence[int | None] | None) -> int | None:
    """The seed of what an environment draws for all of its streams, from that of `reset`."""
    if seed is None or isinstance(seed, int | np.integer):
        return None if seed is None else int(seed)
    given = [0 if one is None else int(one) for one in seed]
    return int(np.random.SeedSequence(given).generate_state(1)[0])


def check_options(options: dict[str, Any] | None, valid: Sequence[str]) -> dict[str, Any]:
    """The options of a `reset`; a ValueError names what is unknown and what is valid."""
    if not isinstance(options, dict | None):
        raise ValueError(f"options of reset must be a dict, got {options!r}")
    unknown = sorted(set(options or {}) - set(valid))
    if unknown:
        raise ValueError(f"unknown options {unknown} of reset; valid options: {list(valid)}")
    return options or {}


class LazyFrames(Sequence):
    """The frames of all streams, rendered when they are asked for: LeRobot slices off the few it keeps."""

    def __init__(self, env: CronosVectorEnv):
        self._env = env

    def __len__(self) -> int:
        return self._env.num_envs

    def __getitem__(self, index):
        ids = np.arange(len(self))[index]
        frames = self._env.render_streams(np.atleast_1d(ids))
        return list(frames) if isinstance(index, slice) else frames[0]


def _pair(task: Task) -> tuple[str, str]:
    assert task.receptacle is not None
    return task.object, task.receptacle
