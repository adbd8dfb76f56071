"""Who acts in an evaluation: a policy that samples, any other LeRobot policy, or the scripted expert."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from functools import partial
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import set_seed
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert

from cronos_lerobot.agents.base import ActionSample, Actor, Columns, StreamSeed, observation_steps, samples
from cronos_lerobot.agents.chunk_player import ObservationHistory, make_player
from cronos_lerobot.agents.processing import PolicyProcessors, make_processors, observation_columns
from cronos_lerobot.agents.steering.steered import with_steering
from cronos_lerobot.agents.weights import train_in_float32
from cronos_lerobot.evaluation.policy_loading import check_processor_classes, damage_named, load_policy


class SamplingPolicy(Actor):
    """A policy with `sample_actions`, sampled at a temperature.

    Each stream plays its decision to the end, unless a new task begins.

    If `sample_actions` takes `uniform`, a stream's actions depend on its seed, its step and its observations. They
    do not depend on the streams beside it, except for the rounding of another batch size. Otherwise all streams
    draw from one generator.

    Args:
        policy: a LeRobot policy on its device, or what acts instead of it.
        processors: the policy's.
        temperature: 0 takes the likeliest action.
        action_size: A.
    """

    def __init__(self, policy: Any, processors: PolicyProcessors, temperature: float, action_size: int) -> None:
        self._policy, self._processors, self.temperature = policy, processors, temperature
        self._action_size = action_size
        # What acts instead of a policy may have no modes.
        if callable(getattr(policy, "eval", None)):
            policy.eval()
        self._takes_uniform = "uniform" in inspect.signature(policy.sample_actions).parameters
        self._generator = torch.Generator(device=processors.device)
        self._rngs: dict[int, np.random.Generator] = {}
        self._left: dict[int, list[np.ndarray]] = {}
        self._history = ObservationHistory(observation_steps(policy))
        self._autocast = _autocast(policy, processors)

    def seed(self, seed: int) -> None:
        """See `Actor`."""
        self._generator.manual_seed(seed)

    def begin(self, ids: np.ndarray, seeds: Sequence[StreamSeed] | None = None) -> None:
        """See `Actor`."""
        self._history.begin(ids)
        for i in map(int, ids):
            self._left.pop(i, None)
        if seeds is not None:
            rngs = (np.random.default_rng(list(seed)) for seed in seeds)
            self._rngs |= zip(map(int, ids), rngs, strict=True)

    @torch.inference_mode()
    def act(self, observation: dict[str, Any], instructions: list[str], ids: np.ndarray) -> ActionSample:
        """See `Actor`."""
        streams = [int(i) for i in ids]
        uniform = self._draw(streams)
        seen = self._history.see(observation_columns(observation), streams)
        undecided = [row for row, i in enumerate(streams) if not self._left.get(i)]
        if undecided:
            columns = {name: column[undecided] for name, column in seen.items()}
            texts = [instructions[row] for row in undecided]
            decided = self._decide(columns, texts, None if uniform is None else uniform[undecided])
            self._left |= {streams[row]: list(actions) for row, actions in zip(undecided, decided, strict=True)}
        return ActionSample(np.stack([self._left[i].pop(0) for i in streams]))

    def _draw(self, streams: list[int]) -> np.ndarray | None:
        """A row of numbers (k, A) in [0, 1) for each step of each stream, whether it decides or not."""
        if not self._takes_uniform:
            return None
        return np.stack([self._rngs[i].random(self._action_size, dtype=np.float32) for i in streams])

    def _decide(self, columns: Columns, instructions: list[str], uniform: np.ndarray | None) -> np.ndarray:
        """Decisions (k, n, A) in physical units."""
        batch = self._processors.batch(columns, instructions)
        randomness: dict[str, Any] = {"generator": self._generator}
        if uniform is not None:
            randomness = {"uniform": torch.from_numpy(uniform).to(self._processors.device)}
        with self._autocast():
            sample = self._policy.sample_actions(batch, temperature=self.temperature, **randomness)
        actions = sample["actions"]
        return self._processors.physical_actions(actions.flatten(0, 1)).reshape(actions.shape)


class SelectingPolicy(Actor):
    """Any LeRobot policy, prepared and asked as `lerobot-eval` does.

    It may queue chunks of actions or look back: each stream has its own memory. A few policies plan from their
    earlier plans (see `make_player`). They have one memory for the whole batch, which LeRobot clears for all
    streams at once. Their chains start together, and each new task in one of them clears it.

    Args:
        policy: on its device.
        processors: its pre- and postprocessor.
        env_processors: LeRobot's processors between environment and policy, (before, after).
    """

    def __init__(self, policy: Any, processors: PolicyProcessors, env_processors: tuple[Any, Any]) -> None:
        before, self._after_policy = env_processors
        self._processors = copy(processors)
        self._processors.preprocessor = lambda batch: processors.preprocessor(before(batch))
        self._player = make_player(policy.eval(), self._processors)
        self._autocast = _autocast(policy, processors)
        self.is_per_stream = self._player.is_per_stream

    def seed(self, seed: int) -> None:
        """Seed the global generators, from which LeRobot's policies draw."""
        set_seed(seed)

    def begin(self, ids: np.ndarray, seeds: Sequence[StreamSeed] | None = None) -> None:
        """See `Actor`."""
        self._player.begin(ids.tolist())

    @torch.inference_mode()
    def act(self, observation: dict[str, Any], instructions: list[str], ids: np.ndarray) -> ActionSample:
        """See `Actor`."""
        columns = observation_columns(observation)
        with self._autocast():
            action = self._processors.postprocessor(self._player.act(columns, instructions, ids.tolist()))
        return ActionSample(self._after_policy({ACTION: action})[ACTION].to("cpu", torch.float32).numpy())


class ExpertActor(Actor):
    """The scripted expert, which looks at the simulation's state: the ceiling of every policy."""

    def __init__(self, env: CronosVectorEnv) -> None:
        self._expert = ScriptedExpert(env)

    def begin(self, ids: np.ndarray, seeds: Sequence[StreamSeed] | None = None) -> None:
        """Look at the scene anew."""
        self._expert.reset(ids)

    def act(self, observation: dict[str, Any], instructions: list[str], ids: np.ndarray) -> ActionSample:
        """See `Actor`."""
        return ActionSample(self._expert.act()[ids])


def make_actor(
    policy: Any,
    processors: PolicyProcessors,
    temperature: float,
    action_size: int,
    env_processors: tuple[Any, Any] | None = None,
) -> SamplingPolicy | SelectingPolicy:
    """Return the actor of a LeRobot policy on its device.

    Args:
        policy: that of the actions, or what steers it.
        processors: the policy's.
        temperature: of the sampling, if the policy has `sample_actions`.
        action_size: numbers of an action.
        env_processors: LeRobot's processors between environment and policy, (before, after), if any.
    """
    if samples(policy):
        return SamplingPolicy(policy, processors, temperature, action_size)
    return SelectingPolicy(policy, processors, env_processors or (_as_it_is, _as_it_is))


def load_actor(
    config: PreTrainedConfig, env: EnvConfig, temperature: float, rename_map: dict[str, str] | None = None
) -> SamplingPolicy | SelectingPolicy:
    """Load a checkpoint and return its actor, steered if the checkpoint is a steered one.

    Args:
        config: the policy's, which says where its checkpoint and its device are.
        env: the environment that it acts in.
        temperature: of the sampling, if the policy has one.
        rename_map: observations to rename for the policy.

    Raises:
        ValueError: a file of the checkpoint is damaged or names foreign code, or the policy below its adapters is
            not found.
    """
    renamed = rename_map or {}
    with damage_named(config.pretrained_path):
        policy: Any = load_policy(config, env, renamed)
        # As it was trained.
        train_in_float32(policy, config.pretrained_path, config.pretrained_revision)
        check_processor_classes(str(config.pretrained_path))
        processors = make_pre_post_processors(
            config,
            str(config.pretrained_path),
            preprocessor_overrides={
                "device_processor": {"device": str(policy.config.device)},
                "rename_observations_processor": {"rename_map": renamed},
            },
        )
    env_processors = make_env_pre_post_processors(env_cfg=env, policy_cfg=config)
    own = make_processors(policy, *processors)
    action_size = env.features[ACTION].shape[0]
    return make_actor(with_steering(policy, config.pretrained_path), own, temperature, action_size, env_processors)


def _as_it_is(batch: Any) -> Any:
    return batch


def _autocast(policy: Any, processors: PolicyProcessors) -> Callable[[], AbstractContextManager]:
    """What `lerobot-eval` does for `--policy.use_amp`: makes a context for each inference."""
    uses_amp = getattr(getattr(policy, "config", None), "use_amp", False)
    return partial(torch.autocast, processors.device.type) if uses_amp else nullcontext
