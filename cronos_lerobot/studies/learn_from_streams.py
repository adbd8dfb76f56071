"""What is in a reset-free run for others? Clones its successes with `lerobot-train` and compares with the base.

    python -m cronos_lerobot.studies.learn_from_streams --output_dir=outputs/learn_from_streams

The base policy learns in 64 recorded streams with few scene resets, and `cronos-streams filter` keeps the segments
in which it brought its task about (not those whose task it found complete). For each seed a new policy of its
kind is cloned from these alone, with the base's own recipe. `lerobot-eval` evaluates the base and the clones. All
commands are shown before they run; the same command again goes on where this one was stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cronos_lerobot.data.stream_filter import PROVENANCE
from cronos_lerobot.report.runs import read_evaluation_runs
from cronos_lerobot.report.statistics import Rate
from cronos_lerobot.scripts.demo import SCALES, Scale, clone_step, eval_step, record_step, train_step
from cronos_lerobot.scripts.pipeline import Step, StepFailedError, run_steps

SPLITS = ("train", "held_out")
STREAMS = "local/recorded_streams"
SUCCESSES = "local/successes"
CHECKPOINT = "checkpoints/last/pretrained_model"


def make_steps(scale: Scale, seeds: Sequence[int], folder: Path) -> list[Step]:
    """The study as steps; their outputs lie in `folder`."""
    base, run, data = (folder / name for name in ("base", "run", "successes"))

    def evaluate(name: str, policy: Path) -> list[Step]:
        return [eval_step(scale, policy / CHECKPOINT, name, split, folder / "eval") for split in SPLITS]

    steps = [record_step(scale, folder / "demos"), clone_step(scale, folder / "demos", base)]
    steps += [*evaluate("base", base), _train(scale, base / CHECKPOINT, run), _filter(run / "streams", data)]
    for seed in seeds:
        clone = folder / f"clone_{seed}"
        steps += [_clone(scale, data, clone, seed), *evaluate(clone.name, clone)]
    return steps


def _train(scale: Scale, base: Path, run: Path) -> Step:
    step = train_step(scale, base, run)
    changed = {"--record.streams": "all", "--record.repo_id": STREAMS, "--eval_freq": 0}
    return replace(step, command=_with(step.command, changed))


def _filter(streams: Path, output: Path) -> Step:
    command = [
        "cronos-streams", "filter", f"--dataset.repo_id={STREAMS}", f"--dataset.root={streams}",
        "--filter.success=true", "--filter.found_complete=false", "--frames_after_success=8",
        f"--output.repo_id={SUCCESSES}", f"--output.root={output}",
    ]  # fmt: skip
    return Step("filter", "The segments in which the policy did its task", command, output)


def _clone(scale: Scale, data: Path, output: Path, seed: int) -> Step:
    step = clone_step(scale, data, output)
    changed = {"--seed": seed, "--dataset.repo_id": SUCCESSES}
    title = "A policy cloned from these segments alone"
    return replace(step, name=f"clone_{seed}", title=title, command=_with(step.command, changed))


def _with(command: list[str], flags: dict[str, object]) -> list[str]:
    """A command with other values of some of its flags."""
    return [f"{name}={flags[name]}" if (name := part.split("=")[0]) in flags else part for part in command]


def make_table(scale: Scale, seeds: Sequence[int], folder: Path) -> Table:
    """Success of the base and of the clones, each with n and a 95 % interval."""
    table = Table("policy", *(split.replace("_", "-") for split in SPLITS), title="Success, lerobot-eval")
    table.add_row("base", *(str(_rate(folder / f"eval/base_{split}")) for split in SPLITS))
    for seed in seeds:
        table.add_row(f"clone, seed {seed}", *(str(_rate(folder / f"eval/clone_{seed}_{s}")) for s in SPLITS))
    means = []
    for split in SPLITS:
        values = [_rate(folder / f"eval/clone_{seed}_{split}").value for seed in seeds]
        means.append(f"{np.mean(values):.3f} ± {np.std(values, ddof=min(1, len(values) - 1)):.3f}")
    table.add_row("clones, mean ± std", *means)
    return table


def _rate(folder: Path) -> Rate:
    (evaluation,) = read_evaluation_runs(folder)
    return sum(evaluation.tasks.values(), Rate(0, 0))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/learn_from_streams"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--steps", type=int, default=153_600, help="interaction steps of the recorded run")
    parser.add_argument("--scale", choices=SCALES, default="full", help="smoke learns nothing")
    args = parser.parse_args()
    scale = SCALES[args.scale] if args.scale == "smoke" else replace(SCALES["full"], train_steps=args.steps)
    try:
        run_steps(make_steps(scale, args.seeds, args.output_dir), args.output_dir)
    except FileExistsError as error:
        sys.exit(f"error: {error}")
    except StepFailedError as error:
        sys.exit(f"error: {error}\nrun the same command again to go on from here")
    Console(width=None if sys.stdout.isatty() else 120).print(make_table(scale, args.seeds, args.output_dir))
    print((args.output_dir / "successes" / PROVENANCE).read_text())


if __name__ == "__main__":
    main()
