"""The configurations of `cronos-publish`, one for each thing that is published."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import ClassVar

from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils import validate_repo_id

from cronos_lerobot.hub.push import Target


def check_name(flag: str, name: str) -> None:
    """Check that a flag names a repository.

    Raises:
        ValueError: it does not.
    """
    try:
        validate_repo_id(name)
    except HFValidationError as error:
        raise ValueError(f"--{flag}={name} is no <owner>/<name>: {error}") from error
    if name.count("/") != 1:
        raise ValueError(f"--{flag}={name} is no <owner>/<name>: it lacks the owner")


@dataclass
class PublishConfig:
    """Where to, for all of them."""

    repo_id: str = ""
    """Repository on the Hub: <owner>/<name>. HF_ENDPOINT chooses the Hub, HF_TOKEN the account."""
    branch: str | None = None
    """Branch to push to, made if it is not there; null for main."""
    revision: str | None = None
    """Branch, tag or commit that a new branch starts from; null for main."""
    private: bool | None = None
    """Make a new repository private; null for the account's default."""
    dry_run: bool = False
    """Write what would be pushed to --output_dir, and push nothing."""
    output_dir: Path | None = None
    """Folder for the dry run; must be empty or not there."""
    discover_packages_path: str | None = None
    """Module to import first, one that registers a scene from outside the package."""

    repo_type: ClassVar[str] = "dataset"

    def validate(self) -> None:
        """Check what all of them need.

        Raises:
            ValueError: a flag is missing or in vain.
            FileExistsError: the dry run's folder is in use.
            ImportError: the module cannot be imported.
        """
        if not self.repo_id:
            raise ValueError("--repo_id=<owner>/<name> is required, also in a dry run: the card names it")
        check_name("repo_id", self.repo_id)
        if self.revision and not self.branch:
            raise ValueError("--revision is what a new --branch starts from; there is no --branch")
        if self.dry_run != (self.output_dir is not None):
            raise ValueError("--dry_run=true and --output_dir=<folder> go together")
        if self.output_dir is not None and self.output_dir.exists() and any(self.output_dir.iterdir()):
            raise FileExistsError(f"{self.output_dir} is not empty; choose another --output_dir")
        if self.discover_packages_path:
            import_module(self.discover_packages_path)

    @property
    def target(self) -> Target:
        """The place on the Hub."""
        return Target(self.repo_id, self.repo_type, self.branch, self.revision, self.private)

    @property
    def targets(self) -> list[Target]:
        """All places that are to hold the same files."""
        return [self.target]


@dataclass
class BenchmarkConfig(PublishConfig):
    """Publish a benchmark: configurations of a scene, episodes and chains.

    By default this package's; with --benchmark another one that is there; with --seed a new one.
    """

    scene: str = ""
    """Scene: kitchen_2x2 (default), kitchen_3x3, playroom_2x2, or a registered one."""
    benchmark: str | None = None
    """Publish this one: a folder, or <owner>/<repository>[@<revision>]; see docs/hub.md for the files."""
    seed: int | None = None
    """Draw new configurations and orderings from this seed."""
    num_configurations: int | None = None
    """With --seed: configurations of each split; null for 64."""
    num_orderings: int | None = None
    """With --seed: orderings, each from every configuration; null for 10."""
    chain_length: int | None = None
    """With --seed: tasks of a chain; null for all of the scene."""
    title: str = ""
    """Title of the card and the leaderboard; `CRONOS <scene>` by default."""
    env_hub: bool = True
    """Push the same files to the model repository of this name, too: there LeRobot's make_env looks for env.py."""
    pictures: bool = True
    """Pictures of the tasks and of every configuration; they need OpenGL."""

    @property
    def targets(self) -> list[Target]:
        """The dataset, and the model repository of LeRobot's EnvHub."""
        return [self.target, *([replace(self.target, repo_type="model")] if self.env_hub else [])]


@dataclass
class StreamConfig(PublishConfig):
    """Publish recorded streams or demonstrations, a LeRobotDataset."""

    root: Path | None = None
    """Folder of the dataset: that of cronos-record-demos, or of cronos-train --record.root, by default
    <run>/streams."""
    run: Path | None = None
    """Folder of the training run, for the card; by default the one that the dataset lies in, if it does."""


@dataclass
class PolicyConfig(PublishConfig):
    """Publish a policy that cronos-train or lerobot-train made, with what it was trained with."""

    path: Path | None = None
    """Its run folder (the last checkpoint), one of its checkpoints, or a pretrained_model folder."""
    dataset: str | None = None
    """Dataset repository of its recorded streams; by default the --record.repo_id of the run."""
    base_policy: str | None = None
    """Model repository of the policy that training began with; by default the run's --policy.path, if that is
    one. Adapters (PEFT) of a policy in a folder are published with this repository in its place."""
    results: Path | None = None
    """results.json of cronos-eval, or its folder, for the card."""
    scene: str | None = None
    """Scene of a policy that lerobot-train made, for the card; by default that of its dataset, if it is on this
    machine. cronos-train's checkpoints know theirs."""
    license: str | None = None
    """License of the policy, as the Hub calls it; by default that of its config (--policy.license of the
    training), or apache-2.0, or none where it was trained from another repository, whose license holds."""

    repo_type: ClassVar[str] = "model"

    def validate(self) -> None:
        """Check the base's name as well."""
        super().validate()
        if self.base_policy is not None:
            check_name("base_policy", self.base_policy)


@dataclass
class ResultsConfig(PublishConfig):
    """Publish results of cronos-eval to a policy's repository, for the benchmark's leaderboard."""

    results: Path | None = None
    """results.json of cronos-eval, or its folder."""
    benchmark: str = ""
    """Benchmark that was evaluated: dataset repository, <owner>/<repository>[@<revision>]."""
    suites: str = "independent,sequential"
    """Suites to publish, comma-separated."""
    partial: bool = False
    """Publish an evaluation of fewer episodes than the benchmark has, with other options than its own, or of a
    policy that flags changed; the entry says so."""
    source_url: str | None = None
    """Page with the details of the evaluation, such as its log."""

    repo_type: ClassVar[str] = "model"
