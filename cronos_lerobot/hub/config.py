"""The flags of `cronos-publish`, one class for each thing that is published."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path


def check_name(flag: str, name: str) -> None:
    """Check that a flag names a repository."""
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise ValueError(f"--{flag}={name}: give a repository, <owner>/<name>")


@dataclass
class PublishConfig:
    """The flags of all commands."""

    repo_id: str = ""
    """Repository on the Hub, <owner>/<name>. HF_ENDPOINT chooses the Hub, HF_TOKEN the account."""
    branch: str | None = None
    """Branch to push to, made if it is not there; null for main."""
    revision: str | None = None
    """Branch, tag or commit that a new --branch starts from; null for main."""
    private: bool | None = None
    """Make a new repository private; null for the account's default."""
    dry_run: bool = False
    """Write what would be pushed to --output_dir, and push nothing."""
    output_dir: Path | None = None
    """Folder for --dry_run; must be empty or not there."""
    discover_packages_path: str | None = None
    """Module to import first, one that registers your scene."""

    def validate(self) -> None:
        """Check the flags."""
        check_name("repo_id", self.repo_id)
        if self.dry_run != (self.output_dir is not None):
            raise ValueError("give --dry_run=true and --output_dir=<folder> together")
        if self.output_dir is not None and self.output_dir.exists() and any(self.output_dir.iterdir()):
            raise FileExistsError(f"{self.output_dir} is not empty: choose another --output_dir")


@dataclass
class BenchmarkConfig(PublishConfig):
    """Publish a benchmark: the package's, another one with --benchmark, or a new one with --seed."""

    scene: str = ""
    """Scene: kitchen_2x2 (default), kitchen_3x3, playroom_2x2, or a registered one."""
    benchmark: str | None = None
    """Publish this benchmark: a folder, or <owner>/<repository>[@<revision>]."""
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
    """Push the same files to the model repository of this name: LeRobot's make_env looks for env.py there."""
    pictures: bool = True
    """Add pictures of the tasks and of every configuration; needs OpenGL."""


@dataclass
class StreamConfig(PublishConfig):
    """Publish recorded streams or demonstrations, a LeRobotDataset."""

    root: Path | None = None
    """Folder of the dataset, such as outputs/train/eer/streams."""


@dataclass
class PolicyConfig(PublishConfig):
    """Publish a policy of cronos-train or lerobot-train."""

    path: Path | None = None
    """Run folder (its last checkpoint), a checkpoint, or a pretrained_model folder."""
    dataset: str | None = None
    """Dataset repository for the card; by default the one that the training recorded or learned from."""
    base_policy: str | None = None
    """Model repository of the policy that training began with; by default the one that its config names. PEFT
    adapters of a policy in a folder are published with this repository as their base."""
    results: Path | None = None
    """Output folder of cronos-eval, or a results.json, for the card."""
    scene: str | None = None
    """Scene for the card; by default that of the training."""
    license: str | None = None
    """License, as the Hub calls it; by default --policy.license of the training, or apache-2.0 for a policy that
    began from scratch."""


@dataclass
class ResultsConfig(PublishConfig):
    """Publish results of cronos-eval to a policy's repository, for the benchmark's leaderboard."""

    results: Path | None = None
    """Output folder of cronos-eval, or a results.json."""
    benchmark: str = ""
    """Benchmark that was evaluated, <owner>/<repository>[@<revision>]; by default the one in the results."""
    suites: str = "independent,sequential"
    """Suites to publish, comma-separated."""
    partial: bool = False
    """Publish also what is not the benchmark's own evaluation, such as fewer episodes; the entry says so."""
    source_url: str | None = None
    """Page with the details of the evaluation, such as its log."""
