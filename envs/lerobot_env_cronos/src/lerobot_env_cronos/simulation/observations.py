"""Observations: pixels, proprioception and the privileged state, in Gymnasium's and LeRobot's raw format."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_env_cronos.scene.scenes import Scene, Task
from lerobot_env_cronos.simulation.rendering import RENDERERS, ClassicRenderer, FilamentRenderer, make_renderer
from lerobot_env_cronos.simulation.simulation import Simulation

OBS_TYPES = ("pixels_agent_pos", "environment_state_agent_pos")

TASK_OBSERVATIONS = ("none", "one_hot")
"""How a policy that reads no instructions is told its task: not at all, or in `agent_pos`."""


def parse_cameras(scene: Scene, camera_name: str) -> list[str]:
    """Cameras of a comma-separated list, of a scene; a ValueError names the valid ones."""
    cameras = [name.strip() for name in camera_name.split(",") if name.strip()]
    valid = scene.robot.cameras
    if not cameras or set(cameras) - valid.keys():
        raise ValueError(f"unknown camera_name {camera_name!r}; valid, comma-separated: {sorted(valid)}")
    return cameras


def environment_state_names(scene: Scene) -> tuple[str, ...]:
    """Names of the privileged state: 12 per body: position [m], two rotation columns, position from the hand."""
    parts = (
        *(f"{axis}" for axis in "xyz"),
        *(f"r{row}{column}" for column in (1, 2) for row in (1, 2, 3)),
        *(f"from_ee.{axis}" for axis in "xyz"),
    )
    return tuple(f"{body}.{part}".replace(" ", "_") for body in scene.bodies for part in parts)


def agent_pos_names(scene: Scene, task_observation: str = "none") -> tuple[str, ...]:
    """Names of `agent_pos`: the arm's, and with `one_hot` which object and receptacle is meant.

    Of each block one number is 1, the others are 0. The table is the receptacle of the reset tasks.
    """
    if task_observation not in TASK_OBSERVATIONS:
        raise ValueError(f"unknown task_observation {task_observation!r}; valid values: {list(TASK_OBSERVATIONS)}")
    if task_observation == "none":
        return scene.robot.state_names
    bodies = [f"task.object.{name}" for name in scene.objects]
    bodies += [f"task.receptacle.{name}" for name in (*scene.receptacles, "table")]
    return scene.robot.state_names + tuple(name.replace(" ", "_") for name in bodies)


def one_hot(scene: Scene, tasks: Sequence[Task]) -> np.ndarray:
    """What `agent_pos_names` has of tasks (k,), (k, ...) float32."""
    receptacles = (*scene.receptacles, None)
    vectors = np.zeros((len(tasks), len(scene.objects) + len(receptacles)), dtype=np.float32)
    for vector, task in zip(vectors, tasks, strict=True):
        vector[scene.objects.index(task.object)] = 1.0
        vector[len(scene.objects) + receptacles.index(task.receptacle)] = 1.0
    return vectors


class ObservationBuilder:
    """Reads observations from a simulation; renders lazily, so state-only runs need no OpenGL."""

    def __init__(
        self,
        simulation: Simulation,
        obs_type: str,
        privileged_state: bool,
        height: int,
        width: int,
        camera_name: str,
        render_size: tuple[int, int],
        renderer: str = "classic",
        task_observation: str = "none",
        flat_observation: bool = False,
    ):
        if obs_type not in OBS_TYPES:
            raise ValueError(f"unknown obs_type {obs_type!r}; valid obs_types: {list(OBS_TYPES)}")
        if renderer not in RENDERERS:
            raise ValueError(f"unknown renderer {renderer!r}; valid renderers: {list(RENDERERS)}")
        if np.shape(render_size) != (2,) or min(height, width, *render_size) < 1:
            raise ValueError(
                "observation_height, observation_width and render_size=(height, width) must be at least 1, got "
                f"{height}, {width} and {render_size}"
            )
        self.renderer = renderer
        self.cameras = parse_cameras(simulation.scene, camera_name)
        self.flat = flat_observation
        self.simulation = simulation
        self._limit = simulation.scene.robot.state_limit
        self.agent_pos_names = agent_pos_names(simulation.scene, task_observation)
        self.tells_task = task_observation == "one_hot"
        self.pixels = obs_type == "pixels_agent_pos"
        self.privileged = privileged_state or not self.pixels
        self.size, self.render_size = (height, width), tuple(render_size)
        self._renderers: dict[tuple, ClassicRenderer | FilamentRenderer] = {}
        self.space = self._space()

    def _space(self) -> gym.spaces.Dict:
        def box(n: int) -> gym.spaces.Box:
            return gym.spaces.Box(-self._limit, self._limit, (n,), np.float32)

        spaces: dict[str, gym.Space] = {"agent_pos": box(len(self.agent_pos_names))}
        if self.privileged:
            spaces["environment_state"] = box(len(environment_state_names(self.simulation.scene)))
        if self.pixels:
            image = gym.spaces.Box(0, 255, (*self.size, 3), np.uint8)
            images: dict[str, gym.Space] = dict.fromkeys(self.cameras, image)
            spaces |= self._place_images(images, gym.spaces.Dict)
        return gym.spaces.Dict(spaces)

    def _place_images(self, images: dict[str, Any], group: Callable = dict) -> dict[str, Any]:
        """Where an observation, or its space, has the images of the cameras."""
        if self.flat:
            return {f"pixels_{camera}": image for camera, image in images.items()}
        return {"pixels": group(images)}

    def observe(self, ids: np.ndarray, tasks: Sequence[Task]) -> dict[str, Any]:
        """Observation of simulations `ids` (k,) under their `tasks`, (k, ...); every array is fresh."""
        sim = self.simulation
        agent_pos = sim.scene.robot.proprioception(sim)[ids].clip(-self._limit, self._limit)
        if self.tells_task:
            agent_pos = np.concatenate([agent_pos, one_hot(self.simulation.scene, tasks)], axis=1)
        observation: dict[str, Any] = {"agent_pos": agent_pos}
        if self.privileged:
            observation["environment_state"] = self._environment_state(sim.end_effector()[0])[ids]
        if self.pixels:
            qpos = sim.qpos[ids]
            images = {camera: self._renderer(self.size, camera).render(qpos) for camera in self.cameras}
            observation |= self._place_images(images)
        return observation

    def tell(self, observation: dict[str, Any], tasks: Sequence[Task]) -> dict[str, Any]:
        """An observation (k, ...) as it would be under other `tasks`; what they do not change is shared."""
        if not self.tells_task:
            return observation
        agent_pos = observation["agent_pos"][:, : len(self.simulation.scene.robot.state_names)]
        return observation | {
            "agent_pos": np.concatenate([agent_pos, one_hot(self.simulation.scene, tasks)], axis=1)
        }

    def render(self, qpos: np.ndarray) -> np.ndarray:
        """Frames (k, height, width, 3) of states `qpos` (k, nq) for videos, from the first camera."""
        return self._renderer(self.render_size, self.cameras[0]).render(qpos)

    def _environment_state(self, p: np.ndarray) -> np.ndarray:
        position = self.simulation.body_poses()[..., :3]
        R = self.simulation.body_rotations()
        parts = (position, R[..., 0], R[..., 1], position - p[:, None])
        flat = np.concatenate(parts, axis=2, dtype=np.float32).reshape(len(p), -1)
        return flat.clip(-self._limit, self._limit)

    def _renderer(self, size: tuple[int, int], camera: str) -> ClassicRenderer | FilamentRenderer:
        key = (size, camera)
        if key not in self._renderers:
            model, processes = self.simulation.render_model, self.simulation.num_threads
            self._renderers[key] = make_renderer(self.renderer, model, *size, camera, processes)
        return self._renderers[key]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderers": {}, "simulation": None}

    def close(self) -> None:
        """Free all renderers."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
