"""Turns experiments into jobs: the base policy, the runs, and the evaluations of their checkpoints."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot_env_cronos import gymnasium_id
from lerobot_env_cronos.benchmark.benchmark import SUITES
from lerobot_env_cronos.benchmark.configurations import SPLITS

from cronos_lerobot.experiments.definitions import (
    CURRICULUM_INTERVAL,
    Base,
    CheckpointEvaluation,
    Experiment,
    Row,
)
from cronos_lerobot.experiments.flags import read_flags
from cronos_lerobot.experiments.jobs import BASE, EVALUATION, PLUGIN_FLAG, Job
from cronos_lerobot.experiments.progress import train_progress
from cronos_lerobot.experiments.scales import ALGORITHM_FLAGS, OBS_NAMES
from cronos_lerobot.experiments.specs import (
    UPDATE_INTERVAL,
    Options,
    RunSpec,
    base_evaluation_folder,
    base_folder,
    base_policy,
    run_specs,
)

LAST_POLICY = Path(CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR)


def make_jobs(experiments: Iterable[tuple[Experiment, tuple[Row, ...]]], options: Options) -> list[Job]:
    """All jobs of some experiments with their chosen rows, each once, in an order that runs.

    Raises:
        ValueError: two of them are other commands with one name, and so with one folder.
    """
    jobs: dict[str, Job] = {}

    def add(job: Job) -> None:
        there = jobs.setdefault(job.name, job)
        if there.command != job.command:
            one, other = (" ".join(each.command) for each in (there, job))
            raise ValueError(f"two commands would share the folder of {job.name}: {one}; and {other}")

    for experiment, rows in experiments:
        for spec in run_specs(experiment, options, rows):
            base = [] if options.policy_path else base_jobs(spec.base, options)
            made = [*base, train_job(spec, base[-1].name if base else None)]
            for evaluation in experiment.evaluations:
                made += [*base_evaluation_jobs(spec, evaluation), *evaluation_jobs(spec, evaluation)]
            for job in made:
                add(job)
    return list(jobs.values())


def base_jobs(base: Base, options: Options) -> list[Job]:
    """Demonstrations of the expert, and their cloning: two jobs."""
    folder, recipe, scene = base_folder(base, options), options.recipes[base.recipe], base.scene
    pixels = OBS_NAMES[options.obs_type] == "pixels"
    dataset = (f"--dataset.repo_id=local/{folder.name}", f"--dataset.root={folder / 'demos'}")
    record = ["cronos-record-demos", "--env.type=cronos", f"--env.scene={scene}", *dataset]
    record += [f"--env.obs_type={options.obs_type}", f"--dataset.num_episodes={recipe.demos}", "--seed=1"]
    record += recipe.demo_flags
    record += [] if base.configurations == 64 else [f"--start.num_configurations={base.configurations}"]
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
    demos = Job(f"{name}/demos", tuple(record), folder / "demos", stage=BASE)
    # Evaluations may have come from another machine, without the clone that they are of.
    pairs = [(suite, split) for suite in SUITES for split in SPLITS]
    evaluations = {base_evaluation_folder(base, suite, split, options) for suite, split in pairs}
    # Rows with an environment of their own have theirs beside them.
    evaluations |= {there for suite in SUITES for there in folder.glob(f"{suite}_*") if there.is_dir()}
    from_it = tuple(sorted(evaluations))
    clone_job = Job(f"{name}/clone", tuple(clone), folder / "clone", from_it, needs=(demos.name,), stage=BASE)
    return [replace(job, environment=gymnasium_id(scene), root=options.root) for job in (demos, clone_job)]


def train_flags(spec: RunSpec) -> list[str]:
    """The flags of a run that are the experiment's: protocol, steps, seed."""
    row, scale = spec.row, spec.options.scale
    flags = [
        f"--seed={spec.seed}",
        f"--steps={scale.steps[spec.paper_steps]}",
        f"--num_envs={scale.num_envs}",
        f"--protocol.update_interval={UPDATE_INTERVAL}",
        f"--protocol.scene_reset_interval={row.interval or 'null'}",
        f"--protocol.end_effector_reset={str(row.end_effector_reset).lower()}",
        f"--protocol.task_order={row.task_order}",
    ]
    stages = [(spec.paper_steps // 2, CURRICULUM_INTERVAL)] if row.curriculum else row.stages
    if stages:
        curriculum = [[spec.scaled(until), interval] for until, interval in stages]
        flags.append(f"--protocol.curriculum={json.dumps(curriculum)}")
    for name in ("learned_reset", "heuristic_reset"):
        if getattr(row, name):
            flags.append(f"--protocol.{name}=true")
    if row.num_configurations != 64:
        flags.append(f"--protocol.num_configurations={row.num_configurations}")
    return flags


def train_job(spec: RunSpec, base: str | None) -> Job:
    """One run of `cronos-train`."""
    options = spec.options
    extra, wanted, times = _eval_episodes(options)
    episodes = wanted if _may_have_more(spec) else min(wanted, spec.row.num_configurations)
    # From few configurations as many episodes as from all.
    repetitions = times * (wanted // episodes if options.temperature else 1)
    command = [
        "cronos-train",
        f"--policy.path={base_policy(spec.base, options)}",
        *_recipe_flags(spec),
        "--env.type=cronos",
        f"--env.scene={spec.scene}",
        f"--env.obs_type={options.obs_type}",
        *train_flags(spec),
        f"--eval_freq={options.scale.eval_freq}",
        f"--eval_at_interventions={json.dumps(spec.budgets)}",
        f"--eval.n_episodes={episodes}",
        f"--eval.repetitions={repetitions}",
        f"--eval.temperature={options.temperature}",
        f"--save_freq={options.scale.eval_freq}",
        f"--env.num_threads={options.threads}",
        f"--torch_threads={options.threads}",
        "--tensorboard=false",
        f"--output_dir={spec.train_folder}",
    ]
    # A smoke run's share of a budget may be none, which is no budget.
    budgets = [f"{flag}={max(1, spec.scaled(number))}" for flag, number in spec.row.budgets]
    command = _with_flags(command, spec.row.flags, budgets, extra)

    return Job(
        spec.name,
        tuple(command),
        spec.train_folder,
        made_from_it=(spec.evaluations_folder,),
        needs=(base,) if base else (),
        reads=(Path(base_policy(spec.base, options)),) if base else (),
        resume=lambda: resume_command(spec.train_folder, command),
        progress=lambda: train_progress(spec.train_folder, spec.steps),
        environment=gymnasium_id(spec.scene),
        work=spec.steps,
        root=options.root,
    )


def _may_have_more(spec: RunSpec) -> bool:
    """Whether there may be more configurations than 64: of a benchmark of one's own it is seen by the run."""
    given = dict(read_flags((*spec.row.flags, *spec.options.extra)))
    return "env.benchmark" in given and spec.row.num_configurations == 64


def _recipe_flags(spec: RunSpec) -> list[str]:
    """Those of `ALGORITHM_FLAGS` that a run follows: its agent may be another than PPO, its policy any."""
    given = dict(read_flags((*spec.row.flags, *spec.options.extra)))
    others = [] if given.get("algorithm.type", "ppo") == "ppo" else ["--algorithm."]
    others += ["--policy."] if spec.options.policy_path else []
    return [flag for flag in ALGORITHM_FLAGS[spec.options.obs_type] if not flag.startswith(tuple(others))]


def _eval_episodes(options: Options) -> tuple[list[str], int, int]:
    """The other flags that were given for every run; episodes of each task in its evaluations, and how often."""
    numbers = {"--eval.n_episodes": options.scale.eval_episodes, "--eval.repetitions": 1}
    others = []
    for flag in options.extra:
        name, _, value = flag.partition("=")
        # What is no number is told when the command is checked.
        if name in numbers and value.isdigit() and int(value):
            numbers[name] = int(value)
        else:
            others.append(flag)
    return others, numbers["--eval.n_episodes"], numbers["--eval.repetitions"]


def resume_command(folder: Path, command: Iterable[str]) -> list[str] | None:
    """`cronos-train` from the last checkpoint in `folder` of a run begun by `command`, with its plugins.

    None before the first checkpoint.
    """
    config = folder / LAST_POLICY / TRAIN_CONFIG_NAME
    plugins = [flag for flag in command if PLUGIN_FLAG in flag]
    return ["cronos-train", "--resume=true", f"--config_path={config}", *plugins] if config.is_file() else None


def _with_flags(command: list[str], *more: Iterable[str]) -> list[str]:
    """What is given last wins: the row's own flags, then those of the command line."""
    for flags in map(list, more):
        given = {flag.split("=")[0] for flag in flags}
        command = [flag for flag in command if flag.split("=")[0] not in given] + flags
    return command


def _env_flags(flags: Iterable[str]) -> list[str]:
    """The flags of a training that its evaluation must have too: the scene's, and what registers it."""
    return [flag for flag in flags if flag.startswith("--env.") or PLUGIN_FLAG in flag]


def evaluation_jobs(spec: RunSpec, evaluation: CheckpointEvaluation) -> list[Job]:
    """`cronos-eval` of a run's last checkpoint or of all, one job for each checkpoint and split."""
    return [job for job, _ in checkpoint_evaluations(spec, evaluation)]


def checkpoint_evaluations(spec: RunSpec, evaluation: CheckpointEvaluation) -> list[tuple[Job, int]]:
    """`evaluation_jobs`, each with its checkpoint [interaction steps]."""
    jobs = []
    for checkpoint in spec.checkpoints if evaluation.every_checkpoint else [spec.steps]:
        for split in evaluation.splits:
            folder = spec.evaluation_folder(evaluation.suite, split, checkpoint)
            videos = int(evaluation.suite == "sequential" and not spec.options.scale.smoke)
            # A budget may end the run before its last step: only the link says where.
            policy = str(spec.train_folder / LAST_POLICY if spec.row.has_budget else spec.policy(checkpoint))
            command = eval_command(policy, spec.scene, evaluation.suite, split, folder, spec.options, videos)
            command = _with_flags(command, _env_flags(spec.row.flags), _env_flags(spec.options.extra))
            name, root = f"{spec.name}/{folder.name}", spec.options.root
            jobs.append((_eval_job(name, command, folder, (spec.name, policy), spec.scene, root), checkpoint))
    return jobs


def base_evaluation_jobs(spec: RunSpec, evaluation: CheckpointEvaluation) -> list[Job]:
    """`cronos-eval` of the base policy, where a run's curves begin, in the run's environment."""
    if not evaluation.every_checkpoint:
        return []
    base, options = spec.base, spec.options

    def needed_flags(flags: Iterable[str]) -> list[str]:
        # Checkpoints of the runs have those of the policy in their config.
        of_policy = [flag for flag in flags if options.policy_path and flag.startswith("--policy.")]
        return [*_env_flags(flags), *of_policy]

    # Rows that say the same in another order share it.
    own = sorted(needed_flags(spec.row.flags))
    jobs, policy = [], base_policy(base, options)
    needed = None if options.policy_path else (base_jobs(base, options)[-1].name, policy)
    for split in evaluation.splits:
        folder = base_evaluation_folder(base, evaluation.suite, split, options, own)
        command = eval_command(policy, base.scene, evaluation.suite, split, folder, options)
        command = _with_flags(command, own, needed_flags(options.extra))
        name = f"base/{folder.parent.name}/{folder.name}"
        jobs.append(_eval_job(name, command, folder, needed, base.scene, options.root))
    return jobs


def eval_command(
    policy: str, scene: str, suite: str, split: str, folder: Path, options: Options, videos: int = 0
) -> list[str]:
    """`cronos-eval` of one suite on one split."""
    command = [
        "cronos-eval",
        f"--policy.path={policy}",
        "--env.type=cronos",
        f"--env.scene={scene}",
        f"--eval.suites={suite}",
        f"--eval.splits={split}",
        f"--eval.temperature={options.temperature}",
        f"--eval.videos={videos}",
        f"--env.num_threads={options.threads}",
        f"--torch_threads={options.threads}",
        f"--output_dir={folder}",
    ]
    if not options.scale.smoke:
        return command
    return [*command, "--eval.n_episodes=1", *(["--eval.orderings=1"] if suite == "sequential" else [])]


def _eval_job(
    name: str, command: list[str], folder: Path, needed: tuple[str, str] | None, scene: str, root: Path
) -> Job:
    """`needed`: the job that makes the policy, and the policy's folder."""
    # cronos-eval goes on with what it finds in its folder.
    return Job(
        name,
        tuple(command),
        folder,
        needs=needed[:1] if needed else (),
        reads=(Path(needed[1]),) if needed else (),
        resume=lambda: command,
        environment=gymnasium_id(scene),
        stage=EVALUATION,
        root=root,
    )
