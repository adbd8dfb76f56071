"""`cronos-reproduce`: run the paper's tables and figures as experiments, and draw them.

An experiment is a list of rows, each a training run with several seeds. Runs are ordinary commands with a log file
each. Run the same command again to continue: finished commands are skipped, stopped runs resume.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from cronos_lerobot.experiments.definitions import EXPERIMENTS, Experiment, find_rows
from cronos_lerobot.experiments.pipeline import Command, Pipeline, await_all, interrupt_on_signals, run_here
from cronos_lerobot.experiments.plan import Options, Run, make_pipelines, make_runs
from cronos_lerobot.experiments.scales import OBS_TYPES, SCALES

# Modules that bring PyTorch or pandas are imported where they are needed: `--help` answers at once.
EPILOG = """\
examples:
  list all experiments and their rows
      cronos-reproduce list
  Table 1 at the size of a laptop: 7 rows, 3 seeds, 307,200 steps each
      cronos-reproduce table1 --scale=small
  two rows of it with the paper's 1.3 M steps and one seed
      cronos-reproduce table1 --scale=paper --rows t80 t1280_eer --seeds=1
  print the commands, run nothing
      cronos-reproduce figure3 --dry_run
  your own base policy and settings
      cronos-reproduce table1 --policy.path=me/policy -- --algorithm.target_kl=0.02
  on a Slurm cluster, 24 runs at a time, four hours each before they requeue
      cronos-reproduce table1 --scale=paper --launcher=slurm --jobs=24 --slurm.partition=cpu --slurm.time=240

Figures 11 to 14 are the pictures NAME_by_task.png of figure3, table1, figure4 and figure2.
Ctrl-C saves and stops the runs. On a cluster they keep running; `scancel --name=...` ends them.
"""


def make_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-reproduce`."""
    parser = argparse.ArgumentParser(
        "cronos-reproduce",
        usage="%(prog)s EXPERIMENT [flags] [-- flags of cronos-train]",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    names = [*EXPERIMENTS, "all", "list"]
    parser.add_argument("experiment", choices=names, metavar="EXPERIMENT", help=", ".join(names))
    parser.add_argument(
        "--scale", choices=SCALES, default="small", help="paper (5 seeds), small (default) or smoke"
    )
    parser.add_argument("--obs", choices=OBS_TYPES, default="state", help="what the policy sees (default: state)")
    parser.add_argument("--seeds", type=int, nargs="+", help="one number N for seeds 1 to N, or a list of seeds")
    parser.add_argument("--rows", nargs="+", default=[], metavar="ROW", help="only these rows")
    parser.add_argument("--jobs", type=int, help="runs at a time (default: cores / threads)")
    parser.add_argument("--threads", type=int, default=1, help="threads of each run (default: 1)")
    parser.add_argument(
        "--policy.path", dest="policy_path", metavar="PATH", help="base policy (default: make one)"
    )
    parser.add_argument(
        "--root", type=Path, default=Path("outputs/reproduce"), help="folder of all runs and tables"
    )
    parser.add_argument(
        "--discover_packages_path", metavar="MODULE", help="import a module that registers experiments"
    )
    parser.add_argument(
        "--dry_run", action="store_true", help="print the commands and which are done; run nothing"
    )
    parser.add_argument("--report_only", action="store_true", help="draw what there is; run nothing")
    parser.add_argument(
        "--launcher", choices=("local", "slurm"), default="local", help="here (default) or by Slurm"
    )
    parser.add_argument(
        "--slurm.requeues", dest="requeues", type=int, default=50, metavar="N",
        help="how often a run may reach its time limit and continue; other --slurm.NAME=VALUE (partition, "
        "account, gres, mem, time in minutes, signal_delay_s, ...) are submitit's",
    )  # fmt: skip
    return parser


def read_slurm_flags(words: Sequence[str]) -> dict[str, Any]:
    """`--slurm.NAME=VALUE` as parameters of submitit's executor.

    Raises:
        ValueError: a word is no such flag.
    """
    found: dict[str, Any] = {}
    for word in words:
        name, sign, value = word.removeprefix("--slurm.").partition("=")
        if not (word.startswith("--slurm.") and sign):
            raise ValueError(f"there is no flag {word}; flags of cronos-train follow after --")
        # A list, as of commands in `setup`, is JSON.
        found[name] = json.loads(value) if value.isdigit() or value.startswith("[") else value
    return found


def print_list() -> None:
    """Print every experiment with its rows."""
    for experiment in EXPERIMENTS.values():
        print(f"\n{experiment.name}: {experiment.title}{f' ({experiment.source})' * bool(experiment.source)}")
        for row in experiment.rows:
            print(f"    {row.name:24} {row.label}")


def print_plan(pipelines: Sequence[Pipeline]) -> None:
    """Print every command once, and whether it is done."""
    seen = set()
    for pipeline in pipelines:
        for command in pipeline.commands:
            if command.output not in seen:
                seen.add(command.output)
                print(f"# {command.output}: {'done' if command.is_done else 'not done'}\n{command}\n")


def steps_done(run: Run) -> int:
    """Interaction steps that a run has logged so far."""
    with suppress(OSError, ValueError, LookupError), (run.folder / "train/metrics.jsonl").open("rb") as file:
        file.seek(-min(file.seek(0, os.SEEK_END), 65536), os.SEEK_END)
        return json.loads(file.readlines()[-1])["interaction_steps"]
    return 0


def run_all(runs: Sequence[Run], args: argparse.Namespace, slurm: dict[str, Any]) -> list[str]:
    """Run what is not done; returns why pipelines failed, a line each."""
    from tqdm import tqdm

    by_name = {run.name: run for run in runs}
    pipelines = [pipeline for pipeline in make_pipelines(runs) if not pipeline.is_done]
    if not pipelines:
        return []
    total = sum(run.steps for run in by_name.values())
    with tqdm(total=total, unit="step", unit_scale=True, smoothing=0.05) as bar:
        bar.n = bar.initial = sum(map(steps_done, by_name.values()))

        def show(command: Command) -> None:
            tqdm.write(f"{command.words[0]}: {command.log}")

        def progress() -> None:
            bar.update(min(total, sum(map(steps_done, by_name.values()))) - bar.n)

        if args.launcher == "local":
            parallel = args.jobs or max(1, len(os.sched_getaffinity(0)) // args.threads)
            return run_here(pipelines, parallel, args.threads, progress, show)
        from cronos_lerobot.experiments.slurm import submit

        if args.jobs:
            slurm["array_parallelism"] = args.jobs
        jobs = submit(pipelines, args.root / "slurm", slurm, args.threads, args.requeues)
        return await_all(pipelines, jobs, progress)


def choose(args: argparse.Namespace, extra: Sequence[str]) -> dict[Experiment, list[Run]]:
    """The runs of the experiments that the command line names."""
    scale = SCALES[args.scale]
    options = Options(scale, args.obs, args.root, args.threads, args.policy_path, tuple(extra))
    seeds = args.seeds or [scale.seeds]
    seeds = range(1, seeds[0] + 1) if len(seeds) == 1 else seeds
    names = list(EXPERIMENTS) if args.experiment == "all" else [args.experiment]
    chosen = [EXPERIMENTS[name] for name in names]
    return {one: make_runs(one, find_rows(one, args.rows), seeds, options) for one in chosen}


def main() -> None:
    """Entry point of `cronos-reproduce`."""
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    plugins = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    plugins.add_argument("--discover_packages_path", action="append", default=[])
    for module in plugins.parse_known_args(sys.argv[1:split])[0].discover_packages_path:
        import_module(module)
    args, others = make_parser().parse_known_args(sys.argv[1:split])
    if args.experiment == "list":
        print_list()
        return
    interrupt_on_signals()
    try:
        slurm = read_slurm_flags(others)
        chosen = choose(args, sys.argv[split + 1 :])
        runs = [run for made in chosen.values() for run in made]
        if args.dry_run:
            print_plan(make_pipelines(runs))
            return
        failed = [] if args.report_only else run_all(runs, args, slurm)
    except ValueError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted; continue with: {shlex.join(['cronos-reproduce', *sys.argv[1:]])}")
    from cronos_lerobot.experiments.outputs import write_outputs

    for experiment, made in chosen.items():
        folder = args.root / f"{experiment.name}_{args.scale}_{args.obs}"
        print(write_outputs(experiment, made, folder))
    if failed:
        sys.exit("\n".join(["error: not everything is done:", *failed]))


if __name__ == "__main__":
    main()
