"""`cronos-eval`: the evaluation suites of a policy in one go, with tables, results.json, videos and pictures.

independent: every task from every configuration. sequential: chains of all tasks without a reset in between, in
ten orderings. stream: 16 tasks in a row, nobody resets. Each runs on training and on held-out configurations.

examples:
  everything (5 to 10 minutes on two cores for a small policy)
      cronos-eval --policy.path=outputs/train/eer/checkpoints/last/pretrained_model --output_dir=outputs/eval/eer
  a first impression (under 2 minutes)
      cronos-eval --policy.path=<checkpoint> --quick=true
  only chains, on held-out configurations, the next task as soon as one is complete
      cronos-eval --policy.path=<checkpoint> --eval.suites='[sequential]' --eval.splits='[held_out]' \\
          --advance=on_success
  how long it keeps succeeding when nobody resets, and why streams get stuck
      cronos-eval --policy.path=<checkpoint> --eval.suites='[stream]' --end_effector_reset=true
  the ceiling
      cronos-eval --expert=true

A suite and split that has its results.json in --output_dir is done: the same command continues with the next one.
The environment follows from the policy; --env.scene and the like set it by hand.
"""

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from draccus.cfgparsing import load_config
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging

from cronos_lerobot.command_line import parse_command_line
from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.policy_source import find_policy, load_policy_config
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.evaluation.suites import INDEPENDENT, SEQUENTIAL, STREAM
from cronos_lerobot.film.suites import draw_suite
from cronos_lerobot.report.load import CRONOS_EVAL, load
from cronos_lerobot.report.tables import chain_table, merged, part_table
from cronos_lerobot.scripts.errors import error_line

TITLES = {
    INDEPENDENT: "Independent: success of single tasks",
    SEQUENTIAL: "Sequential: chains without a reset, ± standard deviation over the orderings",
    STREAM: "Stream: tasks in a row, nobody resets",
}


def read_command_line() -> CronosEvalConfig:
    """Return the resolved config that the command line describes.

    Raises:
        ValueError: a flag is wrong.
    """
    config = parse_command_line(CronosEvalConfig, types={"env": "cronos"})
    if path := parser.get_path_arg("policy"):
        overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
        source = find_policy(path)
        config.policy = load_policy_config(source.folder, overrides)
        config.policy_name, config.policy_revision = source.name, source.revision
    given = {flag.removeprefix("--").split("=")[0] for flag in parser.get_cli_overrides("env") or []}
    if file := parser.parse_arg("config_path"):
        with open(file) as content:
            given |= set((load_config(content, file=file) or {}).get("env") or {})
    config.resolve(given)
    return config


def evaluate(config: CronosEvalConfig) -> None:
    """Evaluate as a resolved config says."""
    logging.getLogger("lerobot.configs.video").setLevel(logging.WARNING)
    if config.torch_threads is not None:
        torch.set_num_threads(config.torch_threads)
    set_seed(config.seed)
    evaluation = Evaluation(config, draw=draw_suite)
    logging.info(f"Output folder: {config.output_dir}")
    try:
        results = evaluation.run()
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted: to continue, run the same command with --output_dir={config.output_dir}")
    assert config.output_dir is not None
    print_tables(config.output_dir)
    for one in results:
        if one["suite"] == STREAM:
            print("\n".join(_why_stuck(one)))
    print(f"{config.output_dir}: {sum(one['seconds'] for one in results) / 60:.1f} min")


def print_tables(folder: Path) -> None:
    """Print the report's table of each suite in an output folder."""
    found = load([folder]).evaluations
    for suite, some in found[found["source"] == CRONOS_EVAL].groupby("suite", sort=False):
        parts = part_table(some, ["policy", "split"], with_all=suite != SEQUENTIAL)
        table = chain_table(parts) if suite == SEQUENTIAL else merged(parts)
        print(f"{TITLES[str(suite)]} [95 % interval, clustered by configuration]")
        print(table.drop(columns="policy").to_string(index=False), end="\n\n")


def _why_stuck(results: dict[str, Any]) -> Iterator[str]:
    """How often a policy succeeds in streams by how their segments began, and what streams get stuck on."""
    if done := results["done"]:
        yield f"{results['split']}: {done['success']:.3f} without the segments found complete"
    for start, rate in results["by_start"].items():
        yield f"  began {_words(start)}: success {rate['success']:.3f}, {rate['share']:.0%} of the segments"
    yield f"  streams stuck at the end: {results['stuck']['share']:.1%}"
    for start, count in results["stuck"]["causes"].items():
        yield f"    {count} whose last segments mostly began {_words(start)}"


def _words(start: str) -> str:
    return start.replace("_", " ")


def main() -> None:
    """Parse the command line and evaluate."""
    register_third_party_plugins()
    init_logging()
    # What a policy needs may not be installed.
    with error_line(ImportError):
        evaluate(read_command_line())


if __name__ == "__main__":
    main()
