"""Which runs an experiment has, and where their files are."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.common.train_utils import get_step_identifier
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR

from cronos_lerobot.experiments.definitions import PAPER_BUDGETS, Base, Experiment, Row
from cronos_lerobot.experiments.scales import OBS_NAMES, BaseRecipe, Scale

UPDATE_INTERVAL = 160
"""U, control steps of each stream between two policy updates (Table 2)."""


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
    """How to make the base policies, by `Base.recipe`."""


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
    def budgets(self) -> list[int]:
        """Numbers of interventions at which the run is evaluated: those of the tables, scaled as the steps."""
        wanted = map(self.scaled, PAPER_BUDGETS.get(self.paper_steps, ()))
        return sorted({budget for budget in wanted if budget})

    def scaled(self, number: int) -> int:
        """A number of steps or interventions in a run of the paper's steps, in this one."""
        return number * self.options.scale.steps[self.paper_steps] // self.paper_steps

    @property
    def base(self) -> Base:
        """What it begins with."""
        return self.row.begins_with(self.scene)

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
    def evaluations_folder(self) -> Path:
        """Holds the evaluations of its checkpoints."""
        return self.folder / "eval"

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
        return self.evaluations_folder / f"{suite}_{split}_{checkpoint:07d}"


def run_specs(experiment: Experiment, options: Options, rows: Iterable[Row] | None = None) -> list[RunSpec]:
    """The runs of an experiment: first one seed of every row, then the next."""
    chosen = tuple(rows or experiment.rows)
    return [
        RunSpec(row, seed, experiment.scene, experiment.steps, options) for seed in options.seeds for row in chosen
    ]


def base_folder(base: Base, options: Options) -> Path:
    """Folder of the demonstrations and the clone that all experiments share.

    The recipe is part of its name, and so of the runs' commands: another recipe makes other runs.
    """
    own = "" if base.configurations == 64 else f"_{base.configurations}config"
    made = options.recipes[base.recipe].made
    return options.root / "base" / f"{base.scene}_{OBS_NAMES[options.obs_type]}_{made}{own}"


def base_policy(base: Base, options: Options) -> str:
    """Path of the policy that runs begin with."""
    if options.policy_path:
        return options.policy_path
    recipe = options.recipes[base.recipe]
    checkpoint = get_step_identifier(recipe.checkpoint, recipe.clone_steps)
    return str(base_folder(base, options) / "clone" / CHECKPOINTS_DIR / checkpoint / PRETRAINED_MODEL_DIR)


def base_evaluation_folder(base: Base, suite: str, split: str, options: Options, own: Iterable[str] = ()) -> Path:
    """`--output_dir` of an evaluation of the base policy; `own` are a row's flags that it needs."""
    if options.policy_path:
        given = hashlib.sha256(options.policy_path.encode()).hexdigest()[:8]
        folder = options.root / "base" / f"{base.scene}_{OBS_NAMES[options.obs_type]}_{given}"
    else:
        folder = base_folder(base, options)
    there = hashlib.sha256(" ".join(own).encode()).hexdigest()[:8] if (own := sorted(own)) else ""
    return folder / "_".join(filter(None, (suite, split, there, "smoke" if options.scale.smoke else "")))
