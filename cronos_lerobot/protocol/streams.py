"""What the loop needs of a world. The protocols are structural: nobody inherits from them.

Your simulator or robot is one of them once a LeRobot `EnvConfig` of yours has `create_streams(num_envs)`, which
returns `Streams`. docs/extend.md has a page on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeGuard, runtime_checkable

import gymnasium as gym
import numpy as np
from lerobot.envs.configs import EnvConfig, HubEnvConfig

STEPS_PER_TASK = 80
"""K of the paper, of worlds that have none of their own [control steps]."""


class Task(Protocol):
    """What a stream is told to do."""

    @property
    def instruction(self) -> str:
        """In words."""
        ...


class EnvIdentity(Protocol):
    """What recordings, runs and results compare: with the same identity they are of the same benchmark."""

    @property
    def id(self) -> str:
        """As Gymnasium's, with a version: `my_worlds/drawer-v1`. Whatever changes a result ends a version."""
        ...

    @property
    def fingerprint(self) -> str:
        """A hash of the starts."""
        ...

    @property
    def source(self) -> str:
        """Where the starts come from, in words."""
        ...


class Streams(Protocol):
    """N scenes that live on. They never reset themselves, and say neither terminated nor truncated.

    A world may also have the methods of the protocols below. A flag that needs one says so if it is missing. Two
    more attributes are optional. `observation_details` is what a dataset's features say of the observations beside
    their shapes, a dict by LeRobot's name. `benchmark` has `groups(suite, split)`, its own choice of episodes. A
    run or evaluation sets `folder`, for files of the world's own.
    """

    @property
    def num_envs(self) -> int:
        """N."""
        ...

    @property
    def fps(self) -> float:
        """Control steps a second [Hz]."""
        ...

    @property
    def robot_type(self) -> str:
        """LeRobot's, of datasets."""
        ...

    @property
    def tasks(self) -> Sequence[Any]:
        """Those that are evaluated, each a `Task`, in the order of the training cycle."""
        ...

    @property
    def reset_tasks(self) -> Sequence[Any]:
        """For `--protocol.learned_reset`: one for each `object` of the tasks, which undoes them. May be empty."""
        ...

    @property
    def identity(self) -> EnvIdentity:
        """What recordings, runs and results compare."""
        ...

    @property
    def single_observation_space(self) -> gym.Space:
        """A Dict with LeRobot's raw names.

        `pixels`, a Dict of uint8 (H, W, 3) by camera, `agent_pos` and `environment_state`, float32 (d,).
        """
        ...

    @property
    def single_action_space(self) -> gym.Space:
        """A Box of one stream's action, float32 (A,), in physical units."""
        ...

    @property
    def state_names(self) -> Sequence[str]:
        """Of `agent_pos`."""
        ...

    @property
    def action_names(self) -> Sequence[str]:
        """Of an action."""
        ...

    @property
    def num_starts(self) -> Mapping[str, int]:
        """Starts by split, `train` and `held_out`."""
        ...

    def set_task(self, ids: Iterable[int], tasks: Sequence[Any]) -> None:
        """Give the streams `ids` their tasks."""
        ...

    def observe(self, ids: np.ndarray | None = None) -> dict[str, Any]:
        """Return the observation now, of all streams or with one row for each of `ids`; its arrays are fresh."""
        ...

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (N, A) in physical units for one control step.

        Returns:
            Observation, reward (N,), two arrays (N,) of False, and info: `is_success` and `diverged`, (N,) bool.
            If known, also `is_grasped` (N,) bool, `executed_action` (N, A) float32, and `intervened` (N,) bool: a
            person or a script acted.
        """
        ...

    def scene_reset(self, ids: np.ndarray, starts: np.ndarray, split: str = "train") -> None:
        """Put the streams `ids` (k,) into the starts number `starts` (k,) of a split; may wait for a person."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class SendsArmHome(Protocol):
    """For `--protocol.end_effector_reset` and `--end_effector_reset`."""

    def end_effector_reset(self, ids: np.ndarray) -> None:
        """Put the arm of the streams `ids` home, gripper open; the objects stay."""
        ...


class PutsBodiesBack(Protocol):
    """For `--protocol.heuristic_reset`."""

    def unsuitable_bodies(self) -> np.ndarray:
        """Bodies that no task can reach any more, (N, bodies) bool."""
        ...

    def put_back(self, stream: int, body: int, rng: np.random.Generator) -> None:
        """Put one body of a stream at a free place, drawn from `rng`."""
        ...


@runtime_checkable
class KeepsState(Protocol):
    """For runs that resume bit for bit. Without it a resumed run begins with a new INITIAL placement."""

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that decides what steps do, as arrays (N, ...)."""
        ...

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a state."""
        ...


@runtime_checkable
class Draws(Protocol):
    """For videos."""

    def render_streams(self, ids: np.ndarray) -> np.ndarray:
        """Frames (k, H, W, 3) uint8 of the streams `ids`."""
        ...


class TellsComplete(Protocol):
    """For task orders and reset strategies that ask."""

    def find_complete(self, tasks: Sequence[Any]) -> np.ndarray:
        """Whether each of `tasks` is complete in each stream, (N, len(tasks)) bool."""
        ...


class StreamsConfig(Protocol):
    """A LeRobot `EnvConfig` that makes `Streams`.

    It may also have `steps_per_task`, the control steps that a task has: K of a training that says no other, and
    the window of an evaluation; and `create_eval_streams(num_envs)`, where evaluations need other streams, such as
    those without help.
    """

    type: str
    fps: int
    features: dict[str, Any]
    features_map: dict[str, str]

    def create_streams(self, num_envs: int) -> Streams:
        """Return `num_envs` streams; `reward=...` is passed on if `--protocol.reward` is given."""
        ...


def makes_streams(env: Any) -> TypeGuard[EnvConfig]:
    """Whether an environment config makes `Streams`. One that runs a repository's code is none of them."""
    return callable(getattr(env, "create_streams", None)) and not isinstance(env, HubEnvConfig)


def check_makes_streams(env: Any) -> None:
    """Raise a ValueError unless an environment config makes `Streams`."""
    if not makes_streams(env):
        given = "" if env is None else f"; --env.type={env.type} has no create_streams(num_envs)"
        raise ValueError(f"choose an environment: --env.type=cronos --env.scene=kitchen_2x2{given}")


def create_eval_streams(env: Any, num_envs: int) -> Streams:
    """Streams for an evaluation in the worlds of an environment config."""
    return getattr(env, "create_eval_streams", env.create_streams)(num_envs)


def steps_per_task(env: Any) -> int:
    """Control steps that a task has in the worlds of an environment config."""
    return getattr(env, "steps_per_task", STEPS_PER_TASK)


def check_capability(env: Any, method: str, flag: str) -> None:
    """Raise a ValueError unless a world has the method that a flag needs."""
    if not callable(getattr(env, method, None)):
        raise ValueError(f"{flag} needs {method} of the environment, and {env.identity.id} has none")
