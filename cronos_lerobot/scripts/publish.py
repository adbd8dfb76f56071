"""`cronos-publish`: push benchmarks, streams, policies and results to the Hugging Face Hub.

cronos-publish benchmark   configurations and chains of a scene, for `--env.benchmark`, `datasets.load_dataset` and
                           LeRobot's `make_env`
cronos-publish stream      recorded training streams or demonstrations, a LeRobotDataset
cronos-publish policy      a policy, with a card that says how it was trained and how to evaluate it
cronos-publish results     results of cronos-eval to a policy's repository, for the benchmark's leaderboard

examples:
  the benchmark of a scene; and your own, drawn from a seed
      cronos-publish benchmark --repo_id=me/cronos_kitchen
      cronos-publish benchmark --repo_id=me/my_kitchen --seed=7 --num_configurations=32 --num_orderings=4
  show what would be pushed, as a folder
      cronos-publish benchmark --repo_id=me/cronos_kitchen --dry_run=true --output_dir=outputs/publish
  a training run: its streams, its policy
      cronos-publish stream --root=outputs/train/eer/streams --repo_id=me/eer_stream
      cronos-publish policy --path=outputs/train/eer --repo_id=me/eer
  what the policy achieves
      cronos-eval --policy.path=me/eer --env.benchmark=me/cronos_kitchen --output_dir=outputs/eval/eer
      cronos-publish results --results=outputs/eval/eer --benchmark=me/cronos_kitchen --repo_id=me/eer

HF_ENDPOINT chooses the Hub and HF_TOKEN the account (or `hf auth login`). After a lost connection the same command
resumes with what is missing. Only files of a policy or a dataset are pushed, without access tokens and folders.
`cronos-publish policy --help` lists the flags of a command.
"""

import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from lerobot.utils.import_utils import register_third_party_plugins

from cronos_lerobot.hub.config import BenchmarkConfig, PolicyConfig, PublishConfig, ResultsConfig, StreamConfig
from cronos_lerobot.hub.push import PublishError, check_holds, push_folder
from cronos_lerobot.scripts.subcommands import run_subcommand


def publish_benchmark(config: BenchmarkConfig) -> None:
    """`cronos-publish benchmark`."""
    config.validate()
    from cronos_lerobot.hub.benchmark import DATA, ENV_FILE, REPLACES, choose_benchmark, write_benchmark_repository

    if not config.dry_run:
        # Benchmarks that were made in another way have only the data.
        check_holds(config.repo_id, "dataset", (ENV_FILE, DATA), "choose another --repo_id")
        if config.env_hub:
            check_holds(config.repo_id, "model", (ENV_FILE,), "choose another --repo_id, or --env_hub=false")
    # Data and code are two repositories with commits of their own. The tag is one name for both.
    benchmark = choose_benchmark(config)
    tag = f"benchmark-{benchmark.fingerprint}"
    types = ("dataset", "model") if config.env_hub else ("dataset",)
    write = partial(write_benchmark_repository, benchmark=benchmark)
    _publish(config, write, *types, replaces=REPLACES, tag=tag)
    if not config.dry_run:
        where = "--env.benchmark" + " and in LeRobot's make_env" * config.env_hub
        print(f"{config.repo_id}@{tag} is this benchmark, in {where}")


def publish_stream(config: StreamConfig) -> None:
    """`cronos-publish stream`."""
    config.validate()
    from cronos_lerobot.hub.streams import REPLACES, not_being_recorded, read_version, write_stream_repository

    # LeRobot reads a dataset at its version's tag unless it is told a revision; a branch does not move it.
    version = read_version(config)
    assert config.root is not None
    with not_being_recorded(config.root):
        tag = version if config.branch is None else None
        _publish(config, write_stream_repository, "dataset", replaces=REPLACES, tag=tag)


def publish_policy(config: PolicyConfig) -> None:
    """`cronos-publish policy`."""
    config.validate()
    from cronos_lerobot.hub.policy import FILES, write_policy_repository

    _publish(config, write_policy_repository, "model", replaces=FILES)


def publish_results(config: ResultsConfig) -> None:
    """`cronos-publish results`."""
    config.validate()
    from cronos_lerobot.hub.results import find_commit, read_own_results, write_results

    results = read_own_results(config)
    commit = find_commit(config)
    _publish(config, partial(write_results, results=results, commit=commit), "model", parent_commit=commit)


def _publish(config: Any, write: Callable[[Any, Path], str], *repo_types: str, **push: Any) -> None:
    """Write the tree, then push it to repositories of these types, or copy it to the dry run's folder."""
    with tempfile.TemporaryDirectory(prefix="cronos_publish_") as name:
        folder = Path(name)
        what = write(config, folder)
        if config.dry_run:
            shutil.copytree(folder, config.output_dir, dirs_exist_ok=True)
            sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
            size = f"{len(sizes)} files, {sum(sizes) / 1e6:.2f} MB"
            print(f"dry run: {what}\n{size} in {config.output_dir}; nothing was pushed")
            return
        urls = [push_folder(folder, config, kind, f"Publish {what}", **push) for kind in repo_types]
    print("\n".join([f"published {what}", *urls]))


COMMANDS: dict[str, tuple[type[PublishConfig], Callable[[Any], None]]] = {
    "benchmark": (BenchmarkConfig, publish_benchmark),
    "stream": (StreamConfig, publish_stream),
    "policy": (PolicyConfig, publish_policy),
    "results": (ResultsConfig, publish_results),
}


def main() -> None:
    """Entry point of `cronos-publish`."""
    # They may bring scenes with them.
    register_third_party_plugins()
    run_subcommand(COMMANDS, PublishError)
