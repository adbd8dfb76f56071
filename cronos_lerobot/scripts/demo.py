"""`cronos-demo`: the whole of CRONOS in one command, in 12 to 16 minutes on two CPU cores.

The scripted expert demonstrates four tasks in a shared kitchen scene, a small policy is cloned from it, that
policy goes on learning by itself in 64 streams that are hardly ever reset, and both are evaluated on layouts of
the training and on held-out ones. Every command is shown before it runs: copy it and change its flags.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

from cronos_lerobot.experiments.scales import BASE_KINDS, DIVERSE_DEMO_FLAGS, WIDE
from cronos_lerobot.scripts import probe
from cronos_lerobot.scripts.pipeline import Step, StepFailedError, remember, run_steps
from cronos_lerobot.scripts.yaml_text import is_plain

ENV = ["--env.type=cronos", "--env.obs_type=environment_state_agent_pos"]
DEMOS = "local/cronos_demos"
STREAMS = "local/cronos_demo_streams"
PAGE = "index.html"

MINUTES_PER_PROBE_SECOND = {"full": 8.8, "short": 5.1}
"""How long a scale takes [min] where the probe takes one second. Of full: 11.5 minutes where it took 1.31 s, on
two cores with little else to do; of short: from the minutes of full's steps."""
SHORTEN_ABOVE_MIN = 20.0
"""Where the full demo would take longer than this, `--scale=auto` takes the short one."""


@dataclass(frozen=True)
class Scale:
    """How much of everything."""

    demos: int
    """Demonstrations of the expert."""
    clone_steps: int
    """Gradient steps of behaviour cloning."""
    clone_batch: int
    """Frames in each of them."""
    train_steps: int
    """Interaction steps of reinforcement learning, all streams together."""
    streams: int
    """Parallel streams."""
    update_interval: int
    """Control steps of each stream between two policy updates."""
    scene_reset_interval: int
    """Control steps of each stream between two scene resets."""
    eval_freq: int
    """Interaction steps between two evaluations, and between two checkpoints, while training."""
    train_eval_episodes: int
    """Episodes for each task of those evaluations."""
    eval_episodes: int
    """Episodes for each task and split before and after; 64 is every configuration."""
    eval_splits: tuple[str, ...]
    """Layouts to evaluate on before and after."""
    filmed_segments: int
    """Length of the filmed stream, 80 control steps each."""


_FULL = Scale(
    demos=1200,
    clone_steps=640,
    clone_batch=256,
    train_steps=204_800,
    streams=64,
    update_interval=160,
    scene_reset_interval=320,
    eval_freq=102_400,
    train_eval_episodes=32,
    eval_episodes=64,
    eval_splits=("train", "held_out"),
    filmed_segments=16,
)

SCALES = {
    "full": _FULL,
    # Two fifths of the learning, half of the evaluation.
    "short": replace(
        _FULL, train_steps=81_920, eval_freq=40_960, train_eval_episodes=16, eval_episodes=32, filmed_segments=8
    ),
    "smoke": Scale(
        demos=8,
        clone_steps=5,
        clone_batch=32,
        train_steps=640,
        streams=4,
        update_interval=80,
        scene_reset_interval=160,
        eval_freq=640,
        train_eval_episodes=1,
        eval_episodes=1,
        eval_splits=("held_out",),
        filmed_segments=1,
    ),
}

RECORD_FLAGS = ["--seed=1", *BASE_KINDS[WIDE], *DIVERSE_DEMO_FLAGS]
"""Flags of `cronos-record-demos` that no scale changes: from layouts all over the reach, and from the middle of
streams, a policy is cloned that does held-out layouts as well."""
CLONE_FLAGS = ["--seed=1"]
"""Flags of `lerobot-train` that no scale changes."""
TRAIN_FLAGS = ["--seed=1", "--protocol.end_effector_reset=true", "--protocol.reset_phase=staggered"]
"""Flags of `cronos-train` that no scale changes."""


def make_steps(scale: Scale, folder: Path) -> list[Step]:
    """The demo as steps; their outputs lie in `folder`."""
    base = folder / "base" / "checkpoints/last/pretrained_model"
    tuned = folder / "finetune" / "checkpoints/last/pretrained_model"
    return [
        record_step(scale, folder / "demos"),
        clone_step(scale, folder / "demos", folder / "base"),
        *(eval_step(scale, base, "before", split, folder / "eval") for split in scale.eval_splits),
        train_step(scale, base, folder / "finetune"),
        *(eval_step(scale, tuned, "after", split, folder / "eval") for split in scale.eval_splits),
        film_step(scale, tuned, folder / "stream.mp4"),
        report_step(scale, folder),
    ]


def record_step(scale: Scale, demos: Path) -> Step:
    """Demonstrations."""
    command = ["cronos-record-demos", *ENV, f"--dataset.repo_id={DEMOS}", f"--dataset.root={demos}"]
    command += [f"--dataset.num_episodes={scale.demos}", *RECORD_FLAGS]
    return Step("record", "The scripted expert demonstrates four tasks", command, demos)


def clone_step(scale: Scale, demos: Path, base: Path) -> Step:
    """Behaviour cloning."""
    command = [
        "lerobot-train",
        "--policy.type=pocketvla",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--dataset.repo_id={DEMOS}",
        f"--dataset.root={demos}",
        f"--batch_size={scale.clone_batch}",
        f"--steps={scale.clone_steps}",
        f"--save_freq={scale.clone_steps}",
        "--log_freq=40",
        "--num_workers=0",
        "--wandb.enable=false",
        f"--output_dir={base}",
        *CLONE_FLAGS,
    ]
    return Step("clone", "Behaviour cloning: the base policy", command, base)


def train_step(scale: Scale, policy: Path, run: Path) -> Step:
    """Reset-free reinforcement learning."""
    command = [
        "cronos-train",
        f"--policy.path={policy}",
        *ENV,
        f"--num_envs={scale.streams}",
        f"--steps={scale.train_steps}",
        f"--protocol.update_interval={scale.update_interval}",
        f"--protocol.scene_reset_interval={scale.scene_reset_interval}",
        f"--eval_freq={scale.eval_freq}",
        f"--eval.n_episodes={scale.train_eval_episodes}",
        f"--save_freq={scale.eval_freq}",
        f"--record.repo_id={STREAMS}",
        "--record.streams=1",
        f"--output_dir={run}",
        *TRAIN_FLAGS,
    ]

    def resume() -> list[str] | None:
        config = run / "checkpoints/last/pretrained_model/train_config.json"
        return ["cronos-train", "--resume=true", f"--config_path={config}"] if config.is_file() else None

    title = f"The policy learns by itself, the scene reset every {scale.scene_reset_interval} steps only"
    return Step("train", title, command, run, resume)


def eval_step(scale: Scale, policy: Path, when: str, split: str, folder: Path) -> Step:
    """Independent evaluation of all tasks."""
    output = folder / f"{when}_{split}"
    command = [
        "lerobot-eval",
        f"--policy.path={policy}",
        "--policy.device=cpu",
        *ENV,
        "--env.suite=independent",
        f"--env.split={split}",
        f"--eval.n_episodes={scale.eval_episodes}",
        f"--eval.batch_size={scale.eval_episodes}",
        f"--output_dir={output}",
    ]
    title = f"Evaluation {when} the training, {split.replace('_', '-')} layouts"
    return Step(f"{when}_{split}", title, command, output)


def film_step(scale: Scale, policy: Path, output: Path) -> Step:
    """A video of one stream."""
    command = ["python", "-m", "cronos_lerobot.report.stream_video", f"--policy.path={policy}"]
    command += [f"--segments={scale.filmed_segments}", f"--output={output}"]
    return Step("film", "A video of the policy in a stream without resets", command, output)


def report_step(scale: Scale, folder: Path) -> Step:
    """The report; always made, so that its table ends the demo."""
    command = ["cronos-report", str(folder / "finetune")]
    for when in ("before", "after"):
        command += [f"--{when}", *(str(folder / "eval" / f"{when}_{split}") for split in scale.eval_splits)]
    command += ["--videos", str(folder / "stream.mp4"), f"--output={folder / 'report'}", "--title=CRONOS demo"]
    return Step("report", "Curves, tables and videos", command, folder / "report", always=True)


def choose_scale(folder: Path) -> str:
    """The scale that this machine does in a reasonable time; says how long it will take here.

    Raises:
        FileExistsError: the folder holds something else.
    """
    print("How fast is this machine? ...", end=" ", flush=True)
    note = remember(folder, "machine", lambda: {"probe_s": probe.measure()})
    minutes = {scale: note["probe_s"] * factor for scale, factor in MINUTES_PER_PROBE_SECOND.items()}
    scale = "full" if minutes["full"] <= SHORTEN_ABOVE_MIN else "short"
    print(f"the demo takes about {minutes[scale]:.0f} min here.")
    if scale == "short":
        print(
            "That is a shortened one, with two fifths of the learning; in full (--scale=full) it would take about"
            f" {minutes['full']:.0f} min."
        )
    return scale


def main() -> None:
    """Entry point of `cronos-demo`."""
    parser = argparse.ArgumentParser(
        "cronos-demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/demo"), help="default: outputs/demo")
    parser.add_argument(
        "--scale",
        choices=["auto", *SCALES],
        default="auto",
        help="auto (default) is full, or short where that would take more than "
        f"{SHORTEN_ABOVE_MIN:.0f} minutes; smoke runs everything in a minute or two and learns nothing",
    )
    args = parser.parse_args()
    if not is_plain(f"{args.output_dir}/x"):
        parser.error(f"--output_dir={args.output_dir} is YAML to LeRobot's commands, and another text there")
    start = time.perf_counter()
    again = "run the same command again to go on from here"
    try:
        scale = choose_scale(args.output_dir) if args.scale == "auto" else args.scale
        run_steps(make_steps(SCALES[scale], args.output_dir), args.output_dir)
    except OSError as error:
        sys.exit(f"error: {error}")
    except StepFailedError as error:
        sys.exit(f"error: {error}\n{again}")
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted: {again}")
    print(f"\nDone in {(time.perf_counter() - start) / 60:.1f} min.")
    page, video = args.output_dir / "report" / PAGE, args.output_dir / "stream.mp4"
    print(f"Open {page} in a browser; the stream's video is {video}.")


if __name__ == "__main__":
    main()
