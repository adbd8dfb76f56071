"""The configuration of a training run, `cronos-train`: the fields, and what is checked of them."""

from __future__ import annotations

import datetime as dt
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.configs.default import PeftConfig, WandBConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.envs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, PRETRAINED_MODEL_DIR
from lerobot_env_cronos import CronosEnvConfig, load_benchmark

from cronos_lerobot.agents import builtin  # noqa: F401  (registers the agents)
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.registry import AGENTS, AgentConfig
from cronos_lerobot.data.video import MAX_FILE_DURATION_S, check_video_size
from cronos_lerobot.data.writer import FLUSH_INTERVAL_S
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.resets import EXTRA_RESETS
from cronos_lerobot.protocol.streams import Streams, check_capability, check_makes_streams, steps_per_task
from cronos_lerobot.protocol.task_orders import TASK_ORDERS
from cronos_lerobot.ranges import check_ranges, ranged
from cronos_lerobot.robot import config as _robot  # noqa: F401  (registers cronos_robot)

EVALUATION_ONLY = ("task", "suite", "split", "advance", "end_effector_reset")
"""Fields of the environment that only evaluations read."""
AUTO = "auto"
"""Value of `resume` that begins a run, or continues it, or does nothing."""


@dataclass
class RecordConfig:
    """Record training streams as a LeRobotDataset."""

    repo_id: str | None = None
    """Name of the dataset, user/name; null records nothing."""
    root: Path | None = None
    """Folder of the dataset; <output_dir>/streams by default."""
    streams: str = "1"
    """How many of the streams to record, the first N: a number or `all`."""
    flush_interval_s: float = ranged(FLUSH_INTERVAL_S, above=0)
    """The longest that a finished segment waits to be written [s]; a killed run loses what waits."""

    def count(self, num_envs: int) -> int:
        """Recorded streams of `num_envs`.

        Raises:
            ValueError: `streams` is neither `all` nor a number from 1 to `num_envs`.
        """
        number = str(num_envs) if self.streams == "all" else str(self.streams)
        if not (number.isdigit() and 1 <= int(number) <= num_envs):
            raise ValueError(f"--record.streams must be `all` or 1 to {num_envs}, got {self.streams!r}.")
        return int(number)

    def check(self, num_envs: int, env: EnvConfig, segment_length: int) -> None:
        """Find at the start what the writer would stumble over after hours.

        Raises:
            ValueError: `num_envs` are fewer streams than asked for, or a video cannot hold a picture of `env` or
                `segment_length` control steps.
        """
        if self.repo_id is None:
            return
        self.count(num_envs)
        if segment_length > (longest := int(MAX_FILE_DURATION_S * env.fps)):
            raise ValueError(
                f"--protocol.task_switch_interval must be <= {longest} to be recorded (a video of "
                f"{MAX_FILE_DURATION_S:.0f} s), got {segment_length}."
            )
        for key, feature in env.features.items():
            if feature.type is FeatureType.VISUAL:
                check_video_size(f"{key} of --env.type={env.type}", feature.shape[:2])


@dataclass
class PeriodicEvaluationConfig:
    """Independent evaluation on environments of its own: every task from every configuration."""

    n_episodes: int | None = ranged(None, minimum=1)
    """Configurations for each task: the first N of the split; null takes all."""
    repetitions: int = ranged(1, minimum=1)
    """Episodes of each task and configuration, each with its own random numbers, if the policy samples."""
    split: str = ranged("train", choices=("train", "held_out"))
    """Configurations to evaluate on: `train` or `held_out`."""
    temperature: float = ranged(0.6, minimum=0)
    """Sampling temperature; 0 takes the likeliest action."""
    batch_size: int = ranged(64, minimum=1)
    """Parallel environments of the evaluation."""
    seed: int = ranged(1000, minimum=0)
    """Seed of the action sampling, the same at every evaluation."""


@dataclass
class CronosTrainConfig:
    """Reset-free reinforcement learning of a LeRobot policy."""

    env: EnvConfig | None = None
    """The scene: --env.type=cronos --env.scene=kitchen_2x2 ..."""
    policy: PreTrainedConfig | None = None
    """The policy to start from: --policy.path=<checkpoint or Hub id>, or --policy.type=... from scratch."""
    output_dir: Path | None = None
    """Folder of the run: checkpoints, metrics, TensorBoard. It must not exist unless you resume."""
    job_name: str | None = None
    """Name of the run; <env>_<policy> by default."""
    resume: bool | str = False
    """`auto` begins the run in --output_dir, resumes it from its last checkpoint, or does nothing if it is done.
    `true` resumes the checkpoint of --config_path=<run>/checkpoints/last/pretrained_model/train_config.json."""
    seed: int = ranged(1000, minimum=0)
    """Seed of everything random in the run."""
    steps: int = ranged(1_300_000, minimum=1)
    """S: interaction steps, summed over the streams; rounded up to whole policy updates."""
    num_envs: int = ranged(64, minimum=1)
    """N: parallel streams, of all processes together."""
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    """When a stream switches task, when the policy learns, and what help a stream gets."""
    algorithm: RLAlgorithmConfig = field(default_factory=PPOConfig)
    """How the policy learns: --algorithm.type=ppo (PocketVLA's settings, default), ppo_paper or another agent."""
    peft: PeftConfig | None = None
    """Train adapters in the policy's layers (LoRA) instead of its weights, as in lerobot-train: --peft.r=16"""
    rename_map: dict[str, str] = field(default_factory=dict)
    """Observations that the policy knows by another name, as in lerobot-train:
    '{"observation.images.front": "observation.images.camera1"}'"""
    record: RecordConfig = field(default_factory=RecordConfig)
    """Recording of the streams."""
    eval: PeriodicEvaluationConfig = field(default_factory=PeriodicEvaluationConfig)
    """The periodic evaluation."""
    eval_freq: int = ranged(102_400, minimum=0)
    """Interaction steps between two evaluations; one more before the first step, one after the last. 0: none."""
    save_checkpoint: bool = True
    """Save checkpoints."""
    save_freq: int = ranged(102_400, minimum=0)
    """Interaction steps between two checkpoints; one more at the end. 0 saves only that one."""
    keep_checkpoints: int | None = ranged(None, minimum=1)
    """Keep only the latest N checkpoints; null keeps all."""
    log_freq: int = ranged(1, minimum=1)
    """Policy updates between two lines on the console; metrics.jsonl has every update."""
    tensorboard: bool = True
    """Write TensorBoard events to <output_dir>/tensorboard."""
    wandb: WandBConfig = field(default_factory=WandBConfig)
    """Weights & Biases."""
    torch_threads: int | None = ranged(None, minimum=1)
    """PyTorch's CPU threads in each process; null takes PyTorch's default, which the run then keeps."""
    checkpoint_path: Path | None = field(init=False, default=None)
    """The checkpoint to resume from; `resume` finds it."""

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

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields that take `--<field>.path`."""
        return ["policy"]

    def save_pretrained(self, folder: Path) -> None:
        """Write train_config.json into `folder`."""
        (folder / TRAIN_CONFIG_NAME).write_text(json.dumps(self.to_dict(), indent=4))

    def to_dict(self) -> dict[str, Any]:
        """Return what describes the run, as JSON has it; not how it was started."""
        encoded = {k: v for k, v in draccus.encode(self).items() if k not in ("checkpoint_path", "resume")}
        return json.loads(json.dumps(encoded))

    # What lerobot's WandBLogger asks of a training config.
    is_reward_model_training = False
    dataset = None


def complete(config: CronosTrainConfig) -> None:
    """Fill in what follows from other values: names, the benchmark's revision, what a policy or critic must see.

    Raises:
        ValueError: there is no environment to train in, or no policy; or an interval is no multiple of K.
    """
    env, policy = config.env, config.policy
    check_makes_streams(env)
    assert env is not None
    if policy is None:
        raise ValueError("Choose a policy: --policy.path=<checkpoint or Hub id>, or --policy.type=<name>.")
    config.protocol.resolve(steps_per_task(env))
    config.job_name = config.job_name or f"{env.type}_{policy.type}"
    if config.output_dir is None:
        config.output_dir = Path("outputs/train") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_{config.job_name}"
    if isinstance(env, CronosEnvConfig):
        if env.benchmark is not None and not Path(env.benchmark).is_dir():
            # One of the Hub stays what it was when the run began.
            env.benchmark = load_benchmark(env.benchmark, env.scene).source
        _show_privileged_state(config, env, policy)


def _show_privileged_state(config: CronosTrainConfig, env: CronosEnvConfig, policy: PreTrainedConfig) -> None:
    """Show it to a policy or a critic that reads it."""
    reads = OBS_ENV_STATE in (policy.input_features or {})
    if getattr(config.algorithm, "critic_observation", "policy") == "environment_state":
        reads = True
        if env.obs_type == "pixels_agent_pos" and not policy.input_features:
            # From scratch LeRobot lets the policy read all that is shown, and this is for the critic alone.
            shown = env_to_policy_features(env)
            policy.input_features = {key: shown[key] for key in shown.keys() - {ACTION, OBS_ENV_STATE}}
    if reads and OBS_ENV_STATE not in env.features_map.values():
        env.privileged_state = True
        env.__post_init__()


def check(config: CronosTrainConfig) -> None:
    """Check a completed config, however it was made.

    Raises:
        ValueError: a value is out of its range, or would train something else than it says; the flag is named.
    """
    check_ranges(config)
    env, policy, options = config.env, config.policy, config.eval
    assert env is not None
    assert policy is not None
    if config.resume not in (False, True, AUTO):
        raise ValueError(f"--resume must be true, false or auto, got {config.resume!r}.")
    for name in EVALUATION_ONLY if isinstance(env, CronosEnvConfig) else ():
        if (value := getattr(env, name)) != getattr(CronosEnvConfig, name):
            raise ValueError(f"--env.{name}={value} is for lerobot-eval; training has --protocol.* and --eval.*.")
    if options.repetitions > 1 and not options.temperature:
        raise ValueError(f"--eval.repetitions={options.repetitions} are all alike at --eval.temperature=0.")
    if policy.use_amp:
        raise ValueError("--policy.use_amp=true: cronos-train learns in the policy's own precision; give false.")
    if policy.push_to_hub and policy.repo_id and not config.save_checkpoint:
        raise ValueError(f"--save_checkpoint=false keeps nothing to push to --policy.repo_id={policy.repo_id}.")
    TASK_ORDERS.check(config.protocol.task_order)
    for name in config.protocol.extra_resets:
        EXTRA_RESETS.check(name)
    AGENTS.check(config.algorithm.type)
    assert isinstance(config.algorithm, AgentConfig)
    config.algorithm.check_reward(config.protocol.reward)
    config.record.check(config.num_envs, env, config.protocol.task_switch_interval)


def check_world(config: CronosTrainConfig, env: Streams) -> None:
    """Check that a world has what a config asks of it.

    Raises:
        ValueError: it has fewer starts, or lacks what a flag needs.
    """
    protocol = config.protocol
    wanted = [("protocol.num_configurations", "train", protocol.num_configurations)]
    if config.eval_freq:
        wanted.append(("eval.n_episodes", config.eval.split, config.eval.n_episodes))
    for flag, split, count in wanted:
        if count is not None and count > (available := env.num_starts[split]):
            raise ValueError(f"--{flag} must be <= {available}, the {split} configurations, got {count}.")
    if protocol.end_effector_reset:
        check_capability(env, "end_effector_reset", "--protocol.end_effector_reset=true")
    if protocol.heuristic_reset:
        check_capability(env, "put_back", "--protocol.heuristic_reset=true")
