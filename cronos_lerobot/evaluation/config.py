"""The configuration of `cronos-eval`, LeRobot's way."""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.sequential import ADVANCES

from cronos_lerobot.data.video import check_video_size
from cronos_lerobot.environment_id import check_environment_id
from cronos_lerobot.evaluation.chains import Chain
from cronos_lerobot.evaluation.policy_env import (
    check_observations,
    reads_privileged_state,
    task_observation_of,
    trained_observations,
    trained_scene,
)
from cronos_lerobot.evaluation.policy_source import files_fingerprint, fingerprint
from cronos_lerobot.evaluation.results import FORMAT
from cronos_lerobot.evaluation.suites import (
    INDEPENDENT,
    SEQUENTIAL,
    SPLITS,
    SUITES,
    Benchmark,
    benchmark_of,
    make_chains,
)
from cronos_lerobot.protocol.streams import Streams, check_capability, check_makes_streams
from cronos_lerobot.ranges import check_ranges, limits, ranged
from cronos_lerobot.robot import config as _robot  # noqa: F401  (registers cronos_robot)

QUICK_CONFIGURATIONS, QUICK_ORDERINGS = 16, 3
EXPERT = "scripted expert"
ELSEWHERE = {
    "suite": "eval.suites", "split": "eval.splits", "task": "eval.orderings", "advance": "advance",
    "end_effector_reset": "end_effector_reset",
}  # fmt: skip
"""Flags of `env` for `lerobot-eval`, and ours instead."""


@dataclass
class SuitesConfig:
    """What is evaluated."""

    suites: list[str] = field(default_factory=lambda: [INDEPENDENT, SEQUENTIAL], metadata=limits(choices=SUITES))
    """independent (every task from every configuration), sequential (chains of all tasks), stream (16 tasks in a
    row, nobody resets); default: the first two."""
    splits: list[str] = field(default_factory=lambda: list(SPLITS), metadata=limits(choices=SPLITS))
    """Splits of the configurations: train, held_out; default: both."""
    n_episodes: int | None = ranged(None, minimum=1)
    """The first N configurations of each split, for each task, ordering, stream; null for all 64 (quick: 16)."""
    orderings: int | None = ranged(None, minimum=1)
    """The first N orderings of the sequential suite; null for all 10 (quick: 3)."""
    temperature: float = ranged(0.6, minimum=0)
    """Sampling temperature of policies that have one (`sample_actions`); 0 takes the likeliest action."""
    batch_size: int = ranged(64, minimum=1)
    """Parallel environments."""
    videos: int = ranged(1, minimum=0)
    """Good chains to film, and bad ones, for every suite and split; 0 films none."""


@dataclass
class CronosEvalConfig:
    """Evaluate a policy on single tasks, on chains of tasks, and on streams that nobody resets."""

    env: EnvConfig = field(default_factory=CronosEnvConfig)
    """The environment. Of a CRONOS scene, by default scene, renderer and observations are those of the policy's
    training."""
    policy: PreTrainedConfig | None = None
    """The policy: --policy.path=<checkpoint, or Hub id[@revision]>."""
    eval: SuitesConfig = field(default_factory=SuitesConfig)
    """Suites, splits, and how much of them."""
    advance: str = ranged("window", choices=ADVANCES)
    """When a chain of the sequential suite gets its next task: window (the 80 steps are over) or on_success."""
    end_effector_reset: bool = False
    """Send the arm home between the tasks of a chain or stream."""
    quick: bool = False
    """Fewer configurations and orderings: 16 and 3."""
    expert: bool = False
    """Evaluate the scripted expert, the ceiling, instead of a policy."""
    seed: int = ranged(1000, minimum=0)
    """Seed of the action sampling; configurations and orderings are the same for every seed."""
    output_dir: Path | None = None
    """Folder for <suite>_<split>/results.json and videos; a new one in outputs/eval by default. A suite and split
    that is there already is done."""
    rename_map: dict[str, str] = field(default_factory=dict)
    """Observations to rename for the policy, as in lerobot-eval."""
    torch_threads: int | None = ranged(None, minimum=1)
    """Threads of PyTorch on the CPU; null leaves PyTorch's default."""
    policy_name: str = field(init=False, default="")
    """As it was given; of a run's last checkpoint the one that it was then."""
    policy_revision: str | None = field(init=False, default=None)
    """Commit of a policy on the Hub."""

    def resolve(self, given: Collection[str] = ()) -> None:
        """Fill in what follows from the policy, and check everything.

        Args:
            given: fields of `env` that count as given even if they have their default value.

        Raises:
            ValueError: a value is not valid, or there is nothing to evaluate.
        """
        check_makes_streams(self.env)
        if (self.policy is None) != self.expert:
            raise ValueError("choose a policy, --policy.path=<checkpoint or Hub id>, or --expert=true, not both")
        if not (self.eval.suites and self.eval.splits):
            raise ValueError("--eval.suites and --eval.splits need at least one value each")
        if not self.policy_name:
            self.policy_name = EXPERT if self.policy is None else str(self.policy.pretrained_path)
        check_ranges(self)
        if isinstance(self.env, CronosEnvConfig):
            self._resolve_scene(self.env, given)
        elif self.expert:
            raise ValueError(f"--expert=true needs --env.type=cronos, got {self.env.type!r}")
        if self.policy is not None:
            check_observations(self.policy, self.env, self.rename_map)
        if self.output_dir is None:
            name = "expert" if self.policy is None else self.policy.type
            self.output_dir = (
                Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_{self.env.type}_{name}"
            )

    def _resolve_scene(self, env: CronosEnvConfig, given: Collection[str]) -> None:
        """Fill in what follows from the policy in the config of a CRONOS scene."""
        default = CronosEnvConfig()
        given = {*given, *(f.name for f in fields(env) if getattr(env, f.name) != getattr(default, f.name))}
        if wrong := next((name for name in ELSEWHERE if name in given), None):
            raise ValueError(f"--env.{wrong} is of lerobot-eval; here it is --{ELSEWHERE[wrong]}")
        for name, value in self._derived(given).items():
            if name not in given:
                setattr(env, name, value)
        # The size of the state tells it, in the scene that is known by now.
        if self.policy is not None and "task_observation" not in given:
            env.task_observation = task_observation_of(self.policy.input_features or {}, env)
        if "fps" not in given:
            # Of the scene, which may be another one by now.
            env.fps = 0
        env.__post_init__()
        if self.eval.videos:
            check_video_size("--env.render_size", env.render_size)

    def _derived(self, given: Collection[str]) -> dict[str, Any]:
        """Fields of `env` that follow from the policy: its training's scene and renderer, and what it observes."""
        if self.policy is None:
            return {"obs_type": "environment_state_agent_pos"}
        path = self.policy.pretrained_path
        scene = {} if {"benchmark", "scene"} & set(given) else trained_scene(path)
        return trained_observations(self.policy.input_features or {}, path) | scene

    def chains(self, benchmark: Benchmark, suite: str, split: str) -> list[Chain]:
        """What is run of a suite and split."""
        quick = (QUICK_CONFIGURATIONS, QUICK_ORDERINGS) if self.quick else (None, None)
        configurations, orderings = self.eval.n_episodes or quick[0], self.eval.orderings or quick[1]
        return make_chains(benchmark, suite, split, configurations, orderings)

    def check_world(self, env: Streams) -> None:
        """Raise a ValueError unless a world has what the flags need."""
        if self.end_effector_reset:
            check_capability(env, "end_effector_reset", "--end_effector_reset=true")

    @cached_property
    def policy_fingerprint(self) -> str:
        """What tells the policy from another one of its name."""
        return EXPERT if self.policy is None else fingerprint(self.policy)

    def header(self, env: Streams, suite: str, split: str) -> dict[str, Any]:
        """What results.json says about how a suite and split was evaluated in a world, as JSON values."""
        shown, policy, identity = self.env, self.policy, env.identity
        observation = {name: draccus.encode(getattr(shown, name)) for name in OBSERVATION if hasattr(shown, name)}
        return {
            "format": FORMAT,
            "policy": self.policy_name,
            "policy_fingerprint": self.policy_fingerprint,
            "policy_files": policy and files_fingerprint(Path(policy.pretrained_path or ""), with_base=False),
            "policy_revision": self.policy_revision,
            "policy_config": draccus.encode(policy) if policy else None,
            "reads_privileged_state": policy is not None and reads_privileged_state(policy),
            "scene": check_environment_id(identity.id, "the environment"),
            "environment": identity.id,
            "benchmark": {"source": identity.source, "fingerprint": identity.fingerprint},
            "suite": suite,
            "split": split,
            "total": len(make_chains(benchmark_of(env), suite, split)),
            "obs_type": obs_type_of(shown),
            "renderer": getattr(shown, "renderer", None),
            "observation": observation | {"rename_map": self.rename_map},
            "temperature": self.eval.temperature,
            "seed": self.seed,
            "advance": self.advance,
            "end_effector_reset": self.end_effector_reset,
        }

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields that take `--<field>.path`."""
        return ["policy"]


def obs_type_of(env: EnvConfig) -> str:
    """LeRobot's name of the kind of observation."""
    if hasattr(env, "obs_type"):
        return str(env.obs_type)
    shows_pictures = any(feature.type is FeatureType.VISUAL for feature in env.features.values())
    return "pixels_agent_pos" if shows_pictures else "environment_state_agent_pos"


OBSERVATION = ("camera_name", "observation_height", "observation_width", "privileged_state", "task_observation")
"""Fields of `env` that say what a policy is shown, beside `obs_type` and `renderer`."""
SETTING = (
    "policy_fingerprint", "environment", "obs_type", "renderer", "observation", "seed", "advance",
    "end_effector_reset", "n",
)  # fmt: skip
"""Fields of results.json in which a suite and split that is done must agree with the command."""


def check_same(there: dict[str, Any], here: dict[str, Any], file: Path) -> None:
    """Check that a results.json is what the command would make.

    Args:
        there: the results.
        here: `CronosEvalConfig.header`, and `n`.
        file: of the results.

    Raises:
        ValueError: it is of another policy or another setting; names what differs.
    """
    pairs = {name: (there.get(name), here[name]) for name in SETTING}
    pairs["benchmark"] = there["benchmark"].get("fingerprint"), here["benchmark"]["fingerprint"]
    if (temperature := there.get("temperature")) is not None:
        # None: the policy does not sample at the temperature of the evaluation.
        pairs["temperature"] = temperature, here["temperature"]
    changes = [f"{name}: {old} there, {new} now" for name, (old, new) in pairs.items() if old != new]
    if changes:
        raise ValueError(f"{file} is of another evaluation ({'; '.join(changes)}): choose another --output_dir")
