"""`cronos-eval`: both evaluation suites of a policy in one go, with a table, results.json and videos.

Every task from every configuration (independent), and chains of all tasks without a reset in between, in ten
orderings (sequential), on training and on held-out configurations. docs/evaluation.md has the protocol.

examples:
  everything (about 10 minutes on two cores for a small policy from pixels)
      cronos-eval --policy.path=outputs/train/eer/checkpoints/last/pretrained_model --output_dir=outputs/eval/eer
  a first impression (under 2 minutes)
      cronos-eval --policy.path=<checkpoint> --quick=true
  only chains, on held-out configurations, the next task as soon as one is complete
      cronos-eval --policy.path=<checkpoint> --eval.suites=sequential --eval.splits=held_out --advance=on_success
  against another policy, only until it is decided which is better
      cronos-eval --policy.path=<checkpoint> --eval.suites=independent --eval.splits=held_out \\
          --compare_with=<output_dir of the other> --stop_at_error=0.05
  the ceiling
      cronos-eval --expert=true

After a kill the same command goes on from there, given the --output_dir that it logs first. The environment
follows from the policy; --env.scene and the like set it by hand.
"""

import logging
import sys

import torch
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging
from rich.console import Console

from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.outcomes import read_outcomes
from cronos_lerobot.evaluation.results import make_tables
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.evaluation.stopping import StoppingEvaluation, check_pairs, decision_text
from cronos_lerobot.evaluation.store import COMPARISON, RESULTS
from cronos_lerobot.scripts.errors import error_line, parse_command_line


def evaluate(config: CronosEvalConfig) -> None:
    """Evaluate as `config` says, or go on where an earlier evaluation was stopped."""
    init_logging()
    is_named = config.output_dir is not None
    # What a policy needs may not be installed.
    with error_line(ImportError):
        config.validate()
        reference = None
        if config.compare_with is not None:
            reference = read_outcomes(config.compare_with)
            check_pairs(reference, config)
        stops = reference is not None and config.stop_at_error is not None
        evaluation = StoppingEvaluation(config, reference) if stops else Evaluation(config)
    logging.getLogger("lerobot.configs.video").setLevel(logging.WARNING)
    if config.torch_threads is not None:
        torch.set_num_threads(config.torch_threads)
    set_seed(config.seed)
    again = "" if is_named else f"; after a kill the same command with --output_dir={config.output_dir} goes on"
    logging.info(f"Output folder: {config.output_dir}{again}")
    try:
        with evaluation:
            with error_line(ImportError):
                evaluation.prepare()
            results = evaluation.run()
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted: the same command with --output_dir={config.output_dir} goes on from here")
    if stops:
        print(decision_text(results))
        print(f"{evaluation.store.folder / COMPARISON}: {results['seconds'] / 60:.1f} min")
        return
    console = Console(width=None if sys.stdout.isatty() else 120)
    for table in make_tables(results):
        console.print(table)
    videos = f", {len(results['videos'])} videos" if results.get("videos") else ""
    print(f"{evaluation.store.folder / RESULTS}: {results['seconds'] / 60:.1f} min{videos}")
    if reference is not None:
        assert config.compare_with is not None
        from cronos_lerobot.report.compared_sides import Side
        from cronos_lerobot.report.paired_report import compare_sides, to_text

        folder = evaluation.store.folder
        sides = Side((config.compare_with,), [reference]), Side((folder,), [read_outcomes(folder)])
        print(to_text(compare_sides(*sides, power=0.8), power=0.8))


def main() -> None:
    """Parse the command line and evaluate."""
    register_third_party_plugins()
    arguments = sys.argv[1:]
    if "--help" in arguments or "-h" in arguments:
        print(__doc__)
    # draccus wants the type of a choice whenever one of its fields is set.
    if any(a.startswith("--env.") for a in arguments) and not any(a.startswith("--env.type") for a in arguments):
        sys.argv.append("--env.type=cronos")
    with error_line():
        config = parse_command_line(CronosEvalConfig)
    evaluate(config)


if __name__ == "__main__":
    main()
