"""The configuration of `cronos-eval`, LeRobot's way."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import draccus
from draccus.cfgparsing import load_config
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs.configs import EnvConfig
from lerobot_env_cronos import Benchmark, CronosEnvConfig, gymnasium_id, load_benchmark
from lerobot_env_cronos.benchmark.benchmark import SUITES
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.hub_config import is_of_this_package

from cronos_lerobot.data.video import check_video_size
from cronos_lerobot.evaluation.plan import Part, make_parts
from cronos_lerobot.evaluation.policy_env import check_observations, trained_observations, trained_scene
from cronos_lerobot.evaluation.policy_source import (
    PolicySource,
    files_fingerprint,
    find_policy,
    fingerprint,
    load_policy_config,
)

QUICK_CONFIGURATIONS, QUICK_ORDERINGS = 16, 3
EXPERT = "scripted expert"


@dataclass
class SuitesConfig:
    """What is evaluated."""

    suites: str = "independent,sequential"
    """Suites, comma-separated: independent, sequential."""
    splits: str = "train,held_out"
    """Splits of the configurations, comma-separated: train, held_out."""
    n_episodes: int | None = None
    """Configurations of each split, the first ones, for every task and ordering; null for all 64 (quick: 16)."""
    orderings: int | None = None
    """Orderings of the sequential suite, the first ones; null for all 10 (quick: 3)."""
    repetitions: int = 1
    """Episodes of each task and configuration in the independent suite; another repetition has the next seed.
    A policy that draws no numbers only does the same again."""
    temperature: float = 0.6
    """Sampling temperature of policies that have one (`sample_actions`); 0 takes the likeliest action."""
    batch_size: int = 64
    """Parallel environments."""
    videos: int = 1
    """Good chains to film, and bad ones, for every suite and split; 0 films none."""

    def __post_init__(self) -> None:
        for name, valid in (("suites", SUITES), ("splits", SPLITS)):
            value = getattr(self, name)
            chosen = _words(value)
            if not chosen or set(chosen) - set(valid) or len(set(chosen)) < len(chosen):
                raise ValueError(f"eval.{name} must be of {list(valid)}, comma-separated, got {value!r}")
        for name, least in (
            ("n_episodes", 1),
            ("orderings", 1),
            ("repetitions", 1),
            ("temperature", 0),
            ("batch_size", 1),
            ("videos", 0),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"eval.{name} must be at least {least}, got {value}")
        if self.repetitions > 1 and "independent" not in _words(self.suites):
            raise ValueError("eval.repetitions is of the independent suite; eval.suites leaves it out")


@dataclass
class CronosEvalConfig:
    """Evaluate a policy on single tasks and on chains of tasks.

    After a kill, the same command goes on from there, with the --output_dir that it had.
    """

    env: EnvConfig = field(default_factory=CronosEnvConfig)
    """Scene, benchmark and observations. What is not given follows from the benchmark, if there is one, and from
    the policy: the scene and the renderer that it was trained with, and the images or the state that it takes.
    Flags and the file of --config_path give fields; in Python, values other than the defaults do."""
    policy: PreTrainedConfig | None = None
    """The policy: --policy.path=<checkpoint, or Hub id[@revision]>."""
    eval: SuitesConfig = field(default_factory=SuitesConfig)
    """Suites, splits, and how much of them."""
    advance: str = "window"
    """When a chain goes on to its next task: window (the task's 80 steps are over) or on_success (at once)."""
    end_effector_reset: bool = False
    """Send the arm home between the tasks of a chain."""
    quick: bool = False
    """Fewer configurations and orderings: 16 and 3."""
    expert: bool = False
    """Evaluate the scripted expert, the ceiling, in place of a policy."""
    seed: int = 1000
    """Seed of the action sampling; configurations and orderings are the same at any seed."""
    output_dir: Path | None = None
    """Folder for results.json, videos/ and parts/; a new one in outputs/eval by default. Finished parts of the
    same evaluation in it are kept."""
    rename_map: dict[str, str] = field(default_factory=dict)
    """Observations to rename for the policy, as in lerobot-eval."""
    compare_with: Path | None = None
    """Evaluation of another policy, its folder or results.json: compare with it, episode by episode."""
    stop_at_error: float | None = None
    """With --compare_with: stop each suite and split as soon as it is decided which of the two did better; the
    probability of a decision between two that do alike, such as 0.05. Films nothing, writes comparison.json."""
    torch_threads: int | None = None
    """Threads of PyTorch on the CPU; null leaves PyTorch's default."""
    source: PolicySource | None = field(init=False, default=None)
    """Where the policy was found, set by `validate`."""

    def validate(self) -> None:
        """Resolve the policy and what follows from it.

        Raises:
            ValueError: a value is not valid, or there is nothing to evaluate.
        """
        if not is_of_this_package(self.env):
            raise ValueError(f"cronos-eval evaluates --env.type=cronos, got {self.env.type!r}")
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")
        if self.torch_threads is not None and self.torch_threads < 1:
            raise ValueError(f"torch_threads must be at least 1, or null, got {self.torch_threads}")
        self._check_comparison()
        self._check_repetitions()
        self._check_chains()
        given = {flag.split("=")[0] for flag in parser.get_cli_overrides("env") or []}
        for name, other in (("suite", "eval.suites"), ("split", "eval.splits"), ("task", "eval.orderings")):
            if f"--{name}" in given:
                raise ValueError(f"--env.{name} is of lerobot-eval; here it is --{other}")
        for name in ("advance", "end_effector_reset"):
            if f"--{name}" in given:
                raise ValueError(f"--env.{name} is of lerobot-eval; here it is --{name}")
        self._load_policy()
        self._derive_env({name.removeprefix("--") for name in given})
        self.env.advance, self.env.end_effector_reset = self.advance, self.end_effector_reset
        self.env.__post_init__()
        if self.eval.videos:
            check_video_size("--env.render_size", self.env.render_size)
        if self.policy is not None and not self.rename_map:
            check_observations(self.policy, self.env)
        most = self._most_configurations(self.suites, self.splits)
        if self.eval.n_episodes is not None and self.eval.n_episodes > most:
            raise ValueError(f"eval.n_episodes must be 1 to {most}, got {self.eval.n_episodes}")
        most = self._most_orderings(self.splits)
        if self.eval.orderings is not None and self.eval.orderings > most:
            raise ValueError(f"eval.orderings must be 1 to {most}, got {self.eval.orderings}")
        if self.output_dir is None:
            name = "expert" if self.policy is None else self.policy.type
            name += "" if self.stop_at_error is None else "_compared"
            self.output_dir = Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_cronos_{name}"

    def _check_comparison(self) -> None:
        if self.stop_at_error is None:
            return
        if self.compare_with is None:
            raise ValueError("--stop_at_error needs another policy's evaluation: --compare_with=<folder>")
        if not 0 < self.stop_at_error < 1:
            raise ValueError(f"stop_at_error must be between 0 and 1, got {self.stop_at_error}")
        given = {flag.split("=")[0] for flag in parser.get_cli_overrides("eval") or []}
        # The default cannot be told from one that a config made in Python gives.
        if self.eval.videos and (self.eval.videos != SuitesConfig.videos or "--videos" in given):
            raise ValueError(f"--stop_at_error films nothing: leave --eval.videos={self.eval.videos} out")
        self.eval.videos = 0

    def _check_repetitions(self) -> None:
        repetitions = self.eval.repetitions
        if repetitions > 1 and (self.expert or not self.eval.temperature):
            why = "--expert=true" if self.expert else "--eval.temperature=0"
            raise ValueError(f"eval.repetitions={repetitions} would all be alike with {why}")
        if repetitions > 1 and self.stop_at_error is not None:
            raise ValueError("--stop_at_error looks at every episode once: leave --eval.repetitions out")

    def _check_chains(self) -> None:
        """Refuse what says how chains are evaluated where there are none."""
        if "sequential" in self.suites:
            return
        for name, value, default in (
            ("eval.orderings", self.eval.orderings, None),
            ("advance", self.advance, CronosEvalConfig.advance),
            ("end_effector_reset", self.end_effector_reset, CronosEvalConfig.end_effector_reset),
        ):
            if value != default:
                raise ValueError(
                    f"--{name}={value} is of the sequential suite; --eval.suites={self.eval.suites} leaves it out"
                )

    def _load_policy(self) -> None:
        path = parser.get_path_arg("policy")
        if self.expert:
            if path or self.policy is not None:
                raise ValueError("--expert=true and --policy.path exclude each other")
            return
        if path:
            overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
            self.source = find_policy(path)
            self.policy = load_policy_config(str(self.source.folder), overrides)
        if self.policy is None or not self.policy.pretrained_path:
            raise ValueError("choose a policy: --policy.path=<checkpoint or Hub id> (or --expert=true)")

    def _derive_env(self, given: set[str]) -> None:
        """Set what is not given: the training's scene and renderer, and what the policy observes.

        Args:
            given: fields of `env` that flags give.
        """
        env, default = self.env, CronosEnvConfig()
        assert isinstance(env, CronosEnvConfig)
        given = given | _env_of_file(parser.parse_arg("config_path"))
        # A default that a config made in Python gives cannot be told from one that it leaves alone.
        given |= {f.name for f in fields(env) if getattr(env, f.name) != getattr(default, f.name)}
        derived: dict[str, Any] = {}
        if self.policy is None:
            derived["obs_type"] = "environment_state_agent_pos"
        else:
            derived = trained_observations(self.policy.input_features or {}, self.policy.pretrained_path)
            if env.benchmark is None and "scene" not in given:
                derived |= trained_scene(self.policy.pretrained_path)
        for name, value in derived.items():
            if name not in given:
                setattr(env, name, value)

    @property
    def suites(self) -> list[str]:
        """Suites to evaluate."""
        return _words(self.eval.suites)

    @property
    def splits(self) -> list[str]:
        """Splits to evaluate on."""
        return _words(self.eval.splits)

    def benchmark(self) -> Benchmark:
        """What `env` names: its configurations, episodes and chains."""
        assert isinstance(self.env, CronosEnvConfig)
        return load_benchmark(self.env.benchmark, self.env.scene)

    @property
    def num_configurations(self) -> int:
        """Configurations of each task and ordering, of whatever is chosen: the rest may be added to its folder."""
        most = self._most_configurations(SUITES, SPLITS)
        return self.eval.n_episodes or (min(most, QUICK_CONFIGURATIONS) if self.quick else most)

    def _most_configurations(self, suites: Sequence[str], splits: Sequence[str]) -> int:
        benchmark = self.benchmark()
        groups = [benchmark.groups(suite, split) for suite in suites for split in splits]
        return max(len(group.configurations) for group in chain.from_iterable(groups))

    @property
    def num_orderings(self) -> int:
        """Orderings of the sequential suite."""
        most = self._most_orderings(SPLITS)
        return min(most, self.eval.orderings or (QUICK_ORDERINGS if self.quick else most))

    def _most_orderings(self, splits: Sequence[str]) -> int:
        benchmark = self.benchmark()
        return max(len(benchmark.groups("sequential", split)) for split in splits)

    def make_parts(self) -> list[Part]:
        """All that is to be run."""
        return make_parts(
            self.benchmark(),
            self.suites,
            self.splits,
            self.num_configurations,
            self.num_orderings,
            self.eval.repetitions,
        )

    def to_dict(self) -> dict[str, Any]:
        """The config as JSON values."""
        config = draccus.encode(self)
        config.pop("source", None)
        return config

    @property
    def policy_name(self) -> str:
        """The policy as it was given; of a run's last checkpoint the one that it was then."""
        if self.policy is None:
            return EXPERT
        return self.source.name if self.source else str(self.policy.pretrained_path)

    @cached_property
    def policy_fingerprint(self) -> str:
        """What tells the policy from another one of its name."""
        return EXPERT if self.policy is None else fingerprint(self.policy)

    @cached_property
    def policy_files(self) -> str | None:
        """The same of its weights and processors alone, whatever flags made of its config; None of the expert."""
        if self.policy is None:
            return None
        return files_fingerprint(Path(self.policy.pretrained_path or ""), with_base=False)

    def identity(self) -> dict[str, Any]:
        """Everything that decides the result of a chain, as JSON values."""
        env = self.env
        assert isinstance(env, CronosEnvConfig)
        decisive = (
            "scene", "obs_type", "privileged_state", "observation_height", "observation_width", "camera_name"
        )  # fmt: skip
        own = {}
        if env.task_observation != "none":
            own["task_observation"] = env.task_observation
        if env.renderer != "classic" and env.obs_type == "pixels_agent_pos":
            own["renderer"] = env.renderer
        return own | {
            "environment": gymnasium_id(self.benchmark().scene.name),
            "benchmark": self.benchmark().fingerprint,
            "policy": self.policy_fingerprint,
            "env": {name: getattr(env, name) for name in decisive},
            "n_episodes": self.num_configurations,
            "orderings": self.num_orderings,
            "temperature": self.eval.temperature,
            "batch_size": self.eval.batch_size,
            "advance": self.advance,
            "end_effector_reset": self.end_effector_reset,
            "seed": self.seed,
            "rename_map": self.rename_map,
        }

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields that take `--<field>.path`."""
        return ["policy"]


def _env_of_file(path: str | None) -> set[str]:
    """The fields of `env` that the file of --config_path gives, if there is one."""
    if path is None:
        return set()
    with open(path) as file:
        return set((load_config(file, file=path) or {}).get("env") or {})


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]
