"""Human help, played by a script: it does the next task of a stream that has failed twice in a row.

    PYTHONPATH=examples cronos-train --env.discover_packages_path=scripted_help --env.type=cronos_helped \
        --algorithm.type=imitation --policy.path=<checkpoint> --output_dir=outputs/scripted_help

The wrapper reports what was executed and in which streams it acted. The loop records that, marks the frames and
counts each beginning of help as one intervention. Imitation clones the successes, PPO leaves these decisions out.
A person with a teleoperator would take the expert's place in `step`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.envs.configs import EnvConfig
from lerobot_env_cronos import CronosEnvConfig, ScriptedExpert

FAILURES = 2


class ScriptedHelp:
    """Streams in which the expert does a segment after FAILURES failed segments in a row.

    Args:
        env: the streams.
        expert: knows them; has `act()`, actions (N, A), and `reset(ids)`.
    """

    def __init__(self, env: Any, expert: Any) -> None:
        self.env, self.expert = env, expert
        self.failures = np.zeros(env.num_envs, np.int64)
        self.helps = np.zeros(env.num_envs, np.bool_)
        # Before the first segment nothing has failed.
        self.succeeded = np.ones(env.num_envs, np.bool_)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    @property
    def timer(self) -> Any:
        """Told where the time goes."""
        return self.env.timer

    @timer.setter
    def timer(self, timer: Any) -> None:
        self.env.timer = timer

    def set_task(self, ids: Iterable[int], tasks: Sequence[Any]) -> None:
        """Give the streams `ids` their tasks: their segments begin, with help or without."""
        ids = np.asarray(list(ids))
        self.env.set_task(ids, tasks)
        failed = ~self.succeeded[ids] & ~self.helps[ids]
        self.failures[ids] = np.where(failed, self.failures[ids] + 1, 0)
        self.helps[ids] = self.failures[ids] >= FAILURES
        self.succeeded[ids] = False
        self.expert.reset(ids)

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Apply the expert's actions where it helps, and `actions` (N, A) elsewhere."""
        if self.helps.any():
            actions = np.where(self.helps[:, None], self.expert.act(), actions)
        observation, reward, terminated, truncated, info = self.env.step(actions)
        self.succeeded |= info["is_success"]
        return observation, reward, terminated, truncated, info | {"intervened": self.helps.copy()}

    def get_state(self) -> dict[str, np.ndarray]:
        """The simulation's state and who has failed: a resumed run continues bit for bit."""
        own = {"failures": self.failures, "helps": self.helps, "succeeded": self.succeeded}
        return self.env.get_state() | {f"help/{name}": array.copy() for name, array in own.items()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue from `get_state`."""
        self.env.set_state({name: array for name, array in state.items() if not name.startswith("help/")})
        for name in ("failures", "helps", "succeeded"):
            setattr(self, name, state[f"help/{name}"].copy())


@EnvConfig.register_subclass("cronos_helped")
@dataclass
class HelpedEnvConfig(CronosEnvConfig):
    """`--env.type=cronos_helped`: the scenes of `--env.type=cronos`, with help while training."""

    def create_streams(self, num_envs: int, **options: Any) -> Any:
        """The streams that `cronos-train` trains on."""
        env = super().create_streams(num_envs, **options)
        return ScriptedHelp(env, ScriptedExpert(env))

    def create_eval_streams(self, num_envs: int) -> Any:
        """Nobody helps in evaluations."""
        return super().create_streams(num_envs)
