"""`cronos-reproduce`: run the paper's tables and figures as experiments, and draw them.

An experiment is a list of training runs of `cronos-train`, each with several seeds. Runs are real commands with a
log file each, shared between experiments, skipped when done, and resumed from their last checkpoint when not.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from cronos_lerobot.experiments.definitions import COMMANDS, EXPERIMENTS, Base, Experiment, Row, find_rows
from cronos_lerobot.experiments.flags import DROPS_CHECKPOINTS, RESERVED, join_flags, read_flags
from cronos_lerobot.experiments.jobs import Job, is_done
from cronos_lerobot.experiments.runner import usable_cores
from cronos_lerobot.experiments.scales import OBS_NAMES, SCALES, STATE, base_recipe
from cronos_lerobot.experiments.slurm import SlurmOptions
from cronos_lerobot.experiments.submitted import SlurmError
from cronos_lerobot.scripts.launchers import (
    add_launcher_flags,
    finish,
    make_slurm_options,
    run_here,
    run_on_slurm,
)
from cronos_lerobot.scripts.listing import print_list, print_plan
from cronos_lerobot.scripts.yaml_text import is_plain

if TYPE_CHECKING:
    from cronos_lerobot.experiments.specs import Options

# Modules that bring PyTorch are imported where they are needed: they take seconds, and mistakes are told before.
ROOT = Path("outputs/reproduce")
EPILOG = """\
examples:
  what there is
      cronos-reproduce list
  Table 1 at the size of a laptop: 7 rows, 3 seeds, 307,200 steps each
      cronos-reproduce table1 --scale=small
  two rows of it with the paper's 1.3 M steps, two runs at a time, one seed
      cronos-reproduce table1 --scale=paper --rows t80 t1280_eer --seeds=1 --jobs=2
  see the commands, run nothing
      cronos-reproduce figure3 --dry_run
  draw what there is so far
      cronos-reproduce table1 --scale=small --report_only
  the paper's bias at its strongest: a base policy that has only seen the arm come from home
      cronos-reproduce table1 --base.clean=true --root=outputs/reproduce_clean
  from pixels, with a base policy and a setting of one's own
      cronos-reproduce table1 --obs_type=pixels_agent_pos --policy.path=me/policy -- --algorithm.target_kl=0.02

  on a cluster, 24 runs at a time, and what has become of them
      cronos-reproduce table1 --scale=paper --launcher=slurm --slurm.partition=cpu --slurm.time=4:00:00 --jobs=24
      cronos-reproduce status

Ctrl-C stops the runs; the same command goes on from their last checkpoints. On a cluster they go on without it.
"""


def make_parser() -> argparse.ArgumentParser:
    """The flags of `cronos-reproduce`."""
    parser = argparse.ArgumentParser(
        "cronos-reproduce",
        usage="%(prog)s EXPERIMENT [flags] [-- flags of cronos-train]",
        description=(__doc__ or "").split("`: ")[1].capitalize(),
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    names = [*EXPERIMENTS, *COMMANDS]
    parser.add_argument("experiment", choices=names, metavar="EXPERIMENT", help=", ".join(names))
    parser.add_argument(
        "--scale",
        choices=SCALES,
        default="small",
        help="paper (1.3 M steps, 5 seeds), small (the default) or smoke",
    )
    parser.add_argument(
        "--obs_type", default=STATE, choices=[*OBS_NAMES, *OBS_NAMES.values()], metavar="TYPE",
        help=f"what the policy sees: {STATE} (the default; short: state) or pixels_agent_pos (short: pixels)",
    )  # fmt: skip
    parser.add_argument(
        "--seeds", metavar="N", help="how many seeds (1, 2, ... N), or a list of them: 2,5 (one alone: 2,)"
    )
    parser.add_argument("--rows", nargs="+", default=[], metavar="ROW", help="only these; `list` names them")
    parser.add_argument("--jobs", type=int, help="runs at a time (default: cores / threads)")
    parser.add_argument(
        "--threads", type=int, default=1,
        help="threads of each run (default: 1); results do not depend on --jobs; on this they may",
    )  # fmt: skip
    parser.add_argument(
        "--policy.path", dest="policy_path", metavar="PATH", help="base policy (default: make one)"
    )
    add_base_flags(parser)
    parser.add_argument("--temperature", type=float, default=0.6, help="of every evaluation (default: 0.6)")
    parser.add_argument(
        "--root", type=Path, default=ROOT, help=f"holds base policies and runs, shared by all (default: {ROOT})"
    )
    parser.add_argument("--output_dir", type=Path, help="tables and figures (default: ROOT/EXPERIMENT_SCALE_OBS)")
    parser.add_argument("--import", action="append", metavar="MODULE", help="register the experiments of a module")
    for name, text in (
        ("dry_run", "print the commands and their state; run nothing"),
        ("report_only", "draw what there is; run nothing"),
    ):
        # LeRobot's users write --flag=true.
        parser.add_argument(
            f"--{name}", nargs="?", const=True, default=False, type=parse_bool, metavar="true|false", help=text
        )
    add_launcher_flags(parser)
    return parser


def add_base_flags(parser: argparse.ArgumentParser) -> None:
    """`--base.*`: how the base policy is made."""
    for name, text in (
        ("demos", "demonstrations that the base policy is cloned from"),
        ("clone_steps", "gradient steps of the cloning"),
        ("checkpoint", "the step of the cloning whose policy is taken: a quarter, half, 3/4 or all of them"),
    ):
        parser.add_argument(f"--base.{name}", dest=f"base_{name}", type=int, metavar="N", help=text)
    parser.add_argument(
        "--base.clean", dest="base_clean", nargs="?", const=True, default=False, type=parse_bool,
        metavar="true|false",
        help="clone it from demonstrations that go straight from home to success, as the paper's do",
    )  # fmt: skip


def parse_bool(text: str) -> bool:
    """`true` or `false`.

    Raises:
        argparse.ArgumentTypeError: it is neither.
    """
    if text.lower() not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"must be true or false, got {text!r}")
    return text.lower() == "true"


def import_modules(arguments: list[str]) -> None:
    """Import the modules of --import, so that the parser knows their experiments.

    Raises:
        ValueError: there is no such module, or it registers what cannot be.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--import", action="append", dest="modules", default=[])
    for module in early.parse_known_args(arguments)[0].modules:
        try:
            import_module(module)
        except ImportError as error:
            raise ValueError(
                f"--import={module} cannot be imported ({error}): it is a module's name, and PYTHONPATH says where"
            ) from error


def parse_seeds(text: str | None, default: int) -> tuple[int, ...]:
    """`3` is 1, 2, 3; `3,` is 3 alone; `2,5` is 2 and 5.

    Raises:
        ValueError: it is none of these.
    """
    text = text or str(default)
    try:
        seeds = map(int, text.strip(",").split(",")) if "," in text else range(1, int(text) + 1)
        found = tuple(dict.fromkeys(seeds))
    except ValueError:
        found = ()
    if not found or min(found) < 0:
        raise ValueError(
            f"--seeds must be how many, from 1 on, or a list such as 1,4 (0, is seed 0 alone), got {text!r}"
        )
    return found


def make_options(args: argparse.Namespace, extra: list[str], bases: Iterable[Base]) -> Options:
    """What the flags decide about every run; `bases` are the policies that runs begin with.

    Raises:
        ValueError: a flag makes no sense.
    """
    extra = join_flags(extra)
    taken = [flag for flag in extra if flag.split("=")[0] in RESERVED]
    if taken and taken[0].startswith("--eval.temperature="):
        raise ValueError(f"{taken[0]} after -- is of the runs alone: give --temperature, before it, for all")
    if taken and taken[0].startswith("--env.obs_type="):
        raise ValueError(f"{taken[0]} after -- is of the runs alone: give --obs_type, before it, for all")
    if taken:
        raise ValueError(f"{taken[0]} is set by the experiment; it cannot be given after --")
    given = dict(read_flags(extra))
    episodes = given.get("eval.n_episodes", "")
    # More than one of each configuration are as many of all; a benchmark of one's own may have more of these.
    if "env.benchmark" not in given and episodes.isdigit() and int(episodes) > 64 and int(episodes) % 64:
        raise ValueError(
            f"--eval.n_episodes={episodes} must be at most 64, the configurations, or so many times 64"
        )
    for name, path in (("root", args.root), ("policy.path", args.policy_path)):
        if path is not None and not is_plain(f"{path}/x"):
            raise ValueError(
                f"--{name}={path} is YAML to the commands that it is given to, and another text there: choose a"
                " path without ' #', ': ' and the like"
            )
    if not args.temperature >= 0:
        raise ValueError(f"--temperature must be at least 0, got {args.temperature}")
    scale = SCALES[args.scale]
    obs_type = {short: name for name, short in OBS_NAMES.items()}.get(args.obs_type, args.obs_type)
    changes, bases = base_changes(args), list(bases)
    if args.policy_path and len(kinds := sorted({base.kind for base in bases})) > 1:
        raise ValueError(
            f"--policy.path is one base policy, and these rows begin with {len(kinds)} kinds ({', '.join(kinds)}):"
            " choose with --rows"
        )
    needed = () if args.policy_path else bases
    made = {
        base.recipe: base_recipe(scale, base.scene, obs_type, clean=args.base_clean, kind=base.kind)
        for base in needed
    }
    recipes = {name: replace(recipe, **changes) for name, recipe in made.items()}
    seeds = parse_seeds(args.seeds, scale.seeds)
    from cronos_lerobot.experiments.specs import Options

    return Options(
        scale,
        obs_type,
        seeds,
        args.root,
        args.threads,
        args.temperature,
        args.policy_path,
        tuple(extra),
        recipes,
    )


def base_changes(args: argparse.Namespace) -> dict[str, int]:
    """What `--base.*` changes in the recipe of a base policy; also checks the other whole numbers.

    Raises:
        ValueError: a number is below 1, or the flags are for a policy that is not made.
    """
    flags = {"threads": args.threads, "jobs": args.jobs}
    changes = {name: getattr(args, f"base_{name}") for name in ("demos", "clone_steps", "checkpoint")}
    for flag, value in (flags | {f"base.{name}": value for name, value in changes.items()}).items():
        if value is not None and value < 1:
            raise ValueError(f"--{flag} must be at least 1, got {value}")
    changes = {name: value for name, value in changes.items() if value is not None}
    if args.policy_path and (changes or args.base_clean):
        raise ValueError(
            f"--base.{next(iter(changes), 'clean')} is of a base policy that is made, and --policy.path gives one"
        )
    if "clone_steps" in changes:
        changes.setdefault("checkpoint", changes["clone_steps"])
    return changes


def check_checkpoints(chosen: list[tuple[Experiment, tuple[Row, ...]]], options: Options) -> None:
    """Refuse, where checkpoints are evaluated, flags that may keep a run from having them.

    A row's own reset budget is another matter: `Row.has_budget`.

    Raises:
        ValueError: there is one.
    """
    for experiment, _ in chosen:
        if experiment.evaluations and any(flag.startswith("--protocol.reset_budget") for flag in options.extra):
            raise ValueError(
                f"--protocol.reset_budget ends runs early, and {experiment.name} evaluates their checkpoints at"
                " fixed steps; experiments without such evaluations take it, table1 for example"
            )
        given = [flag for flag in options.extra if flag.startswith(DROPS_CHECKPOINTS)]
        if experiment.evaluations and given:
            raise ValueError(f"{given[0]} drops checkpoints, and {experiment.name} evaluates them after the runs")


def check_runs(jobs: list[Job], options: Options) -> None:
    """End with a line, status 1, where `cronos-train` would refuse a run's flags."""
    from cronos_lerobot.experiments.command_check import BASE_POLICY, check_commands
    from cronos_lerobot.scripts.errors import error_line

    with error_line():
        waiting = [job for job in jobs if not is_done(job)]
        check_commands(waiting, None if options.policy_path else BASE_POLICY)


def run_jobs(jobs: list[Job], args: argparse.Namespace, slurm: SlurmOptions | None) -> dict[str, str]:
    """Run what is not done, here or on a cluster; returns the state of every job by name."""
    try:
        if slurm is None:
            parallel = args.jobs or max(1, usable_cores() // args.threads)
            return run_here(jobs, parallel, args.threads)
        return run_on_slurm(jobs, slurm, args.root, args.threads, args.jobs)
    except (SlurmError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt as end:
        sys.exit(f"\n{end}")


def print_status(root: Path) -> None:
    """Print what has become of every job of a root."""
    from rich.console import Console

    from cronos_lerobot.experiments.status import make_status_table

    try:
        table = make_status_table(root)
    except SlurmError as error:
        sys.exit(f"error: {error}")
    if not table.row_count:
        sys.exit(f"error: nothing was started in {root} yet")
    # Into a file or a narrow terminal whole lines are better than columns cut short.
    console = Console()
    whole = console.measure(table, options=console.options.update(max_width=sys.maxsize)).maximum
    console.width = max(console.width, whole)
    console.print(table)


def write_reports(chosen: list[tuple[Experiment, tuple[Row, ...]]], options: Options, output: Path | None) -> None:
    """Write the tables and figures of every experiment and print where they are."""
    from cronos_lerobot.experiments.outputs import write_outputs

    for experiment, rows in chosen:
        scale, obs = options.scale.name, OBS_NAMES[options.obs_type]
        folder = output or options.root / f"{experiment.name}_{scale}_{obs}"
        print(write_outputs(experiment, rows, options, folder), flush=True)


def main() -> None:
    """Entry point of `cronos-reproduce`."""
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    try:
        import_modules(sys.argv[1:split])
    except ValueError as error:
        sys.exit(f"error: {error}")
    parser = make_parser()
    args = parser.parse_args(sys.argv[1:split])
    if args.experiment == "list":
        print_list()
        return
    if args.experiment == "status":
        print_status(args.root)
        return
    of_the_paper = [name for name, experiment in EXPERIMENTS.items() if experiment.source]
    names = of_the_paper if args.experiment == "all" else [args.experiment]
    if args.experiment == "all" and (args.output_dir or args.rows):
        parser.error("--output_dir and --rows are for one experiment, not for all")
    try:
        chosen = [(EXPERIMENTS[name], find_rows(EXPERIMENTS[name], args.rows)) for name in names]
        bases = dict.fromkeys(row.begins_with(experiment.scene) for experiment, rows in chosen for row in rows)
        options = make_options(args, sys.argv[split + 1 :], bases)
        check_checkpoints(chosen, options)
        slurm = make_slurm_options(args)
        from cronos_lerobot.experiments.plan import make_jobs

        jobs = make_jobs(chosen, options)
    except ValueError as error:
        sys.exit(f"error: {error}")
    if not args.report_only:
        check_runs(jobs, options)
    if args.dry_run:
        print_plan(jobs)
        return
    done = True
    if not args.report_only:
        done = finish(run_jobs(jobs, args, slurm))
    try:
        write_reports(chosen, options, args.output_dir)
    except OSError as error:
        sys.exit(f"error: {error}")
    if not done:
        sys.exit(1)


if __name__ == "__main__":
    main()
