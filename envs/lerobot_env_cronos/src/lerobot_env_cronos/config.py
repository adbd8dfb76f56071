"""`--env.type=cronos`: the LeRobot configuration of the CRONOS scenes."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import parse_camera_names
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_env_cronos.benchmark.benchmark import SUITES, EpisodeGroup
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.benchmark.load import benchmark_scene, load_benchmark
from lerobot_env_cronos.benchmark.version import gymnasium_id
from lerobot_env_cronos.episodic import EpisodicVectorEnv, IndependentVectorEnv, LazyVectorEnv
from lerobot_env_cronos.scene.model import CAMERAS
from lerobot_env_cronos.scene.scenes import CONTROL_HZ, get_scene
from lerobot_env_cronos.sequential import ADVANCES, SequentialVectorEnv
from lerobot_env_cronos.simulation.observations import (
    OBS_TYPES,
    TASK_OBSERVATIONS,
    agent_pos_names,
    environment_state_names,
)
from lerobot_env_cronos.simulation.rendering import RENDERERS
from lerobot_env_cronos.simulation.simulation import ACTION_NAMES

DEFAULT_SCENE = "kitchen_2x2"


@EnvConfig.register_subclass("cronos")
@dataclass
class CronosEnvConfig(EnvConfig):
    """Shared-scene pick and place on the Bridge table (CRONOS, Section 4)."""

    task: str | None = None
    """What to evaluate of the suite: an instruction (independent), or the number of an ordering, 0 to 9
    (sequential); null for all."""
    fps: int = CONTROL_HZ
    """Control frequency [Hz]; fixed by the protocol."""
    scene: str = ""
    """Scene: kitchen_2x2, kitchen_3x3, playroom_2x2, or a registered one; by default the benchmark's, or
    kitchen_2x2."""
    suite: str = "independent"
    """Evaluation suite: independent (every task from every configuration, 80 steps), or sequential (chains of all
    tasks without a reset in between, in ten orderings, 80 steps for each task)."""
    split: str = "train"
    """Configurations: train or held_out, 64 each."""
    benchmark: str | None = None
    """A benchmark of its author's own configurations and chains: <owner>/<repository>[@<revision>] of a dataset on
    the Hub, or a folder; null for this package's."""
    advance: str = "window"
    """When a chain (--env.suite=sequential) goes on to its next task: window (when the 80 steps are over) or
    on_success (at once)."""
    end_effector_reset: bool = False
    """Send the arm home between the tasks of a chain (--env.suite=sequential)."""
    obs_type: str = "pixels_agent_pos"
    """pixels_agent_pos, or environment_state_agent_pos for the privileged state in place of pixels."""
    task_observation: str = "none"
    """one_hot appends which object and which receptacle is meant to observation.state, for policies that read no
    instructions (ACT, Diffusion); none does not."""
    privileged_state: bool = False
    """Add observation.environment_state to pixel observations, for an asymmetric critic."""
    observation_height: int = 128
    """Height of the observed image [px]."""
    observation_width: int = 128
    """Width of the observed image [px]."""
    camera_name: str = "front"
    """Camera(s), comma-separated: front (sees every body), bridge (the Bridge set-up's third-person view)."""
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
            # Command lines only say that the config could not be instantiated: draccus drops the reason.
            logging.getLogger(__name__).error("--env: %s", error)
            raise

    def _build(self) -> None:
        """Check the fields and derive the features from them."""
        self.scene = self.scene or (benchmark_scene(self.benchmark) if self.benchmark else DEFAULT_SCENE)
        scene = get_scene(self.scene)
        _check("suite", self.suite, SUITES)
        _check("split", self.split, SPLITS)
        _check("advance", self.advance, ADVANCES)
        _check("obs_type", self.obs_type, OBS_TYPES)
        _check("renderer", self.renderer, RENDERERS)
        _check("task_observation", self.task_observation, TASK_OBSERVATIONS)
        cameras = parse_camera_names(self.camera_name)
        for camera in cameras:
            _check("camera_name", camera, tuple(CAMERAS))
        if self.fps != CONTROL_HZ:
            raise ValueError(f"env.fps is fixed at {CONTROL_HZ} Hz by the protocol, got {self.fps}")
        if self.num_threads < 0:
            raise ValueError(f"env.num_threads must be at least 0 (all cores), got {self.num_threads}")
        if len(self.render_size) != 2:
            raise ValueError(f"env.render_size must be two numbers, height and width, got {self.render_size}")
        if min(self.observation_height, self.observation_width, *self.render_size) < 1:
            sizes = f"{self.observation_height} x {self.observation_width} and {tuple(self.render_size)}"
            raise ValueError(
                f"env.observation_height, observation_width and render_size must be positive, got {sizes}"
            )
        self._chosen()
        pixels = self.obs_type == "pixels_agent_pos"
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))}
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
    def package_name(self) -> str:
        """The module that registers the Gymnasium ids."""
        return "lerobot_env_cronos"

    @property
    def gym_id(self) -> str:
        """Gymnasium id of the single-environment form."""
        return gymnasium_id(self.scene)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of `CronosVectorEnv`."""
        names = (
            "obs_type", "privileged_state", "observation_height", "observation_width", "camera_name",
            "render_size", "renderer", "num_threads", "benchmark",
            "task_observation",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """One native vector env per task or ordering, built lazily; `use_async_envs` is not needed and ignored."""
        if self.suite == "independent" and (self.advance != "window" or self.end_effector_reset):
            logging.getLogger(__name__).warning(
                "--env.advance and --env.end_effector_reset are of chains, --env.suite=sequential: "
                "--env.suite=independent does not follow them"
            )
        makers = {i: self._maker(n_envs, chosen) for i, chosen in self._chosen().items()}
        envs: dict[int, gym.vector.VectorEnv] = {i: LazyVectorEnv(make, n_envs) for i, make in makers.items()}
        return {f"{self.suite}_{self.split}": envs}

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


def _check(name: str, value: str, valid: tuple[str, ...]) -> None:
    if value not in valid:
        raise ValueError(f"unknown env.{name} {value!r}; valid values: {list(valid)}")
