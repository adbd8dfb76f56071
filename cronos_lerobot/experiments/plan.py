"""Turns experiments into jobs: the base policy, the runs, and the evaluations of their checkpoints."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.common.train_utils import get_step_identifier
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from cronos_lerobot.experiments.definitions import (
    CURRICULUM_INTERVAL,
    CURRICULUM_UNTIL,
    CheckpointEvaluation,
    Experiment,
    Row,
)
from cronos_lerobot.experiments.jobs import Job, Progress
from cronos_lerobot.experiments.scales import ALGORITHM_FLAGS, OBS_NAMES, BaseRecipe, Scale
from cronos_lerobot.training.logging import METRICS

UPDATE_INTERVAL = 160
"""U, control steps of each stream between two policy updates (Table 2)."""
DEMO_FLAGS = ("--seed=1", "--noise.share=0.75", "--misses.share=0.25", "--steps_after_release=8")
"""Noise and misses show how to recover, the frames after the release that a finished task is left alone."""
LAST_POLICY = Path(CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR)


@dataclass(frozen=True)
class Options:
    """What the command line decides about every run."""

    scale: Scale
    obs_type: str
    seeds: tuple[int, ...]
    root: Path
    """Holds base/ and runs/, which all experiments share."""
    threads: int = 1
    """Threads of each run, for PyTorch and for the physics; sums in another order give other runs."""
    temperature: float = 0.6
    """Sampling temperature of every evaluation."""
    policy_path: str | None = None
    """The base policy; made first if None."""
    extra: tuple[str, ...] = ()
    """More flags of `cronos-train`."""
    recipes: dict[str, BaseRecipe] = field(default_factory=dict)
    """How to make the base policy of each scene."""


@dataclass(frozen=True)
class RunSpec:
    """One training run of an experiment."""

    row: Row
    seed: int
    scene: str
    paper_steps: int
    options: Options

    @property
    def steps(self) -> int:
        """S of this run, rounded up to whole policy updates as `cronos-train` does."""
        per_update = self.options.scale.num_envs * UPDATE_INTERVAL
        return -(-self.options.scale.steps[self.paper_steps] // per_update) * per_update

    @property
    def group(self) -> str:
        """Scene, observation and scale, row and steps: what the seeds of a row have in common."""
        scale = self.options.scale
        wanted = f"{round(scale.steps[self.paper_steps] / 1000)}k"
        return f"{self.scene}_{OBS_NAMES[self.options.obs_type]}_{scale.name}/{self.row.name}_{wanted}"

    @property
    def name(self) -> str:
        """Name of its job."""
        return f"{self.group}/seed{self.seed}"

    @property
    def folder(self) -> Path:
        """Holds the run's folder, `train`, and those of its evaluations."""
        return self.options.root / "runs" / self.name

    @property
    def train_folder(self) -> Path:
        """`--output_dir` of the run."""
        return self.folder / "train"

    @property
    def checkpoints(self) -> list[int]:
        """Interaction steps of the checkpoints that a finished run has."""
        per_update = self.options.scale.num_envs * UPDATE_INTERVAL
        frequency = self.options.scale.eval_freq
        saved = [
            n
            for n in range(per_update, self.steps + 1, per_update)
            if n // frequency > (n - per_update) // frequency
        ]
        return sorted({*saved, self.steps})

    def policy(self, checkpoint: int) -> Path:
        """The policy of a checkpoint."""
        folder = get_step_identifier(checkpoint, self.steps)
        return self.train_folder / CHECKPOINTS_DIR / folder / PRETRAINED_MODEL_DIR

    def evaluation_folder(self, suite: str, split: str, checkpoint: int) -> Path:
        """`--output_dir` of an evaluation."""
        return self.folder / "eval" / f"{suite}_{split}_{checkpoint:07d}"


def run_specs(experiment: Experiment, options: Options, rows: Iterable[Row] | None = None) -> list[RunSpec]:
    """The runs of an experiment: first one seed of every row, then the next."""
    chosen = tuple(rows or experiment.rows)
    return [
        RunSpec(row, seed, experiment.scene, experiment.steps, options) for seed in options.seeds for row in chosen
    ]


def make_jobs(
    experiments: Iterable[tuple[Experiment, tuple[Row, ...]]], options: Options, *, evaluate: bool = True
) -> list[Job]:
    """All jobs of some experiments with their chosen rows, each once, in an order that runs."""
    jobs: dict[str, Job] = {}
    for experiment, rows in experiments:
        base = [] if options.policy_path else base_jobs(experiment.scene, options)
        jobs |= {job.name: job for job in base}
        for spec in run_specs(experiment, options, rows):
            train = train_job(spec, base[-1].name if base else None)
            jobs |= {train.name: train}
            for evaluation in experiment.evaluations if evaluate else ():
                jobs |= {job.name: job for job in evaluation_jobs(spec, evaluation)}
    return list(jobs.values())


def base_folder(scene: str, options: Options) -> Path:
    """Folder of the demonstrations and the clone that all experiments of a scene share.

    The recipe is part of its name, and so of the runs' commands: another recipe makes other runs.
    """
    recipe = options.recipes[scene]
    made = f"{recipe.demos}demos_{recipe.clone_steps}steps"
    return options.root / "base" / f"{scene}_{OBS_NAMES[options.obs_type]}_{made}"


def base_policy(scene: str, options: Options) -> str:
    """Path of the policy that the runs of a scene begin with."""
    if options.policy_path:
        return options.policy_path
    recipe = options.recipes[scene]
    checkpoint = get_step_identifier(recipe.checkpoint, recipe.clone_steps)
    return str(base_folder(scene, options) / "clone" / CHECKPOINTS_DIR / checkpoint / PRETRAINED_MODEL_DIR)


def base_jobs(scene: str, options: Options) -> list[Job]:
    """Demonstrations of the expert, and their cloning: two jobs."""
    folder, recipe = base_folder(scene, options), options.recipes[scene]
    pixels = OBS_NAMES[options.obs_type] == "pixels"
    dataset = (f"--dataset.repo_id=local/{folder.name}", f"--dataset.root={folder / 'demos'}")
    record = ["cronos-record-demos", "--env.type=cronos", f"--env.scene={scene}", *dataset]
    record += [f"--env.obs_type={options.obs_type}", f"--dataset.num_episodes={recipe.demos}", *DEMO_FLAGS]
    clone = ["lerobot-train", "--policy.type=pocketvla", "--policy.device=cpu", "--policy.push_to_hub=false"]
    clone += [*dataset, f"--batch_size={recipe.clone_batch}", f"--steps={recipe.clone_steps}"]
    clone += [f"--save_freq={recipe.save_freq}", "--log_freq=40", "--wandb.enable=false", "--seed=1"]
    clone += [f"--output_dir={folder / 'clone'}"]
    if pixels:
        # PNG images and one worker that decodes them; the critic sees the privileged state.
        record += ["--env.privileged_state=true", "--dataset.video=false", "--num_envs=64"]
        clone += ["--policy.observation=image", "--policy.critic_observation=environment_state"]
        clone += ["--num_workers=1", "--dataloader_multiprocessing_context=fork"]
    else:
        clone += ["--num_workers=0"]
    name = f"base/{folder.name}"
    demos = Job(f"{name}/demos", tuple(record), folder / "demos")
    return [demos, Job(f"{name}/clone", tuple(clone), folder / "clone", needs=(demos.name,))]


def train_flags(spec: RunSpec) -> list[str]:
    """The flags of a run that are the experiment's: protocol, steps, seed."""
    row, scale = spec.row, spec.options.scale
    flags = [
        f"--seed={spec.seed}",
        f"--steps={scale.steps[spec.paper_steps]}",
        f"--num_envs={scale.num_envs}",
        f"--protocol.update_interval={UPDATE_INTERVAL}",
        f"--protocol.scene_reset_interval={row.interval}",
        f"--protocol.end_effector_reset={str(row.end_effector_reset).lower()}",
        f"--protocol.task_order={row.task_order}",
    ]
    if row.curriculum:
        until = CURRICULUM_UNTIL * scale.steps[spec.paper_steps] // spec.paper_steps
        flags.append(f"--protocol.curriculum={json.dumps([[until, CURRICULUM_INTERVAL]])}")
    for name in ("learned_reset", "heuristic_reset"):
        if getattr(row, name):
            flags.append(f"--protocol.{name}=true")
    if row.num_configurations != 64:
        flags.append(f"--protocol.num_configurations={row.num_configurations}")
    return flags


def train_job(spec: RunSpec, base: str | None) -> Job:
    """One run of `cronos-train`."""
    options = spec.options
    episodes = min(options.scale.eval_episodes, spec.row.num_configurations)
    command = [
        "cronos-train",
        f"--policy.path={base_policy(spec.scene, options)}",
        *ALGORITHM_FLAGS[options.obs_type],
        "--env.type=cronos",
        f"--env.scene={spec.scene}",
        f"--env.obs_type={options.obs_type}",
        *train_flags(spec),
        f"--eval_freq={options.scale.eval_freq}",
        f"--eval.n_episodes={episodes}",
        f"--eval.temperature={options.temperature}",
        f"--save_freq={options.scale.eval_freq}",
        f"--env.num_threads={options.threads}",
        f"--torch_threads={options.threads}",
        "--tensorboard=false",
        f"--output_dir={spec.train_folder}",
    ]
    given = {flag.split("=")[0] for flag in options.extra}
    command = [flag for flag in command if flag.split("=")[0] not in given] + list(options.extra)

    def resume() -> list[str] | None:
        config = spec.train_folder / LAST_POLICY / TRAIN_CONFIG_NAME
        return ["cronos-train", "--resume=true", f"--config_path={config}"] if config.is_file() else None

    return Job(
        spec.name,
        tuple(command),
        spec.train_folder,
        needs=(base,) if base else (),
        resume=resume,
        progress=lambda: train_progress(spec.train_folder, spec.steps),
    )


def evaluation_jobs(spec: RunSpec, evaluation: CheckpointEvaluation) -> list[Job]:
    """`cronos-eval` of a run's last checkpoint or of all, one job for each checkpoint and split."""
    jobs = []
    for checkpoint in spec.checkpoints if evaluation.every_checkpoint else [spec.steps]:
        for split in evaluation.splits:
            folder = spec.evaluation_folder(evaluation.suite, split, checkpoint)
            command = [
                "cronos-eval",
                f"--policy.path={spec.policy(checkpoint)}",
                f"--eval.suites={evaluation.suite}",
            ]
            command += [f"--eval.splits={split}", f"--output_dir={folder}"]
            jobs.append(Job(f"{spec.name}/{folder.name}", tuple(command), folder, needs=(spec.name,)))
    return jobs


def train_progress(folder: Path, total: int) -> Progress | None:
    """Read from metrics.jsonl how far a run is; None before its first record."""
    records = _last_records(folder / METRICS)
    if not records:
        return None
    updates = [record for record in records if record["kind"] == "update"]
    done = records[-1]["interaction_steps"]
    left = None
    if len(updates) > 1:
        steps = updates[-1]["interaction_steps"] - updates[0]["interaction_steps"]
        left = (total - done) * (updates[-1]["time"] - updates[0]["time"]) / max(steps, 1)
    texts = [f"evaluation {r['success']:.2f}" for r in records if r["kind"] == "evaluation"][-1:]
    if updates and updates[-1]["rollout"]["success"] is not None:
        texts.append(f"streams {updates[-1]['rollout']['success']:.2f}")
    return Progress(done, total, left, ", ".join(texts))


def _last_records(path: Path, num_bytes: int = 100_000) -> list[dict[str, Any]]:
    """The last records of a JSON-lines file; one that is being written is left out."""
    if not path.is_file():
        return []
    with path.open("rb") as file:
        start = max(0, path.stat().st_size - num_bytes)
        file.seek(start)
        lines = file.read().split(b"\n")
    # What follows the last newline is unfinished, what precedes the first one may be cut.
    return [json.loads(line) for line in lines[1 if start else 0 : -1]]
