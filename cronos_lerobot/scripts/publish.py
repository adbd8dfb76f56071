"""`cronos-publish`: benchmarks, streams, policies and results to the Hugging Face Hub.

cronos-publish benchmark   configurations and chains of a scene, for `--env.benchmark`, `datasets.load_dataset` and
                           LeRobot's `make_env`
cronos-publish stream      recorded training streams, a LeRobotDataset
cronos-publish policy      a policy with its training protocol, its interventions and its curves
cronos-publish results     results of cronos-eval to a policy's repository, for the benchmark's leaderboard

examples:
  the benchmark of a scene; and one of your own, drawn from a seed
      cronos-publish benchmark --repo_id=me/cronos_kitchen
      cronos-publish benchmark --repo_id=me/my_kitchen --seed=7 --num_configurations=32 --num_orderings=4
  what would be pushed, as a folder
      cronos-publish benchmark --repo_id=me/cronos_kitchen --dry_run=true --output_dir=outputs/publish
  a training run: its streams, its policy
      cronos-publish stream --root=outputs/train/eer/streams --repo_id=me/eer_stream
      cronos-publish policy --path=outputs/train/eer --repo_id=me/eer
  what the policy achieves
      cronos-eval --policy.path=me/eer --env.benchmark=me/cronos_kitchen --output_dir=outputs/eval/eer
      cronos-publish results --results=outputs/eval/eer --benchmark=me/cronos_kitchen --repo_id=me/eer

HF_ENDPOINT chooses the Hub and HF_TOKEN the account (or `hf auth login`). After a lost connection the same command
goes on with what is missing. `cronos-publish policy --help` has the flags of a command, docs/hub.md the rest.
"""

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
        # Benchmarks that were made otherwise have the data alone.
        check_holds(config.target, (ENV_FILE, DATA), "choose another --repo_id")
        for target in config.targets[1:]:
            check_holds(target, (ENV_FILE,), "choose another --repo_id, or --env_hub=false")
    # The data and what runs it are two repositories: one name for both, whatever their commits are called.
    benchmark = choose_benchmark(config)
    tag = f"benchmark-{benchmark.fingerprint}"
    _publish(config, partial(write_benchmark_repository, benchmark=benchmark), replaces=REPLACES, tag=tag)
    if not config.dry_run:
        where = "--env.benchmark" + " and in LeRobot's make_env" * config.env_hub
        print(f"{config.repo_id}@{tag} is this benchmark, in {where}")


def publish_stream(config: StreamConfig) -> None:
    """`cronos-publish stream`."""
    config.validate()
    from cronos_lerobot.hub.streams import (
        REPLACES,
        not_being_recorded,
        read_codebase_version,
        write_stream_repository,
    )

    # LeRobot reads a dataset at its version's tag unless it is told a revision: that is not for a branch.
    version = read_codebase_version(config)
    tag = version if config.branch is None else None
    assert config.root is not None
    with not_being_recorded(config.root):
        _publish(config, write_stream_repository, replaces=REPLACES, tag=tag)


def publish_policy(config: PolicyConfig) -> None:
    """`cronos-publish policy`."""
    config.validate()
    from cronos_lerobot.hub.policy import REPLACES, write_policy_repository

    _publish(config, write_policy_repository, replaces=REPLACES)


def publish_results(config: ResultsConfig) -> None:
    """`cronos-publish results`."""
    config.validate()
    from cronos_lerobot.hub.results import find_commit, read_own_results, write_results

    results = read_own_results(config)
    commit = find_commit(config)
    write = partial(write_results, results=results, commit=commit)
    _publish(config, write, creates=False, parent_commit=commit)


def _publish(
    config: Any,
    write: Callable[[Any, Path], str],
    **push: Any,
) -> None:
    """Write the tree, to the dry run's folder or to one that is pushed and gone."""
    if config.dry_run:
        # Whole or not there: what is refused halfway leaves nothing to remove before the next try.
        place = config.output_dir.resolve()
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as beside:
            tree = Path(beside, place.name)
            tree.mkdir()
            what = write(config, tree)
            tree.rename(place)
        files = [path for path in place.rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files) / 1e6
        print(f"dry run: {what}\n{len(files)} files, {size:.2f} MB in {config.output_dir}; nothing was pushed")
        return
    with tempfile.TemporaryDirectory(prefix="cronos_publish_") as folder:
        what = write(config, Path(folder))
        urls = [push_folder(Path(folder), target, f"Publish {what}", **push) for target in config.targets]
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
    run_subcommand(__doc__ or "", COMMANDS, (ValueError, OSError, ImportError, PublishError))


if __name__ == "__main__":
    main()
