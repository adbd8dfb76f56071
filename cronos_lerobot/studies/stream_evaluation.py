"""How long a policy keeps succeeding when nobody resets the scene: success by segment since the placement.

    python -m cronos_lerobot.studies.stream_evaluation --policy.path=<checkpoint> \
        [--num_streams 64] [--num_segments 16]

The streams are those of training (Algorithm 1 of the paper) without learning and without a scene reset: 80 steps
a segment, tasks in the training cycle. `python -m lerobot_env_cronos.expert.ceiling` is the same for the expert.

A second table says from which scenes the policy succeeds: how the segments' objects and receptacles lay when the
task was given. `--picture` draws the streams that got stuck.
"""

import argparse
import csv
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.statistics import wilson_interval
from PIL import Image
from tqdm import tqdm

from cronos_lerobot.data.png import encode_palette_png
from cronos_lerobot.film.overlay import Status
from cronos_lerobot.film.stream_sheet import draw_stream_sheet
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import SegmentEnd, Step
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.task_orders import TaskSet, make_task_order
from cronos_lerobot.report.stream_video import Spectator, make_spectator
from cronos_lerobot.scripts.errors import error_line
from cronos_lerobot.training.seeding import NamedGenerators

PICTURED_STREAMS, PICTURED_SEGMENTS = 4, 4
"""Rows and columns of `--picture`."""


class Start(IntEnum):
    """How the object and the receptacle of a task lay when it was given; the first that applies."""

    COMPLETE = 0
    """The task was complete."""
    LOST = 1
    """The object or the receptacle cannot be reached or seen."""
    ON_OTHER_RECEPTACLE = 2
    """The object lies on a receptacle that is not the task's."""
    RECEPTACLE_OCCUPIED = 3
    """The object lies beside the receptacles, but another one is on the task's."""
    FREE = 4
    """The object lies beside the receptacles and the task's is free, as after a scene reset."""


@dataclass(frozen=True)
class StreamOutcomes:
    """Every segment of every stream."""

    success: np.ndarray
    """(num_segments, num_streams) bool."""
    start: np.ndarray
    """(num_segments, num_streams) `Start`."""
    positions: np.ndarray
    """(num_segments, num_streams, nq), MuJoCo's generalised positions at the end of each segment."""
    instructions: list[list[str]]
    """[num_segments][num_streams]."""
    never_grasped: np.ndarray
    """(num_segments, num_streams) bool, a success not found complete whose object was never grasped."""

    def stuck(self, count: int) -> np.ndarray:
        """The `count` streams whose second half has the fewest tasks done by the policy, of equals the first.

        Tasks that were complete from the start were not done by it.
        """
        half = len(self.success) // 2
        done = self.success[half:] & (self.start[half:] != Start.COMPLETE)
        return np.argsort(done.sum(axis=0), kind="stable")[:count]

    def describe(self, segment: int, stream: int) -> Status:
        """What a picture of the end of a segment says."""
        return Status(
            self.instructions[segment][stream],
            segment,
            len(self.success),
            succeeded=bool(self.success[segment, stream]),
            interventions=0,
            outcomes=self.success[: segment + 1, stream].tolist(),
            caption=f"stream {stream}",
            message=f"begins {Start(self.start[segment, stream]).name.lower().replace('_', ' ')}",
        )


def classify_starts(env: CronosVectorEnv) -> np.ndarray:
    """`Start` of each stream's current task, (num_streams,), from the scene as it is."""
    simulation, scene = env.simulation, env.scene
    unsuitable = env.unsuitable_bodies()
    on = {(o, r): simulation.is_on(o, r) for o in scene.objects for r in scene.receptacles}
    start = np.full(env.num_envs, Start.FREE, np.int64)
    for i, task in enumerate(env.tasks):
        body_ids = [scene.bodies.index(body) for body in (task.object, task.receptacle) if body is not None]
        if env.is_success[i]:
            start[i] = Start.COMPLETE
        elif unsuitable[i, body_ids].any():
            start[i] = Start.LOST
        elif any(on[task.object, receptacle][i] for receptacle in scene.receptacles):
            start[i] = Start.ON_OTHER_RECEPTACLE
        elif any(on[o, task.receptacle][i] for o in scene.objects if task.receptacle is not None):
            start[i] = Start.RECEPTACLE_OCCUPIED
    return start


def run_streams(
    env: CronosVectorEnv, agent: Spectator, protocol: ProtocolConfig, num_segments: int, seed: int = 0
) -> StreamOutcomes:
    """Run streams in which nothing is learned.

    Args:
        env: the streams.
        agent: acts in them.
        protocol: task switches and resets.
        num_segments: length of every stream.
        seed: draws the first configurations, those of scene resets, a random task order, and the actions.
    """
    agent.seed(seed)
    rng = NamedGenerators(seed).for_numpy
    task_set = TaskSet.of(env.scene, protocol)
    loop = task_set.new_loop(env.num_envs)
    total_steps = num_segments * protocol.task_switch_interval * env.num_envs
    successes, starts, positions, instructions, never_grasped = [], [], [], [], []
    last_step = protocol.task_switch_interval - 1
    with tqdm(total=total_steps, unit="step", unit_scale=True, disable=None) as bar:
        agent.begin_segment()
        for event in rf_mtrl(
            env, task_set.all, agent,
            make_task_order(protocol.task_order, rng("task_order"), task_set),
            make_resets(protocol, rng), protocol, loop, total_steps,
        ):  # fmt: skip
            if isinstance(event, Step):
                bar.update(env.num_envs)
                if event.t % protocol.task_switch_interval == 0:
                    starts.append(classify_starts(env))  # a step late, in which nothing can be done
                    instructions.append(list(event.instructions))
                if event.t % protocol.task_switch_interval == last_step:
                    positions.append(env.positions(np.arange(env.num_envs)))
            elif isinstance(event, SegmentEnd):
                successes.append(event.success)
                never_grasped.append(event.never_grasped)
                agent.begin_segment()
    return StreamOutcomes(
        np.stack(successes), np.stack(starts), np.stack(positions), instructions, np.stack(never_grasped)
    )


Row = tuple[str, int, int, float, float, int, int]


def rows_by_segment(outcomes: StreamOutcomes) -> list[Row]:
    """One row for each segment, and one for all.

    Name, successes, n, interval, and of the successes those complete from the start and those without a grasp.
    """
    everything = np.ones_like(outcomes.success)
    one = [np.arange(len(everything))[:, None] == i for i in range(len(everything))]
    masks = {str(i): everything & mask for i, mask in enumerate(one)} | {"all": everything}
    return [_row(name, outcomes, mask) for name, mask in masks.items()]


def rows_by_start(outcomes: StreamOutcomes) -> list[Row]:
    """One row for each kind of start that occurred."""
    masks = {start.name.lower(): outcomes.start == start for start in Start}
    return [_row(name, outcomes, mask) for name, mask in masks.items() if mask.any()]


def _row(name: str, outcomes: StreamOutcomes, mask: np.ndarray) -> Row:
    """`mask` (num_segments, num_streams) bool chooses the segments."""
    k, n = int(outcomes.success[mask].sum()), int(mask.sum())
    complete = int((outcomes.start[mask] == Start.COMPLETE).sum())
    return (name, k, n, *wilson_interval(k, n), complete, int(outcomes.never_grasped[mask].sum()))


def print_rows(title: str, rows: list[Row]) -> None:
    """A line for each row."""
    print(f"{title:>20}  success  95 % interval     n  complete from the start  never grasped")
    for name, k, n, low, high, complete, never in rows:
        print(f"{name:>20}  {k / n:7.3f}  {low:.3f}-{high:.3f}  {n:>6d}  {complete / n:<23.3f}  {never / n:.3f}")


def draw_stuck(env: CronosVectorEnv, outcomes: StreamOutcomes) -> Image.Image:
    """The most stuck streams, one a row, at the end of their last segments."""
    num_segments = len(outcomes.success)
    last = range(max(num_segments - PICTURED_SEGMENTS, 0), num_segments)
    stuck = outcomes.stuck(PICTURED_STREAMS)
    return draw_stream_sheet(
        env, [[(outcomes.positions[s, i], outcomes.describe(s, i)) for s in last] for i in stuck]
    )


def _parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy.path", dest="policy_path", required=True, help="checkpoint or Hub id")
    parser.add_argument("--policy.device", dest="device", default="cpu")
    parser.add_argument("--scene", help="default: that of the policy's training, or kitchen_2x2")
    parser.add_argument("--num_streams", type=int, default=64)
    parser.add_argument("--num_segments", type=int, default=16, help="length of a stream, 80 steps each")
    parser.add_argument("--no_end_effector_reset", action="store_true", help="leave the arm where it is")
    parser.add_argument("--heuristic_reset", action="store_true", help="put back bodies that cannot be reached")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="CSV to write")
    parser.add_argument("--picture", type=Path, help="PNG to draw: streams that are stuck, in their last segments")
    return parser.parse_args()


def main() -> None:
    """Print a row per segment and one per kind of start, and write them to a CSV."""
    args = _parse_args()
    register_third_party_plugins()
    with error_line(ImportError):
        env_config, agent = make_spectator(args.policy_path, args.device, args.scene)
    env = CronosVectorEnv(args.num_streams, env_config.scene, **env_config.gym_kwargs)
    protocol = ProtocolConfig(
        scene_reset_interval=None,
        end_effector_reset=not args.no_end_effector_reset,
        heuristic_reset=args.heuristic_reset,
    )
    outcomes = run_streams(env, agent, protocol, args.num_segments, args.seed)
    if args.picture is not None:
        args.picture.parent.mkdir(parents=True, exist_ok=True)
        args.picture.write_bytes(encode_palette_png(draw_stuck(env, outcomes)))
    env.close()
    tables = {"segment": rows_by_segment(outcomes), "start": rows_by_start(outcomes)}
    for title, rows in tables.items():
        print_rows(title, rows)
    if args.output is not None:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        with args.output.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(
                ["table", "name", "successes", "n", "ci95_low", "ci95_high", "found_complete", "never_grasped"]
            )
            writer.writerows([title, *row] for title, rows in tables.items() for row in rows)


if __name__ == "__main__":
    main()
