"""`cronos-eval`: the evaluation suites of a policy in one go, with tables, results.json, videos and pictures.

independent: every task from every configuration. sequential: chains of all tasks without a reset in between, in
ten orderings. stream: 16 tasks in a row, nobody resets. Each runs on training and on held-out configurations.

examples:
  everything (about 10 minutes on two cores for a small policy from pixels)
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

A suite and split that has its results.json in --output_dir is done: the same command goes on with the next one.
The environment follows from the policy; --env.scene and the like set it by hand.
"""

import logging
import sys

import torch
from draccus.cfgparsing import load_config
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging
from rich.console import Console

from cronos_lerobot.command_line import parse_command_line
from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.policy_source import find_policy, load_policy_config
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.evaluation.tables import make_tables
from cronos_lerobot.film.suites import draw_suite
from cronos_lerobot.scripts.errors import error_line


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
        sys.exit(f"\ninterrupted: the same command with --output_dir={config.output_dir} goes on")
    console = Console(width=None if sys.stdout.isatty() else 120)
    for table in make_tables(results):
        console.print(table)
    print(f"{config.output_dir}: {sum(one['seconds'] for one in results) / 60:.1f} min")


def main() -> None:
    """Parse the command line and evaluate."""
    register_third_party_plugins()
    init_logging()
    # What a policy needs may not be installed.
    with error_line(ImportError):
        evaluate(read_command_line())


if __name__ == "__main__":
    main()
