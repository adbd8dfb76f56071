"""The ceiling of the benchmark: how often the scripted expert succeeds, from resets and in reset-free streams.

    python -m lerobot_env_cronos.expert.ceiling --scene kitchen_2x2 --output ceiling

prints one row per task and split (independent evaluation, 80 steps from a scene reset), one per segment of
reset-free streams (80 steps each, tasks in the training cycle, no scene reset), and one per reset task ("put the
[object] on the table", in streams that alternate tasks and reset tasks), with 95 % Wilson intervals. `--output`
also writes `independent.csv`, `reset_free.csv`, `reset_tasks.csv` and, with matplotlib, `reset_free.png`.
"""

import argparse
import csv
from collections.abc import Callable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from lerobot_env_cronos.benchmark.command_line import find_scene
from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS, SPLITS, load_configurations
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.scene.robot import EE_HIGH, EE_LOW
from lerobot_env_cronos.scene.scenes import STEPS_PER_TASK, Task
from lerobot_env_cronos.statistics import wilson_interval
from lerobot_env_cronos.vector_env import CronosVectorEnv

STATE_OBSERVATIONS = "environment_state_agent_pos"


@dataclass(frozen=True)
class SuccessRate:
    """A success rate with its 95 % interval."""

    group: str
    """Split, or number of the segment."""
    task: str
    """Instruction, or `all`."""
    successes: int
    n: int
    rate: float
    low: float
    high: float


def success_rate(group: str, task: str, success: np.ndarray) -> SuccessRate:
    """Summarise outcomes (n,) bool."""
    k, n = int(success.sum()), len(success)
    return SuccessRate(group, task, k, n, k / n, *wilson_interval(k, n))


def run_segment(env: CronosVectorEnv, act: Callable[[], np.ndarray], *, stop_early: bool = False) -> np.ndarray:
    """Act for 80 steps; (n,) bool, the streams whose task was complete at any step.

    With `stop_early` it ends as soon as that is true of all.
    """
    success = np.zeros(env.num_envs, dtype=bool)
    for _ in range(STEPS_PER_TASK):
        *_, info = env.step(act())
        success |= info["is_success"]
        if stop_early and success.all():
            break
    return success


def measure_independent(scene: str, split: str, task: Task, env: CronosVectorEnv | None = None) -> np.ndarray:
    """Success (64,) of the expert on `task` from every configuration of `split`."""
    env = env or CronosVectorEnv(NUM_CONFIGURATIONS, scene, obs_type=STATE_OBSERVATIONS)
    everyone = np.arange(env.num_envs)
    env.scene_reset(everyone, everyone % NUM_CONFIGURATIONS, split)
    env.set_task(everyone, [task] * env.num_envs)
    return run_segment(env, ScriptedExpert(env).act, stop_early=True)


@dataclass(frozen=True)
class ResetFreeOutcome:
    """What happened in reset-free streams."""

    success: np.ndarray
    """(segments, streams) bool."""
    instructions: np.ndarray
    """(segments, streams) str."""
    lost: np.ndarray
    """(streams,) bool: a body is out of the workspace at the end."""


def measure_reset_free(
    scene: str, num_streams: int, num_segments: int, end_effector_reset: bool = True, reset_tasks: bool = False
) -> ResetFreeOutcome:
    """The expert in streams without scene resets, under the training cycle of tasks.

    With `reset_tasks` every second segment is the reset task of the object that was just put somewhere.
    """
    env = CronosVectorEnv(num_streams, scene, obs_type=STATE_OBSERVATIONS)
    everyone, tasks = np.arange(num_streams), env.scene.tasks
    env.scene_reset(everyone, everyone % NUM_CONFIGURATIONS)
    expert = ScriptedExpert(env)
    # Streams that share a configuration get different offsets in the cycle.
    offset = everyone + everyone // NUM_CONFIGURATIONS
    success, instructions = np.zeros((num_segments, num_streams), dtype=bool), []
    for segment in range(num_segments):
        if end_effector_reset and segment > 0:
            env.end_effector_reset(everyone)
        turn, is_reset = divmod(segment, 2) if reset_tasks else (segment, 0)
        current = [tasks[(i + turn) % len(tasks)] for i in offset]
        env.set_task(everyone, [Task(task.object, None) for task in current] if is_reset else current)
        expert.reset(everyone)
        success[segment] = run_segment(env, expert.act)
        instructions.append(env.instructions)
    return ResetFreeOutcome(success, np.array(instructions), has_lost_body(env))


def has_lost_body(env: CronosVectorEnv) -> np.ndarray:
    """Streams (n,) in which the centre of a body is outside the reach of the end effector, or fell."""
    position = env.simulation.body_poses()[..., :3]
    outside = (position[..., :2] < EE_LOW[:2]) | (position[..., :2] > EE_HIGH[:2])
    lost = outside.any(-1) | (position[..., 2] < 0.0)
    return np.asarray(lost.any(-1))


def print_rates(rates: list[SuccessRate]) -> None:
    """One line per rate."""
    for r in rates:
        interval = f"[{r.low:.3f}, {r.high:.3f}]"
        print(f"{r.group:>10}  {r.task:<45} {r.successes:>4}/{r.n:<4} {r.rate:.3f} {interval}", flush=True)


def write_csv(path: Path, rates: list[SuccessRate]) -> None:
    """Write rates as CSV with a header."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(SuccessRate)])
        writer.writerows(astuple(rate) for rate in rates)


def draw_curve(path: Path, rates: list[SuccessRate], title: str) -> bool:
    """Draw success by segment with its interval as a PNG; False without matplotlib."""
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        return False
    segment = np.arange(1, len(rates) + 1)
    figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
    axes.fill_between(segment, [r.low for r in rates], [r.high for r in rates], alpha=0.25, lw=0)
    axes.plot(segment, [r.rate for r in rates], marker="o", ms=4)
    axes.set(xlabel="segment since the scene reset (80 steps each)", ylabel="success rate", ylim=(0, 1.02))
    axes.set_title(title)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return True


def _parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="kitchen_2x2")
    parser.add_argument("--num_streams", type=int, default=128)
    parser.add_argument("--num_segments", type=int, default=16)
    parser.add_argument("--no_end_effector_reset", action="store_true", help="leave the arm where it is")
    parser.add_argument("--output", type=Path, help="folder for CSV and PNG files")
    parser.add_argument("--discover_packages_path", help="package to import first, which registers the scene")
    args = parser.parse_args()
    # Half of the streams do a reset task after each task.
    for name in ("num_streams", "num_segments"):
        if getattr(args, name) < 2:
            parser.error(f"--{name} must be at least 2, got {getattr(args, name)}")
    scene = find_scene(parser, args.scene, args.discover_packages_path)
    try:
        # Bodies that do not fit, and a folder that cannot be made, are told before minutes of measuring.
        load_configurations(scene.name, "train")
        if args.output:
            args.output.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    return args


def main() -> None:
    """Measure, print and write the ceiling of a scene."""
    args = _parse_args()
    env = CronosVectorEnv(NUM_CONFIGURATIONS, args.scene, obs_type=STATE_OBSERVATIONS)
    independent = []
    for split in SPLITS:
        for task in env.scene.tasks:
            outcome = measure_independent(args.scene, split, task, env)
            independent.append(success_rate(split, task.instruction, outcome))
            print_rates(independent[-1:])
    with_eer = not args.no_end_effector_reset
    streams = measure_reset_free(args.scene, args.num_streams, args.num_segments, with_eer)
    reset_free = [success_rate(str(i + 1), "all", outcome) for i, outcome in enumerate(streams.success)]
    print_rates(reset_free)
    print_rates([success_rate("mean", "all", streams.success.ravel())])
    print(f"streams in which a body left the workspace: {streams.lost.sum()}/{len(streams.lost)}", flush=True)
    alternating = measure_reset_free(args.scene, args.num_streams // 2, args.num_segments, with_eer, True)
    done = {task: alternating.instructions == task.instruction for task in env.scene.reset_tasks}
    # In few streams and segments not every reset task comes up.
    reset_tasks = [
        success_rate("reset", task.instruction, alternating.success[these])
        for task, these in done.items()
        if these.any()
    ]
    print_rates(reset_tasks)
    if args.output:
        write_csv(args.output / "independent.csv", independent)
        write_csv(args.output / "reset_free.csv", reset_free)
        write_csv(args.output / "reset_tasks.csv", reset_tasks)
        title = f"Scripted expert, {args.scene}, {args.num_streams} streams"
        if not draw_curve(args.output / "reset_free.png", reset_free, title):
            print("matplotlib is not installed: no reset_free.png")


if __name__ == "__main__":
    main()
