"""The configuration of a training run, `cronos-train`, LeRobot's way."""

from __future__ import annotations

import datetime as dt
import json
import math
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from draccus.cfgparsing import load_config, parse_string
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import PeftConfig, WandBConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.envs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.utils.constants import ACTION, CHECKPOINTS_DIR, OBS_ENV_STATE, PRETRAINED_MODEL_DIR
from lerobot_env_cronos import CronosEnvConfig, load_benchmark
from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS
from lerobot_env_cronos.hub_config import is_of_this_package

from cronos_lerobot.agents import builtin  # noqa: F401  (registers the agents)
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.registry import check_agent, check_reward, check_settings
from cronos_lerobot.evaluation.policy_source import PINNED, load_policy_config, pin_policy
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.experts import check_expert
from cronos_lerobot.protocol.resets import check_extra_resets
from cronos_lerobot.protocol.task_orders import check_task_order
from cronos_lerobot.training.record_config import RecordConfig
from cronos_lerobot.training.resume import (
    check_resumed,
    check_types,
    import_plugins,
    was_never_told_where_to_push,
)

EVALUATION_ONLY = {
    "task": "a run trains every task of the scene",
    "suite": "the periodic evaluation is of single tasks",
    "split": "training is on train, --eval.split chooses for the periodic evaluation",
    "advance": "--protocol.task_switch_interval says when a stream goes on to its next task",
    "end_effector_reset": "of training it is --protocol.end_effector_reset",
}
"""Flags of the environment that only lerobot-eval reads, each with what holds in place of it."""


@dataclass
class PeriodicEvaluationConfig:
    """Independent evaluation on environments of its own: every task from every configuration."""

    n_episodes: int = NUM_CONFIGURATIONS
    """Configurations for each task: the first ones of the split, which has 64, or as many as its benchmark."""
    repetitions: int = 1
    """Episodes of each task and configuration, each with random numbers of its own."""
    split: str = "train"
    """Configurations to evaluate on: `train` or `held_out`."""
    temperature: float = 0.6
    """Sampling temperature; 0 takes the likeliest action."""
    batch_size: int = 64
    """Parallel environments of the evaluation."""
    seed: int = 1000
    """Seed of the action sampling, the same at every evaluation."""

    def __post_init__(self) -> None:
        if self.n_episodes < 1:
            raise ValueError(f"eval.n_episodes must be >= 1, got {self.n_episodes}.")
        if self.repetitions < 1:
            raise ValueError(f"eval.repetitions must be >= 1, got {self.repetitions}.")
        if self.repetitions > 1 and not self.temperature:
            raise ValueError(f"eval.repetitions={self.repetitions} would all be alike at eval.temperature=0.")
        if self.split not in ("train", "held_out"):
            raise ValueError(f"eval.split must be 'train' or 'held_out', got {self.split!r}.")
        if not 0 <= self.temperature < math.inf:
            raise ValueError(f"eval.temperature must be >= 0 and finite, got {self.temperature}.")
        if self.batch_size < 1:
            raise ValueError(f"eval.batch_size must be >= 1, got {self.batch_size}.")
        if self.seed < 0:
            raise ValueError(f"eval.seed must be >= 0, got {self.seed}.")


@dataclass
class CronosTrainConfig:
    """Reset-free reinforcement learning of a LeRobot policy. Values out of range are a ValueError."""

    env: EnvConfig | None = None
    """The scene: --env.type=cronos --env.scene=kitchen_2x2 ..."""
    policy: PreTrainedConfig | None = None
    """The policy to start from: --policy.path=<checkpoint or Hub id>, or --policy.type=... from scratch."""
    output_dir: Path | None = None
    """Folder of the run: checkpoints, metrics, TensorBoard; must not exist unless resuming."""
    job_name: str | None = None
    """Name of the run; <env>_<policy> by default."""
    resume: bool = False
    """Continue a run: --resume=true --config_path=<run>/checkpoints/last/pretrained_model/train_config.json"""
    seed: int = 1000
    """Seed of everything random in the run."""
    steps: int = 1_300_000
    """S: interaction steps, summed over the streams; rounded up to whole policy updates."""
    num_envs: int = 64
    """N: parallel streams, of all processes together."""
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    """When a stream switches task, when the policy learns, and what help a stream gets."""
    algorithm: RLAlgorithmConfig = field(default_factory=PPOConfig)
    """How the policy learns: --algorithm.type=ppo (PocketVLA's settings, default), ppo_paper or another agent."""
    peft: PeftConfig | None = None
    """Train adapters in the policy's layers (LoRA) in place of its weights, as in lerobot-train: --peft.r=16"""
    record: RecordConfig = field(default_factory=RecordConfig)
    """Recording of the streams."""
    eval: PeriodicEvaluationConfig = field(default_factory=PeriodicEvaluationConfig)
    """The periodic evaluation."""
    eval_freq: int = 102_400
    """Interaction steps between two evaluations; one more before the first step, one after the last.
    0 never does so by the steps."""
    eval_at_interventions: list[int] = field(default_factory=list)
    """Evaluate also at the first policy update at which so many interventions have been counted, for each of
    these: what a run came to after 1000 of them is then measured."""
    save_checkpoint: bool = True
    """Save checkpoints."""
    save_freq: int = 102_400
    """Interaction steps between two checkpoints; one more at the end. 0 saves only that one."""
    keep_checkpoints: int | None = None
    """Keep only this many checkpoints, the latest; null keeps all."""
    log_freq: int = 1
    """Policy updates between two lines on the console; metrics.jsonl has every update."""
    tensorboard: bool = True
    """Write TensorBoard events to <output_dir>/tensorboard."""
    wandb: WandBConfig = field(default_factory=WandBConfig)
    """Weights & Biases."""
    torch_threads: int | None = None
    """Threads of PyTorch on the CPU, in each process; null becomes PyTorch's own choice (the cores, or
    OMP_NUM_THREADS), which the checkpoints' config then names."""
    checkpoint_path: Path | None = field(init=False, default=None)
    """The checkpoint to resume from, set by `validate`."""

    def __post_init__(self) -> None:
        for name in ("steps", "num_envs", "log_freq"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, got {getattr(self, name)}.")
        for name in ("eval_freq", "save_freq", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be >= 0, got {getattr(self, name)}.")
        if any(count < 1 for count in self.eval_at_interventions):
            raise ValueError(f"eval_at_interventions must be >= 1 each, got {self.eval_at_interventions}.")
        for name in ("keep_checkpoints", "torch_threads"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"{name} must be >= 1 or null, got {value}.")
        check_task_order(self.protocol.task_order)
        check_extra_resets(self.protocol.extra_resets)
        check_expert(self.protocol.takeover_expert)

    @property
    def steps_per_update(self) -> int:
        """Interaction steps, summed over the streams, between two policy updates."""
        return self.num_envs * self.protocol.update_interval

    @property
    def total_steps(self) -> int:
        """`steps` rounded up to whole policy updates."""
        return -(-self.steps // self.steps_per_update) * self.steps_per_update

    @property
    def weights_path(self) -> Path | None:
        """Where the policy is loaded from: a folder or, of the Hub, a repository; None begins from scratch."""
        if self.checkpoint_path is not None:
            return self.checkpoint_path / PRETRAINED_MODEL_DIR
        return None if self.policy is None else self.policy.pretrained_path

    def validate(self) -> None:
        """Resolve paths given on the command line, as LeRobot's own training config does.

        Raises:
            ValueError: the policy, the environment or, when resuming, the checkpoint is missing.
            OSError: the output folder exists and the run is not a resumed one, or recording would fail.
        """
        if self.resume:
            self._resolve_checkpoint()
        if self.env is None:
            raise ValueError("Choose an environment: --env.type=cronos --env.scene=kitchen_2x2.")
        if not is_of_this_package(self.env):
            raise ValueError(f"--env.type must be cronos to train in, got {self.env.type!r}.")
        if not self.resume:
            self.check_env(self.env)
            self.check_start()
            self._check_base()
        check_agent(self.algorithm.type)
        check_reward(self.algorithm, self.protocol.reward)
        given = (flag.removeprefix("--").split("=")[0] for flag in parser.get_cli_overrides("algorithm") or [])
        check_settings(self.algorithm, given, resume=self.resume)
        self._pin_benchmark(self.env)
        if not self.resume and (path := parser.get_path_arg("policy")):
            overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
            path, revision = pin_policy(path, parser.parse_arg(PINNED, overrides))
            self.policy = load_policy_config(path, overrides, revision)
            if not any(override.startswith("--repo_id") for override in overrides):
                # That of the policy's own, which is not to be pushed over.
                self.policy.repo_id = None
        if self.policy is None:
            raise ValueError("Choose a policy: --policy.path=<checkpoint or Hub id>, or --policy.type=<name>.")
        self._check_pushed(self.policy)
        self._show_what_is_read(self.env, self.policy)
        self.job_name = self.job_name or f"{self.env.type}_{self.policy.type}"
        if self.output_dir is None:
            self.output_dir = Path("outputs/train") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_{self.job_name}"
        if not self.resume and Path(self.output_dir).exists():
            raise FileExistsError(f"{self.output_dir} exists; choose another --output_dir or --resume=true.")
        if self.checkpoint_path is not None:
            check_resumed(self, self.checkpoint_path)
        self.record.check(
            Path(self.output_dir), self.num_envs, self.env, self.protocol.task_switch_interval, resume=self.resume
        )

    @staticmethod
    def check_env(env: CronosEnvConfig) -> None:
        """Refuse what training would not follow."""
        for name, why in EVALUATION_ONLY.items():
            if (value := getattr(env, name)) != getattr(CronosEnvConfig, name):
                raise ValueError(f"--env.{name}={value} is of lerobot-eval: {why}.")

    def check_start(self) -> None:
        """Refuse what a run should not begin with, or has no effect beside the others."""
        self.protocol.check_start()
        if not (self.eval_freq or self.eval_at_interventions):
            default = PeriodicEvaluationConfig()
            for name, value in vars(self.eval).items():
                if value != getattr(default, name):
                    raise ValueError(
                        f"--eval.{name}={value} is of the periodic evaluation, and there is none with "
                        "--eval_freq=0: leave it out."
                    )
        # What gives both one frequency gives it whether or not they are wanted, as cronos-reproduce does.
        unread = {
            "save_freq": self.save_freq not in (CronosTrainConfig.save_freq, self.eval_freq),
            "keep_checkpoints": self.keep_checkpoints is not None,
        }
        for name, is_set in unread.items():
            if is_set and not self.save_checkpoint:
                raise ValueError(
                    f"--{name}={getattr(self, name)} is of checkpoints, and there are none with "
                    "--save_checkpoint=false: leave it out."
                )

    def _check_base(self) -> None:
        """Refuse a config that names, as the policy to begin with, a checkpoint of the run that it is of.

        Earlier versions wrote it when they resumed a run.
        """
        file, path = parser.parse_arg("config_path"), self.weights_path
        if file is None or path is None or parser.get_path_arg("policy"):
            return
        checkpoints = _checkpoint_of(file).parent
        if checkpoints.name == CHECKPOINTS_DIR and Path(path).resolve().is_relative_to(checkpoints):
            raise ValueError(
                f"--config_path={file} is of a run that was resumed from {path}, and a new run would begin with "
                "that: give the policy that it is to begin with as --policy.path."
            )

    @staticmethod
    def _check_pushed(policy: PreTrainedConfig) -> None:
        """Push to a repository that is given; refuse to push nowhere, and what contradicts itself."""
        overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
        given = {override.removeprefix("--").split("=")[0] for override in overrides}
        if "repo_id" in given and policy.repo_id:
            if "push_to_hub" in given and not policy.push_to_hub:
                raise ValueError(
                    f"--policy.repo_id={policy.repo_id} is where the run is pushed to, and "
                    "--policy.push_to_hub=false pushes nothing: leave one of the two out."
                )
            policy.push_to_hub = True
        elif "push_to_hub" in given and policy.push_to_hub and not policy.repo_id:
            raise ValueError("--policy.push_to_hub=true pushes nowhere without --policy.repo_id=<user>/<name>.")

    @staticmethod
    def _pin_benchmark(env: CronosEnvConfig) -> None:
        """A benchmark of the Hub stays what it was when the run began."""
        if env.benchmark is not None and not Path(env.benchmark).is_dir():
            env.benchmark = load_benchmark(env.benchmark, env.scene).source

    def _show_what_is_read(self, env: CronosEnvConfig, policy: PreTrainedConfig) -> None:
        """A policy or a critic that reads the privileged state is shown it."""
        reads = OBS_ENV_STATE in (policy.input_features or {})
        if getattr(self.algorithm, "critic_observation", "policy") == "environment_state":
            reads = True
            if env.obs_type == "pixels_agent_pos" and not policy.input_features:
                # From scratch LeRobot lets the policy read all that is shown, and this is for the critic alone.
                shown = env_to_policy_features(env)
                policy.input_features = {key: shown[key] for key in shown.keys() - {ACTION, OBS_ENV_STATE}}
        if reads and OBS_ENV_STATE not in env.features_map.values():
            env.privileged_state = True
            env.__post_init__()

    def _resolve_checkpoint(self) -> None:
        given = parser.parse_arg("config_path")
        if given is None and self.checkpoint_path is None:
            raise ValueError(
                f"Resuming needs --config_path=<run>/checkpoints/last/{PRETRAINED_MODEL_DIR}/{TRAIN_CONFIG_NAME}."
            )
        if given is not None:
            self.checkpoint_path = _checkpoint_of(given)
            run_folder = self.checkpoint_path.parent.parent
            output_dir = parser.parse_arg("output_dir")
            if output_dir is not None and Path(output_dir).resolve() != run_folder:
                raise ValueError(
                    f"--output_dir={output_dir}, but the run that is resumed is {run_folder}, and stays there."
                )
            if self.output_dir is None or Path(self.output_dir).resolve() != run_folder:
                self.output_dir = run_folder

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields that take `--<field>.path`."""
        return ["policy"]

    @classmethod
    def from_pretrained(cls, path: str | Path, *, cli_args: list[str] | None = None) -> CronosTrainConfig:
        """Read a saved config, a train_config.json or its folder, with flags that override it.

        Raises:
            FileNotFoundError: there is no such file.
        """
        file = Path(path) / TRAIN_CONFIG_NAME if Path(path).is_dir() else Path(path)
        if not file.is_file():
            raise FileNotFoundError(f"No training config at {file}.")
        asked = parser.parse_arg("resume", cli_args or [])
        kind = "json" if file.suffix == ".json" else "yaml"
        if _is_true(asked, kind):
            # LeRobot's parser keeps the plugins of the command line from `cli_args`.
            import_plugins(_checkpoint_of(file), sys.argv[1:])
            check_types(_checkpoint_of(file), cli_args or [])
        with draccus.config_type(kind), _without_other_types(file, cli_args or []) as read:
            config = draccus.parse(cls, read, args=cli_args or [])
        # The file of a resumed run may say it, which asks for nothing.
        config.resume = config.resume and asked is not None
        if file.name == TRAIN_CONFIG_NAME:
            config._forget_what_is_not_its_own(file, cli_args or [])
        return config

    def _forget_what_is_not_its_own(self, file: Path, cli_args: list[str]) -> None:
        """Of a config that a run has written: a new run is logged to W&B as one of its own."""
        if not self.resume and parser.parse_arg("wandb.run_id", cli_args) is None:
            self.wandb.run_id = None
        is_given = parser.parse_arg("policy.repo_id", cli_args) is not None
        if self.policy is not None and self.peft is not None and not self.resume:
            # Earlier versions wrote that the policy to begin with has the adapters already.
            self.policy.use_peft = False
        if self.policy is not None and not is_given and was_never_told_where_to_push(_checkpoint_of(file)):
            self.policy.repo_id = None

    def save_pretrained(self, folder: Path) -> None:
        """Write train_config.json into `folder`."""
        (folder / TRAIN_CONFIG_NAME).write_text(json.dumps(self.to_dict(), indent=4))

    def to_dict(self) -> dict[str, Any]:
        """Return the config as JSON-ready values."""
        config = draccus.encode(self)
        config.pop("checkpoint_path", None)
        return config

    # What lerobot's WandBLogger asks of a training config.
    is_reward_model_training = False
    dataset = None


@contextmanager
def _without_other_types(file: Path, cli_args: list[str]) -> Generator[Path]:
    """The file, or a copy without what it says of an agent, a policy or an environment of a type not asked for.

    It would be laid over the defaults of that type.
    """
    asked = {name: parser.get_type_arg(name, cli_args) for name in ("env", "policy", "algorithm")}
    with file.open() as opened:
        content = load_config(opened)
    key = draccus.CHOICE_TYPE_KEY
    others = [n for n, kind in asked.items() if kind and (content.get(n) or {}).get(key, kind) != kind]
    with tempfile.TemporaryDirectory() as folder:
        if others:
            file = Path(folder) / file.name
            file.write_text(json.dumps(content | {name: {key: asked[name]} for name in others}))
        yield file


def _is_true(value: str | None, kind: str) -> bool:
    """Whether draccus reads a flag as true: beside a file of YAML `yes` is, beside one of JSON it is refused."""
    with draccus.config_type(kind):
        read = None if value is None else parse_string(value)
    return read is True or read == "true"


def _checkpoint_of(config_path: str | Path) -> Path:
    """The checkpoint that a train_config.json, or the folder it lies in, belongs to."""
    path = Path(config_path)
    return (path if path.is_dir() else path.parent).resolve().parent
