"""Is the physics honest? The trials of `physics_trials` under that of the environments and that of version 0.

    python -m cronos_lerobot.studies.physics_check [--quick] [--random_steps 200000]

Prints one table, a row for each quantity: the speed of pure physics (the expert's actions replayed, one thread),
what slips in a closed hand, what sinks or drifts at rest, how far bodies slide, what random actions lead to.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
from lerobot_env_cronos import get_scene
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.scene.physics import PHYSICS, PHYSICS_V0, Physics
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.simulation.simulation import Simulation
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from cronos_lerobot.studies import physics_trials as trials

PHYSICS_OF = {"version 0": PHYSICS_V0, "version 1": PHYSICS}
HELD = {
    "ketchup bottle": "kitchen_2x2", "kitchen shovel": "kitchen_2x2",
    "toy bear": "playroom_2x2", "plastic bottle": "playroom_2x2",
}  # fmt: skip
"""The objects, and a scene that each is in."""
Row = tuple[str, str]


def speed(physics: Physics, tape: np.ndarray, poses: np.ndarray) -> float:
    """Control steps per CPU second of pure physics on one thread.

    Args:
        physics: time step and integrator.
        tape: (T, n, 7) actions.
        poses: (n, bodies, 7) where the bodies begin.
    """
    sim, ids = Simulation(get_scene("kitchen_2x2"), len(poses), 1, physics), np.arange(len(poses))
    sim.place(ids, poses)
    start = time.process_time()
    for actions in tape:
        sim.step(actions, ids)
    return tape.shape[0] * len(poses) / (time.process_time() - start)


def record_tape(num_streams: int, steps: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """The expert's actions (steps, n, 7) in `kitchen_2x2`, and the poses (n, bodies, 7) that it began with."""
    env = trials.make_env(num_streams, "kitchen_2x2", PHYSICS)
    everyone = np.arange(num_streams)
    env.set_task(everyone, [env.scene.tasks[i % len(env.scene.tasks)] for i in everyone])
    poses, expert, tape = env.simulation.body_poses().copy(), ScriptedExpert(env), []
    for _ in range(steps):
        tape.append(expert.act())
        env.step(tape[-1])
    return np.stack(tape), poses


def speed_rows(repetitions: int) -> Iterator[tuple[str, list[str]]]:
    """Speeds in alternation, and the ratio of each pair: median and range."""
    tape, poses = record_tape(32)
    rates = np.array([[speed(p, tape, poses) for p in PHYSICS_OF.values()] for _ in range(repetitions + 1)][1:])
    cells = [f"{np.median(r):.0f} [{r.min():.0f}, {r.max():.0f}]" for r in rates.T]
    yield "control steps per CPU second", cells
    ratio = rates[:, 1] / rates[:, 0]
    yield "the same over version 0's", ["1", f"{np.median(ratio):.2f} [{ratio.min():.2f}, {ratio.max():.2f}]"]


def trial_rows(physics: Physics, *, quick: bool, random_steps: int) -> Iterator[Row]:
    """What one physics comes to, as (quantity, value) in a fixed order."""
    for obj, scene in HELD.items():
        slip = trials.slip(scene, obj, 16 if quick else 64, physics)
        fast, still = slip.fast * 1e3, slip.still * 1e3
        yield f"{obj}: lifted", f"{len(fast)}"
        yield f"{obj}: 20 fast steps, median / 95 %, mm", f"{np.median(fast):.2f} / {np.quantile(fast, 0.95):.2f}"
        yield (
            f"{obj}: 40 still steps, median / 95 %, mm",
            (f"{np.median(still):.2f} / {np.quantile(still, 0.95):.2f}"),
        )
    scene = get_scene("kitchen_2x2")
    plate = BODIES["yellow plate"].size[2]
    placements = {
        "on the table": {name: (0.25, 0.15 * i - 0.2, 0.0) for i, name in enumerate(scene.bodies)},
        "stacked": {"yellow plate": (0.3, 0.0, 0.0), "ketchup bottle": (0.3, 0.0, plate)},
    }
    for what, poses in placements.items():
        rest = trials.rest("kitchen_2x2", poses, 100 if quick else 400, physics)
        yield f"{what}, depth, mm", f"{rest.depth * 1e3:.3f}"
        yield f"{what}, drift over {100 if quick else 400} steps, mm", f"{rest.drift * 1e3:.3f}"
    for body in scene.receptacles:
        yield (
            f"{body}: on a slope of 0.9 in 1 s, mm",
            f"{trials.slide(scene.name, body, 0.9, 1.0, physics) * 1e3:.2f}",
        )
        # Coulomb: g (sin - cos) t^2 / 2 with friction 1.
        yield (
            f"{body}: on a slope of 1.1 in 1 s, mm, Coulomb 330",
            (f"{trials.slide(scene.name, body, 1.1, 1.0, physics) * 1e3:.0f}"),
        )
        yield (
            f"{body}: let go at 0.5 m/s, mm, Coulomb 12.7",
            (f"{trials.coast(scene.name, body, 0.5, physics) * 1e3:.2f}"),
        )
    mishaps = trials.random_actions("kitchen_2x2", random_steps, physics=physics)
    yield f"random control steps: {mishaps.control_steps}, diverged", f"{mishaps.diverged}"
    yield f"of {mishaps.episodes} random episodes, a body lost", f"{mishaps.lost}"
    yield "a body below the table top", f"{mishaps.through_table}"
    yield (
        "distance to the arm's target, mean / 99 %, mrad",
        (f"{mishaps.tracking_error * 1e3:.1f} / {mishaps.worst_tracking * 1e3:.0f}"),
    )


def main() -> None:
    """Run the trials and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer streams and steps")
    parser.add_argument("--random_steps", type=int, help="control steps of random actions (default: 200,000)")
    args = parser.parse_args()
    if args.random_steps is not None and args.random_steps < 1:
        parser.error(f"--random_steps must be at least 1, got {args.random_steps}")
    random_steps = args.random_steps or (10_000 if args.quick else 200_000)
    table = Table("", *PHYSICS_OF)
    for name, cells in speed_rows(3 if args.quick else 9):
        table.add_row(name, *cells)
    columns = [
        list(trial_rows(physics, quick=args.quick, random_steps=random_steps))
        for physics in tqdm(PHYSICS_OF.values(), desc="trials")
    ]
    for (name, first), (_, second) in zip(*columns, strict=True):
        table.add_row(name, first, second)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
