"""`cronos-demo`: reset-free learning in one command, in about four minutes on two CPU cores.

The official base policy succeeds in half of four tasks in a shared kitchen scene. It learns by itself in 64
streams that are hardly ever reset. It is evaluated before and after, on training and on held-out layouts. With
--scale=full the scripted expert demonstrates first, and a base policy is cloned from it. Every command is shown
before it runs: copy it and change its flags.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from cronos_lerobot.experiments.pipeline import Command, CommandFailedError, Runner, interrupt_on_signals
from cronos_lerobot.experiments.plan import POLICY, Options, base_commands, official_run
from cronos_lerobot.experiments.scales import SCALES as EXPERIMENT_SCALES

ENV = ("--env.type=cronos", "--env.obs_type=environment_state_agent_pos")
LEARNS = {
    "train": "--num_envs=64 --steps=204800 --eval_freq=102400 --eval.n_episodes=32 --save_freq=102400",
    "evaluate": "",
    "film": "",
}
SCALES = {
    "quick": LEARNS,
    "full": LEARNS,
    "smoke": {
        "train": "--num_envs=4 --steps=640 --protocol.update_interval=80 --eval.n_episodes=1",
        "evaluate": "--eval.n_episodes=1",
        "film": "--env.render_size=[120,160]",
    },
}
"""Flags that depend on the scale."""
BASES = {"full": "small", "smoke": "smoke"}
"""Scales that clone a base policy of their own, and the scale of the experiments whose recipe they follow."""
RESETS = "--protocol.scene_reset_interval=320 --protocol.reset_phase=staggered --protocol.end_effector_reset=true"
SINGLE_TASKS = "--eval.suites=[independent] --eval.videos=0"
ONE_STREAM = "--eval.suites=[stream] --eval.splits=[train] --eval.n_episodes=1 --end_effector_reset=true"
RECORD = "--record.repo_id=local/cronos_demo_streams --record.streams=1"


def make_commands(scale: str, folder: Path) -> list[Command]:
    """The commands of the demo; their outputs lie in `folder`."""
    more = {name: flags.split() for name, flags in SCALES[scale].items()}
    tuned = folder / "finetune"
    before, after, film = folder / "eval_before", folder / "eval_after", folder / "film"
    base, making = "kitchen_2x2_state", []
    if scale in BASES:
        making = base_commands(official_run(Options(EXPERIMENT_SCALES[BASES[scale]], "state", folder)))
        base = str(making[-1].output / POLICY)
    train = ("cronos-train", f"--policy.path={base}", *ENV, "--seed=1", *RESETS.split())
    train += (*RECORD.split(), *more["train"], "--resume=auto")
    report = ("cronos-report", str(tuned), "--before", str(before), "--after", str(after), str(film))
    return [
        *making,
        _evaluation(base, before, [*ENV, *SINGLE_TASKS.split(), *more["evaluate"]]),
        Command((*train, f"--output_dir={tuned}"), tuned, resumes=True),
        _evaluation(str(tuned / POLICY), after, [*SINGLE_TASKS.split(), *more["evaluate"]]),
        _evaluation(str(tuned / POLICY), film, [*ONE_STREAM.split(), *more["film"]]),
        Command((*report, f"--output={folder / 'report'}", "--title=CRONOS demo"), folder / "report"),
    ]


def _evaluation(policy: str, output: Path, flags: list[str]) -> Command:
    words = ("cronos-eval", f"--policy.path={policy}", *flags, f"--output_dir={output}")
    return Command(words, output, resumes=True)


def main() -> None:
    """Entry point of `cronos-demo`."""
    parser = argparse.ArgumentParser(
        "cronos-demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/demo"), help="default: outputs/demo")
    parser.add_argument(
        "--scale",
        choices=SCALES,
        default="quick",
        help="quick (default), full: clone your own base first, or smoke: learns nothing",
    )
    args = parser.parse_args()
    commands = make_commands(args.scale, args.output_dir)
    start = time.perf_counter()

    def show(command: Command) -> None:
        number = commands.index(command) + 1
        print(f"\n[{number}/{len(commands)}] {command}\n", flush=True)

    interrupt_on_signals()
    runner = Runner(threads=2, show=show, log=False)
    try:
        runner.run(commands)
    except (CommandFailedError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        runner.stop()
        sys.exit("\ninterrupted: run the same command again to continue")
    print(f"\nDone in {(time.perf_counter() - start) / 60:.1f} min.")
    print(f"Open {args.output_dir / 'report' / 'index.html'} in a browser.")
    print(f"A video of a stream that nobody resets is in {args.output_dir / 'film' / 'stream_train' / 'videos'}.")


if __name__ == "__main__":
    main()
