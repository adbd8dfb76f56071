"""Turns experiments into pipelines: the base policy, the run, and the evaluations of its checkpoints."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cronos_lerobot.bases import official_bases
from cronos_lerobot.experiments.definitions import EXPERIMENTS, WIDE, Experiment, Row
from cronos_lerobot.experiments.pipeline import Command, Pipeline
from cronos_lerobot.experiments.scales import (
    BASE_FLAGS,
    DIVERSE_FLAGS,
    OBS_TYPES,
    PIXELS,
    UPDATE_INTERVAL,
    Scale,
    base_recipe,
)

POLICY = Path("checkpoints", "last", "pretrained_model")


@dataclass(frozen=True)
class Options:
    """What the command line decides about every run."""

    scale: Scale
    obs: str
    """state or pixels."""
    root: Path
    """Holds `base/` and `runs/`, which all experiments share."""
    threads: int = 1
    """Threads of each run. Sums in another order give other runs."""
    policy_path: str | None = None
    """The base policy; made first if None."""
    extra: tuple[str, ...] = ()
    """More flags of `cronos-train`, which win over a row's."""

    @property
    def thread_flags(self) -> tuple[str, ...]:
        """For `cronos-train` and `cronos-eval`."""
        return (f"--env.num_threads={self.threads}", f"--torch_threads={self.threads}")


@dataclass(frozen=True)
class Run:
    """One training run of an experiment."""

    experiment: Experiment
    row: Row
    seed: int
    options: Options

    @property
    def steps(self) -> int:
        """S [interaction steps, all streams together]."""
        return self.options.scale.steps[self.experiment.steps]

    @property
    def name(self) -> str:
        """Its folder below `runs/`, and its pipeline's name."""
        group = f"{self.experiment.scene}_{self.options.obs}_{self.base}_{self.options.scale.name}"
        return f"{group}/{self.row.name}_{self.steps // 1000}k/seed{self.seed}"

    @property
    def folder(self) -> Path:
        """Holds `train/` and `eval/`."""
        return self.options.root / "runs" / self.name

    @property
    def base(self) -> str:
        """Which base policy it begins with: from pixels `wide`, for an encoder knows only what it has seen."""
        return WIDE if self.options.obs == "pixels" else self.row.base

    @property
    def base_folder(self) -> Path:
        """Holds demonstrations and clone of that base policy."""
        options = self.options
        smoke = "_smoke" if options.scale.smoke else ""
        return options.root / "base" / f"{self.experiment.scene}_{options.obs}_{self.base}{smoke}"

    @property
    def base_policy(self) -> str:
        """`--policy.path` of the run."""
        return self.options.policy_path or self.official_base or str(self.base_folder / "clone" / POLICY)

    @property
    def official_base(self) -> str | None:
        """The official base policy that it begins with, if there is one."""
        name = f"{self.experiment.scene}_{self.options.obs}"
        is_official = self.base == WIDE and not self.options.scale.smoke and name in official_bases()
        return name if is_official else None


def make_runs(experiment: Experiment, rows: Iterable[Row], seeds: Iterable[int], options: Options) -> list[Run]:
    """The runs of an experiment: one seed of every row first, then the next seed."""
    rows = tuple(rows)
    return [Run(experiment, row, seed, options) for seed in seeds for row in rows]


def official_run(options: Options) -> Run:
    """A run that begins with the base policy that is, or would be, the official one."""
    experiment = EXPERIMENTS["baselines"]
    return Run(experiment, experiment.rows[0], 1, options)


def make_pipelines(runs: Iterable[Run]) -> list[Pipeline]:
    """The pipelines of some runs. Runs of one name are one run, with the evaluations of all."""
    commands: dict[str, dict[Path, Command]] = {}
    for run in runs:
        base = [] if run.options.policy_path or run.official_base else base_commands(run)
        made = [*base, train_command(run), *evaluation_commands(run)]
        commands.setdefault(run.name, {}).update({command.output: command for command in made})
    return [Pipeline(name, tuple(made.values())) for name, made in commands.items()]


def base_commands(run: Run) -> list[Command]:
    """Demonstrations of the expert, and their cloning."""
    folder, options, scene = run.base_folder, run.options, run.experiment.scene
    obs_type = OBS_TYPES[options.obs]
    recipe = base_recipe(options.scale, scene, obs_type, run.base)
    demos, clone = folder / "demos", folder / "clone"
    dataset = (f"--dataset.repo_id=local/{folder.name}", f"--dataset.root={demos}")
    record = (
        "cronos-record-demos",
        "--env.type=cronos",
        f"--env.scene={scene}",
        f"--env.obs_type={obs_type}",
        *dataset,
        f"--dataset.num_episodes={recipe.demos}",
        "--seed=1",
        *BASE_FLAGS[run.base],
        *DIVERSE_FLAGS,
    )
    train = (
        "lerobot-train",
        "--policy.type=pocketvla",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        *dataset,
        f"--batch_size={recipe.batch}",
        f"--steps={recipe.clone_steps}",
        f"--save_freq={recipe.clone_steps}",
        "--log_freq=40",
        "--wandb.enable=false",
        "--seed=1",
        f"--output_dir={clone}",
    )
    if obs_type == PIXELS:
        # PNG images, and one worker that decodes them. The privileged state teaches the encoder.
        record += ("--env.privileged_state=true", "--dataset.video=false", "--num_envs=64")
        train += ("--policy.observation=image", "--num_workers=1", "--dataloader_multiprocessing_context=fork")
    else:
        train += ("--num_workers=0",)
    return [Command(record, demos), Command(train, clone)]


def train_command(run: Run) -> Command:
    """The training run."""
    options, scale, experiment = run.options, run.options.scale, run.experiment
    output = run.folder / "train"
    flags = [
        f"--policy.path={run.base_policy}",
        "--env.type=cronos",
        f"--env.scene={experiment.scene}",
        f"--env.obs_type={OBS_TYPES[options.obs]}",
        f"--seed={run.seed}",
        f"--steps={run.steps}",
        f"--num_envs={scale.num_envs}",
        f"--protocol.update_interval={UPDATE_INTERVAL}",
        f"--eval_freq={scale.eval_freq}",
        f"--save_freq={scale.eval_freq}",
        f"--eval.n_episodes={1 if scale.smoke else 64}",
        *options.thread_flags,
        "--tensorboard=false",
        "--resume=auto",
        f"--output_dir={output}",
    ]
    for more in (run.row.flags, options.extra):
        more = [
            re.sub(r"\{([\d.]+)\}", lambda share: str(int(float(share[1]) * run.steps)), flag) for flag in more
        ]
        given = {flag.split("=")[0] for flag in more}
        flags = [flag for flag in flags if flag.split("=")[0] not in given] + more
    return Command(("cronos-train", *flags), output, resumes=True)


def evaluation_commands(run: Run) -> list[Command]:
    """`cronos-eval` of the last checkpoint, and of all before it where the experiment has a held-out curve."""
    scale, experiment, train = run.options.scale, run.experiment, run.folder / "train"
    *before, last = scale.checkpoints(experiment.steps)
    commands = []
    if experiment.held_out_curve:
        commands.append(_evaluation(run, run.base_policy, 0, "independent", "held_out"))
        for step in before:
            policy = train / "checkpoints" / get_step_identifier(step, last) / "pretrained_model"
            commands.append(_evaluation(run, str(policy), step, "independent", "held_out"))
    # The run itself has the independent suite on the training configurations.
    splits = "held_out" if experiment.suites == ("independent",) else "train,held_out"
    return [*commands, _evaluation(run, str(train / POLICY), last, ",".join(experiment.suites), splits)]


def get_step_identifier(step: int, total_steps: int) -> str:
    """Name of a checkpoint's folder, as LeRobot's function of this name, whose import takes seconds."""
    return f"{step:0{max(6, len(str(total_steps)))}d}"


def _evaluation(run: Run, policy: str, step: int, suites: str, splits: str) -> Command:
    output = run.folder / "eval" / f"{step:07d}"
    words = (
        "cronos-eval",
        f"--policy.path={policy}",
        "--env.type=cronos",
        f"--env.scene={run.experiment.scene}",
        f"--env.obs_type={OBS_TYPES[run.options.obs]}",
        f"--eval.suites=[{suites}]",
        f"--eval.splits=[{splits}]",
        "--eval.videos=0",
        *run.options.thread_flags,
        *[flag for flag in (*run.row.flags, *run.options.extra) if flag.startswith("--env.")],
        f"--output_dir={output}",
    )
    if run.options.scale.smoke:
        words += ("--eval.n_episodes=1", *(("--eval.orderings=1",) if "sequential" in suites else ()))
    return Command(words, output, resumes=True)
