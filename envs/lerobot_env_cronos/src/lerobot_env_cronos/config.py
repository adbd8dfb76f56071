"""`--env.type=cronos` and `cronos_hub`: the LeRobot configurations of the CRONOS scenes."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Any, TypeGuard

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, HubEnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_env_cronos.benchmark.benchmark import SUITES, EpisodeGroup
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.benchmark.files import check_tag, fetch_benchmark
from lerobot_env_cronos.benchmark.load import benchmark_scene, load_benchmark
from lerobot_env_cronos.episodic import EpisodicVectorEnv, IndependentVectorEnv, LazyVectorEnv
from lerobot_env_cronos.scene.scenes import get_scene
from lerobot_env_cronos.sequential import ADVANCES, SequentialVectorEnv
from lerobot_env_cronos.simulation.observations import (
    OBS_TYPES,
    TASK_OBSERVATIONS,
    agent_pos_names,
    environment_state_names,
    parse_cameras,
)
from lerobot_env_cronos.simulation.rendering import RENDERERS
from lerobot_env_cronos.vector_env import CronosVectorEnv

DEFAULT_SCENE = "kitchen_2x2"
CHOICES = {
    "suite": SUITES,
    "split": SPLITS,
    "advance": ADVANCES,
    "obs_type": OBS_TYPES,
    "renderer": RENDERERS,
    "task_observation": TASK_OBSERVATIONS,
}


@EnvConfig.register_subclass("cronos")
@dataclass
class CronosEnvConfig(EnvConfig):
    """Shared-scene pick and place (CRONOS, Section 4), by the arm that the scene has."""

    task: str | None = None
    """What to evaluate of the suite: an instruction (independent), or the number of an ordering, 0 to 9
    (sequential); null for all."""
    fps: int = 0
    """Control frequency [Hz]: the scene's, 5 or 30; 0 for that. No other is valid."""
    scene: str = ""
    """Scene: kitchen_2x2, kitchen_3x3, playroom_2x2, or a registered one; by default the benchmark's, or
    kitchen_2x2."""
    suite: str = "independent"
    """Evaluation suite: independent (every task from every configuration, within the steps of a task), or
    sequential (chains of all tasks without a reset in between, in ten orderings)."""
    split: str = "train"
    """Configurations: train or held_out, 64 each."""
    benchmark: str | None = None
    """A benchmark of its author's own configurations and chains: <owner>/<repository>[@<revision>] of a dataset on
    the Hub, or a folder; null for this package's."""
    advance: str = "window"
    """When a chain (--env.suite=sequential) continues to its next task: window (when the task's steps are over) or
    on_success (at once)."""
    end_effector_reset: bool = False
    """Send the arm home between the tasks of a chain (--env.suite=sequential)."""
    obs_type: str = "pixels_agent_pos"
    """pixels_agent_pos, or environment_state_agent_pos for the privileged state instead of pixels."""
    task_observation: str = "none"
    """one_hot appends which object and which receptacle is meant to observation.state, for policies that read no
    instructions (ACT, Diffusion); none does not."""
    privileged_state: bool = False
    """Add observation.environment_state to pixel observations: labels for cloning, or for an asymmetric critic."""
    observation_height: int = 64
    """Height of the observed image [px]."""
    observation_width: int = 64
    """Width of the observed image [px]."""
    camera_name: str = "front"
    """Camera(s), comma-separated: front (sees every body); bridge (the Bridge set-up's third-person view) of the
    WidowX, wrist (moves with the gripper) of the SO-101."""
    render_size: tuple[int, int] = (480, 640)
    """Height and width of videos [px]."""
    renderer: str = "classic"
    """Of observations and videos: classic (OpenGL), or filament (physically based, with shadows; needs Vulkan, and
    is slow without a GPU)."""
    num_threads: int = 0
    """Physics threads, and processes that draw in software; 0 for all cores; results do not depend on it."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self):
        try:
            self._build()
        except ValueError as error:
            _end_in_one_line(error)
            raise

    def _build(self) -> None:
        """Check the fields and derive the features from them."""
        self.scene = self.scene or (benchmark_scene(self.benchmark) if self.benchmark else DEFAULT_SCENE)
        scene = get_scene(self.scene)
        for name, valid in CHOICES.items():
            if getattr(self, name) not in valid:
                raise ValueError(f"unknown env.{name} {getattr(self, name)!r}; valid values: {list(valid)}")
        cameras = parse_cameras(scene, self.camera_name)
        if self.fps not in (0, scene.fps):
            raise ValueError(f"env.fps of {scene.name} is fixed at {scene.fps} Hz by the protocol, got {self.fps}")
        self.fps = scene.fps
        if self.max_parallel_tasks != 1:
            raise ValueError(
                f"env.max_parallel_tasks must be 1, got {self.max_parallel_tasks}: parallel threads would share "
                "the one policy and its memory. --eval.batch_size runs episodes in parallel"
            )
        self._chosen()
        pixels = self.obs_type == "pixels_agent_pos"
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(scene.robot.action_names),))}
        self.features["agent_pos"] = PolicyFeature(
            FeatureType.STATE, (len(agent_pos_names(scene, self.task_observation)),)
        )
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        if self.privileged_state or not pixels:
            size = len(environment_state_names(scene))
            self.features["environment_state"] = PolicyFeature(FeatureType.ENV, (size,))
            self.features_map["environment_state"] = OBS_ENV_STATE
        for camera in cameras if pixels else []:
            key = f"{OBS_IMAGES}.{camera}"
            shape = (self.observation_height, self.observation_width, 3)
            self.features[key] = PolicyFeature(FeatureType.VISUAL, shape)
            self.features_map[key] = key

    @property
    def steps_per_task(self) -> int:
        """Control steps that a task has: the window of an evaluation, and K of a training by default."""
        return get_scene(self.scene).steps_per_task

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of `CronosVectorEnv`."""
        names = (
            "obs_type", "privileged_state", "observation_height", "observation_width", "camera_name",
            "render_size", "renderer", "num_threads", "benchmark",
            "task_observation",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}

    def create_streams(self, num_envs: int, **options: Any) -> CronosVectorEnv:
        """Streams to train on, which never reset themselves; `options` are those of `CronosVectorEnv`."""
        return CronosVectorEnv(num_envs, self.scene, **(self.gym_kwargs | options))

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """One native vector env per task or ordering, built lazily; `use_async_envs` is not needed and ignored."""
        makers = {i: self._maker(n_envs, chosen) for i, chosen in self._chosen().items()}
        return {f"{self.suite}_{self.split}": {i: LazyVectorEnv(make, n_envs) for i, make in makers.items()}}

    def _chosen(self) -> dict[int, EpisodeGroup]:
        """The tasks or orderings of the suite that `task` chooses, by their number."""
        groups = load_benchmark(self.benchmark, self.scene).groups(self.suite, self.split)
        independent = self.suite == "independent"
        names = {group.instructions[0] if independent else str(group.number): group for group in groups}
        if self.task is not None and str(self.task) not in names:
            kind = "task" if independent else "ordering"
            where = self.scene if self.benchmark is None else self.benchmark
            raise ValueError(f"unknown {kind} {self.task!r} of {where}; valid {kind}s: {list(names)}")
        return {
            group.number: group for name, group in names.items() if self.task is None or name == str(self.task)
        }

    def _maker(self, n_envs: int, group: EpisodeGroup) -> Callable[[], EpisodicVectorEnv]:
        kwargs = {"split": self.split, "configurations": group.configurations} | self.gym_kwargs
        if self.suite == "independent":
            return partial(IndependentVectorEnv, n_envs, self.scene, task=group.tasks[0], **kwargs)
        return partial(
            SequentialVectorEnv, n_envs, self.scene, ordering=group.tasks,
            advance=self.advance, end_effector_reset=self.end_effector_reset, **kwargs,
        )  # fmt: skip


@EnvConfig.register_subclass("cronos_hub")
@dataclass
class CronosHubEnvConfig(CronosEnvConfig, HubEnvConfig):
    """The environments that a benchmark's repository makes itself, by LeRobot's EnvHub.

    The fields of `--env.type=cronos`, but LeRobot runs the `env.py` of `--env.hub_path`.

    `--trust_remote_code=true` allows its code to run. What a policy sees follows from the data beside it.
    """

    hub_path: str | None = None
    """<owner>/<repository>[@<revision>] of a model repository that `cronos-publish benchmark` has made."""

    def _build(self) -> None:
        if not self.hub_path:
            raise ValueError("env.type=cronos_hub needs env.hub_path: <owner>/<repository>[@<revision>]")
        name = self.hub_path.partition(":")[0]
        folder, _ = fetch_benchmark(name, repo_type="model")
        if self.benchmark not in (None, str(folder)):
            raise ValueError(f"env.benchmark is that of env.hub_path={self.hub_path}; got {self.benchmark!r}")
        self.benchmark = str(folder)
        super()._build()
        check_tag(load_benchmark(self.benchmark, self.scene), name)


def _end_in_one_line(reason: ValueError) -> None:
    """Let a command line that `reason` ends say nothing else: draccus drops it, and LeRobot prints a traceback."""
    before = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if error.__cause__ is reason:
            print(f"error: --env: {reason}", file=sys.stderr)
        else:
            before(kind, error, traceback)

    sys.excepthook = hook


def is_of_this_package(env: Any) -> TypeGuard[CronosEnvConfig]:
    """Whether an environment config is of environments that this package makes, not a repository's own code."""
    return isinstance(env, CronosEnvConfig) and not isinstance(env, HubEnvConfig)
