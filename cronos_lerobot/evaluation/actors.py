"""Who acts in an evaluation: a policy that samples, any other LeRobot policy, or the scripted expert."""

from __future__ import annotations

import inspect
import pickle
import random
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import set_seed
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert

from cronos_lerobot.agents.base import Columns, samples
from cronos_lerobot.agents.chunk_player import make_player
from cronos_lerobot.agents.history import ObservationHistory, observation_steps
from cronos_lerobot.agents.processing import PolicyProcessors, make_processors, observation_columns
from cronos_lerobot.agents.steering.steered import with_steering
from cronos_lerobot.agents.weights import train_in_float32
from cronos_lerobot.evaluation.policy_loading import load_policy
from cronos_lerobot.evaluation.policy_source import damage_named

NOT_REPEATED = (
    "eval.repetitions=%d: the policy draws nothing, and would do the same again; every episode is run once."
)
"""Said where repetitions of a policy without randomness would count as episodes that there are not."""


class Actor(Protocol):
    """Chooses actions for some of the environments."""

    is_per_environment: bool
    """Whether it remembers nothing, or of each environment by itself; if not, `act` is always asked for all."""

    @property
    def temperature(self) -> float | None:
        """Of its sampling; None if it does not sample at a temperature that the evaluation chooses."""
        ...

    def seed(self, seed: int) -> None:
        """Start all randomness that is not handed to `act` anew."""
        ...

    @property
    def drew(self) -> bool:
        """Whether it has drawn or been handed randomness since `seed`: if not, it would do the same once more."""
        ...

    def begin(self, ids: np.ndarray) -> None:
        """A new task begins in environments `ids` (k,)."""
        ...

    def act(
        self, observation: dict[str, Any], instructions: list[str], uniform: np.ndarray, ids: np.ndarray
    ) -> np.ndarray:
        """Return actions (k, 7) in physical units.

        Args:
            observation: raw, k rows.
            instructions: the k current ones.
            uniform: (k, 7) float32 in [0, 1), the randomness to use.
            ids: (k,) the environments.
        """
        ...


class SamplingPolicy:
    """What has `sample_actions`, sampled at a temperature.

    A decision on several actions is played to its end, in each environment for itself, unless a new task begins.

    If its `sample_actions` takes `uniform`, what a chain does depends on the seed and on itself only, not on the
    chains beside it (up to the rounding of a batch of another size). If not, a generator is drawn from in turn.
    """

    is_per_environment = True

    def __init__(self, policy: Any, processors: PolicyProcessors, temperature: float) -> None:
        self._policy, self._processors, self.temperature = policy, processors, temperature
        # What acts in a policy's place may have no modes, nor a config.
        if callable(getattr(policy, "eval", None)):
            policy.eval()
        self._takes_uniform = "uniform" in inspect.signature(policy.sample_actions).parameters
        self._generator = torch.Generator(device=processors.device)
        self._left: dict[int, list[np.ndarray]] = {}
        self._history = ObservationHistory(observation_steps(policy))
        self._autocast = _autocast(policy, processors)

    def seed(self, seed: int) -> None:
        """See `Actor`."""
        self._generator.manual_seed(seed)

    @property
    def drew(self) -> bool:
        """See `Actor`: at temperature 0 it takes the likeliest action."""
        return self.temperature > 0

    def begin(self, ids: np.ndarray) -> None:
        """What was decided for another task is not played, what was seen in it forgotten."""
        self._history.begin(ids)
        for i in ids:
            self._left.pop(int(i), None)

    @torch.inference_mode()
    def act(
        self, observation: dict[str, Any], instructions: list[str], uniform: np.ndarray, ids: np.ndarray
    ) -> np.ndarray:
        """See `Actor`."""
        seen = self._history.see(observation_columns(observation), ids.tolist())
        undecided = [row for row, i in enumerate(ids) if not self._left.get(int(i))]
        if undecided:
            columns = {name: col[undecided] for name, col in seen.items()}
            decided = self._decide(columns, [instructions[row] for row in undecided], uniform[undecided])
            self._left |= {int(ids[row]): list(actions) for row, actions in zip(undecided, decided, strict=True)}
        return np.stack([self._left[int(i)].pop(0) for i in ids])

    def _decide(self, columns: Columns, instructions: list[str], uniform: np.ndarray) -> np.ndarray:
        """Decisions (k, n, 7) in physical units."""
        batch = self._processors.batch(columns, instructions)
        randomness: dict[str, Any] = {"generator": self._generator}
        if self._takes_uniform:
            randomness = {"uniform": torch.from_numpy(uniform).to(self._processors.device)}
        with self._autocast():
            sample = self._policy.sample_actions(batch, temperature=self.temperature, **randomness)
        actions = sample["actions"]
        return self._processors.physical_actions(actions.flatten(0, 1)).reshape(actions.shape)


class SelectingPolicy:
    """Any LeRobot policy, prepared and asked as `lerobot-eval` does.

    It may queue chunks of actions or look back, with a memory of its own for each environment. The few policies
    whose plans depend on the plans before them (`make_player`) have one memory for the whole batch, which LeRobot
    can only clear for all at once: their chains start together, and it is cleared whenever a new task begins in
    one of them. With `advance=window` that is when it does in all.

    Args:
        policy: on its device.
        processors: its pre- and postprocessor.
        env_processors: LeRobot's processors between environment and policy, (before, after).
    """

    temperature = None

    def __init__(self, policy: Any, processors: PolicyProcessors, env_processors: tuple[Any, Any]) -> None:
        before, self._after_policy = env_processors
        self._player, self._processors = make_player(policy.eval()), copy(processors)
        self._processors.preprocessor = lambda batch: processors.preprocessor(before(batch))
        self._autocast = _autocast(policy, processors)
        self.is_per_environment = self._player.is_per_stream
        self._seeded: list[bytes] = []

    def seed(self, seed: int) -> None:
        """Seed the global generators, from which LeRobot's policies draw."""
        set_seed(seed)
        self._seeded = self._generator_states()

    @property
    def drew(self) -> bool:
        """See `Actor`: whether the global generators have moved. ACT draws nothing, Diffusion its noise."""
        return self._generator_states() != self._seeded

    def _generator_states(self) -> list[bytes]:
        states = [torch.get_rng_state()]
        if (device := self._processors.device).type != "cpu":
            states.append(torch.get_device_module(device).get_rng_state())
        return [pickle.dumps([random.getstate(), np.random.get_state()]), *(s.numpy().tobytes() for s in states)]

    def begin(self, ids: np.ndarray) -> None:
        """Forget chunks and history; a memory for the whole batch is forgotten for all."""
        self._player.begin(ids.tolist())

    @torch.inference_mode()
    def act(
        self, observation: dict[str, Any], instructions: list[str], uniform: np.ndarray, ids: np.ndarray
    ) -> np.ndarray:
        """See `Actor`."""
        rows = self._processors.rows(observation_columns(observation), instructions)
        with self._autocast():
            action = self._processors.postprocessor(self._player.act(rows, ids.tolist()))
        return self._after_policy({ACTION: action})[ACTION].to("cpu", torch.float32).numpy()


class ExpertActor:
    """The scripted expert, which looks at the simulation's state: the ceiling of every policy."""

    is_per_environment, temperature = True, None

    def __init__(self, env: CronosVectorEnv) -> None:
        self._expert = ScriptedExpert(env)

    drew = False

    def seed(self, seed: int) -> None:
        """It is deterministic."""

    def begin(self, ids: np.ndarray) -> None:
        """Look at the scene anew."""
        self._expert.reset(ids)

    def act(
        self, observation: dict[str, Any], instructions: list[str], uniform: np.ndarray, ids: np.ndarray
    ) -> np.ndarray:
        """See `Actor`."""
        return self._expert.act()[ids]


def make_actor(
    policy: Any, processors: PolicyProcessors, temperature: float, env_processors: tuple[Any, Any] | None = None
) -> SamplingPolicy | SelectingPolicy:
    """Return the actor for a LeRobot policy on its device.

    Args:
        policy: that of the actions, or what steers it.
        processors: the policy's.
        temperature: of the sampling, if the policy has one (`sample_actions`).
        env_processors: LeRobot's processors between environment and policy, (before, after), if any.
    """
    if samples(policy):
        return SamplingPolicy(policy, processors, temperature)
    return SelectingPolicy(policy, processors, env_processors or (_as_it_is, _as_it_is))


def load_actor(
    config: PreTrainedConfig, env: CronosEnvConfig, temperature: float, rename_map: dict[str, str] | None = None
) -> SamplingPolicy | SelectingPolicy:
    """Load a checkpoint and return the actor for it, steered if it is a steered one.

    Args:
        config: the policy's, which says where its checkpoint and its device are.
        env: the environment that it acts in.
        temperature: of the sampling, if the policy has one.
        rename_map: observations to rename for the policy.

    Raises:
        ValueError: a file of the checkpoint is damaged, or what its adapters go onto is not found.
    """
    renamed = rename_map or {}
    with damage_named(config.pretrained_path):
        policy: Any = load_policy(config, env, renamed)
        # As it was trained.
        train_in_float32(policy, config.pretrained_path, config.pretrained_revision)
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
    return make_actor(with_steering(policy, config.pretrained_path), own, temperature, env_processors)


def _as_it_is(batch: Any) -> Any:
    return batch


def _autocast(policy: Any, processors: PolicyProcessors) -> Any:
    """What `lerobot-eval` does for `--policy.use_amp`: makes a context for each inference."""

    def make() -> AbstractContextManager:
        uses_amp = getattr(getattr(policy, "config", None), "use_amp", False)
        return torch.autocast(processors.device.type) if uses_amp else nullcontext()

    return make
