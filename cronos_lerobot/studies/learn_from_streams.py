"""What is in a reset-free run for others? Clones it with `lerobot-train` and compares with the base.

    python -m cronos_lerobot.studies.learn_from_streams --output_dir=outputs/learn_from_streams

The base policy learns in 64 recorded streams with few scene resets, and `cronos-streams filter` keeps the segments
in which it brought its task about (not those whose task it found complete). For each seed a new policy of its
kind is cloned from these alone, with the base's own recipe. `--ways` clones also the whole stream, good and bad
alike (`plain`) or by the weights of `cronos-streams weights` (`weighted`). `lerobot-eval` evaluates the base and
the clones. All commands are shown before they run; the same command again goes on where this one was stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from cronos_lerobot.data.stream_filter import PROVENANCE
from cronos_lerobot.locks import FolderInUseError
from cronos_lerobot.protocol.metrics import summarise
from cronos_lerobot.report.lerobot_evaluations import read_evaluation_runs
from cronos_lerobot.report.statistics import Rate
from cronos_lerobot.scripts.demo import SCALES, Scale, clone_step, eval_step, record_step, train_step
from cronos_lerobot.scripts.pipeline import Step, StepFailedError, run_steps

SPLITS = ("train", "held_out")
STREAMS = "local/recorded_streams"
SUCCESSES = "local/successes"
CHECKPOINT = "checkpoints/last/pretrained_model"
WAYS = {
    "plain": "the whole stream, good and bad alike",
    "filtered": "the segments in which the policy did its task, alone",
    "weighted": "the whole stream, by weights",
}
HEADS = {"tokens": [], "flow": ["--policy.head=flow"]}
"""Flags of `lerobot-train` for the policies that are compared."""
LENGTHS = {"full": replace(SCALES["full"], train_steps=153_600), "smoke": SCALES["smoke"]}
"""The study by `--scale`."""


def make_steps(
    scale: Scale, seeds: Sequence[int], folder: Path, ways: Sequence[str] = ("filtered",), head: str = "tokens"
) -> list[Step]:
    """The study as steps; their outputs lie in `folder`."""
    base, run = folder / "base", folder / "run"
    streams, successes, progress = run / "streams", folder / "successes", folder / "progress.parquet"
    # Frames are weighed by their index: the weights are of the very dataset that is cloned.
    whole = {"--dataset.repo_id": STREAMS, "--dataset.root": streams}
    changes: dict[str, dict[str, object]] = {
        "plain": whole,
        "filtered": {"--dataset.repo_id": SUCCESSES, "--dataset.root": successes},
        "weighted": whole | {"--sample_weighting.type": "rabc", "--sample_weighting.progress_path": progress},
    }
    own = dict(flag.split("=") for flag in HEADS[head])

    def evaluate(name: str, policy: Path) -> list[Step]:
        return [eval_step(scale, policy / CHECKPOINT, name, split, folder / "eval") for split in SPLITS]

    clone = clone_step(scale, folder / "demos", base)
    steps = [record_step(scale, folder / "demos"), replace(clone, command=_with(clone.command, own))]
    steps += [*evaluate("base", base), _train(scale, base / CHECKPOINT, run)]
    steps += [_filter(streams, successes)] * ("filtered" in ways) + [_weigh(streams, progress)] * (
        "weighted" in ways
    )
    for seed in seeds:
        for way in ways:
            output = folder / f"{way}_{seed}"
            step = clone_step(scale, successes, output)
            command = _with(step.command, own | changes[way] | {"--seed": seed})
            title = f"A policy cloned from {WAYS[way]}"
            steps.append(replace(step, name=output.name, title=title, command=command))
            steps += evaluate(output.name, output)
    return steps


def _train(scale: Scale, base: Path, run: Path) -> Step:
    step = train_step(scale, base, run)
    changed = {"--record.streams": "all", "--record.repo_id": STREAMS, "--eval_freq": 0}
    command = [flag for flag in step.command if not flag.startswith("--eval.")]
    return replace(step, command=_with(command, changed))


def _filter(streams: Path, output: Path) -> Step:
    command = [
        "cronos-streams", "filter", f"--dataset.repo_id={STREAMS}", f"--dataset.root={streams}",
        "--filter.success=true", "--filter.found_complete=false", "--frames_after_success=8",
        f"--output.repo_id={SUCCESSES}", f"--output.root={output}",
    ]  # fmt: skip
    return Step("filter", "The segments in which the policy did its task", command, output)


def _weigh(streams: Path, output: Path) -> Step:
    command = ["cronos-streams", "weights", f"--dataset.repo_id={STREAMS}", f"--dataset.root={streams}"]
    return Step("weigh", "What each frame of the stream is worth", [*command, f"--output={output}"], output)


def _with(command: list[str], flags: Mapping[str, object]) -> list[str]:
    """A command with other values of some of its flags, or with more flags."""
    names = [part.split("=")[0] for part in command]
    changed = [
        f"{name}={flags[name]}" if name in flags else part for name, part in zip(names, command, strict=True)
    ]
    return changed + [f"{name}={value}" for name, value in flags.items() if name not in names]


def make_table(seeds: Sequence[int], folder: Path, ways: Sequence[str] = ("filtered",)) -> Table:
    """Success of the base and of the clones, each with n and a 95 % interval."""
    table = Table("policy", *(split.replace("_", "-") for split in SPLITS), title="Success, lerobot-eval")
    table.add_row("base", *(str(_rate(folder / f"eval/base_{split}")) for split in SPLITS))
    for way in ways:
        for seed in seeds:
            table.add_row(f"{way}, seed {seed}", *(str(_rate(folder / f"eval/{way}_{seed}_{s}")) for s in SPLITS))
        means = []
        for split in SPLITS:
            values = [_rate(folder / f"eval/{way}_{seed}_{split}").value for seed in seeds]
            means.append(str(summarise(values)))
        if len(seeds) > 1:
            table.add_row(f"{way}, mean ± std", *means)
    return table


def _rate(folder: Path) -> Rate:
    (evaluation,) = read_evaluation_runs(folder)
    return sum(evaluation.tasks.values(), Rate(0, 0))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/learn_from_streams"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--steps", type=int, help="interaction steps of the recorded run; default: the scale's")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["filtered"], help="of cloning the stream")
    parser.add_argument("--head", choices=HEADS, default="tokens", help="of the base and of the clones")
    parser.add_argument("--scale", choices=LENGTHS, default="full", help="smoke learns nothing")
    args = parser.parse_args()
    scale = LENGTHS[args.scale]
    if args.steps is not None:
        scale = replace(scale, train_steps=args.steps)
    try:
        run_steps(make_steps(scale, args.seeds, args.output_dir, args.ways, args.head), args.output_dir)
    except (FileExistsError, FolderInUseError) as error:
        sys.exit(f"error: {error}")
    except StepFailedError as error:
        sys.exit(f"error: {error}\nrun the same command again to go on from here")
    except KeyboardInterrupt:
        sys.exit("\ninterrupted: the same command goes on from here")
    table = make_table(args.seeds, args.output_dir, args.ways)
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    if "filtered" in args.ways:
        print((args.output_dir / "successes" / PROVENANCE).read_text())


if __name__ == "__main__":
    main()
