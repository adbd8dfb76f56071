"""How often a closed hand that is pressed onto an object passes for a grasp.

    python -m cronos_lerobot.studies.pressed_fist [--scenes kitchen_2x2 playroom_2x2] [--trials=32]

The fingers' forces are asked for their size and their angle to the closing axis, to whichever side. A fist is
lowered onto each object at a random turn and up to 2 cm beside its centre, to 2 cm below its top, for 25 control
steps. The table says in how many of them that is a grasp, in how many it would be if each finger had to be pressed
outwards, as by what it holds, what `--protocol.reward=level` pays the best trial, and how many were lifted.
"""

from __future__ import annotations

import argparse

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import get_scene
from lerobot_env_cronos.scene.model import grasp_sensor
from lerobot_env_cronos.scene.robot import FINGERTIP_REACH
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.simulation.judging import GRASP_MAX_ANGLE_RAD, GRASP_MIN_FORCE_N
from lerobot_env_cronos.simulation.simulation import Simulation
from lerobot_env_cronos.vector_env import GRASP_REWARD
from rich.console import Console
from rich.table import Table

from cronos_lerobot.studies.cheat_trials import hand_action, move_hand

NUM_STEPS = 25
PLACE = (0.31, 0.0)
"""Of the object, in the middle of the reach [m]."""
MAX_BESIDE, ABOVE, BELOW = 0.02, 0.01, 0.02
"""How far beside the object's centre the fist comes down, from how far above its top, and to how far below [m]."""


def press(scene: str, obj: str, num_trials: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Press a fist onto an object.

    Args:
        scene: that the object is of.
        obj: its name.
        num_trials: simulations, each with a place and a turn of its own.
        seed: of both.

    Returns:
        (num_trials,) control steps with a grasp; those with one that presses each finger outwards; and bool,
        whether the object's centre came to lie higher than its top had been.
    """
    sim, everyone = Simulation(get_scene(scene), num_trials), np.arange(num_trials)
    poses = np.zeros((num_trials, len(sim.scene.bodies), 7))
    poses[..., 3] = 1.0
    for i, body in enumerate(sim.scene.bodies):
        poses[:, i, :3] = [-0.12, 0.16 * i - 0.40, BODIES[body].size[2] / 2]
    poses[:, sim.scene.bodies.index(obj), :2] = PLACE
    sim.place(everyone, poses)
    sim.send_arm_home(everyone)
    rng, top, closed = np.random.default_rng(seed), BODIES[obj].size[2], np.zeros(num_trials, bool)
    xy, yaw = PLACE + rng.uniform(-MAX_BESIDE, MAX_BESIDE, (num_trials, 2)), rng.uniform(0, np.pi, num_trials)
    move_hand(sim, np.column_stack([xy, np.full(num_trials, top + FINGERTIP_REACH + ABOVE)]), yaw, closed)
    target = np.column_stack([xy, np.full(num_trials, top + FINGERTIP_REACH - BELOW), yaw])
    grasped, outwards = np.zeros(num_trials, int), np.zeros(num_trials, int)
    for _ in range(NUM_STEPS):
        sim.step(hand_action(sim, target, closed), everyone)
        grasped += sim.is_grasped(obj)
        outwards += sim.is_grasped(obj) & is_outwards(sim, obj)
    return grasped, outwards, sim.body_pose(obj)[:, 2] > top


def is_outwards(sim: Simulation, obj: str) -> np.ndarray:
    """Whether the object presses each finger away from the other one (n,)."""
    closing_axis = sim.end_effector()[1][:, :, 1]
    found = np.ones(len(closing_axis), bool)
    for side, sign in (("left", -1), ("right", 1)):
        force = sim.force(grasp_sensor(side, obj))
        strength = np.linalg.norm(force, axis=1)
        along = sign * (force * closing_axis).sum(1)
        found &= (strength >= GRASP_MIN_FORCE_N) & (along >= np.cos(GRASP_MAX_ANGLE_RAD) * strength)
    return found


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["kitchen_2x2", "playroom_2x2"], help="default: both 2x2")
    parser.add_argument("--trials", type=int, default=32, help="of each object; default: 32")
    args = parser.parse_args()
    if args.trials < 1:
        parser.error(f"--trials must be at least 1, got {args.trials}")
    register_third_party_plugins()
    table = Table(
        "scene", "object", "steps with a grasp", "with both fingers outwards", "best level return", "lifted"
    )
    for scene in args.scenes:
        try:
            objects = get_scene(scene).objects
        except ValueError as error:
            parser.error(str(error))
        for obj in objects:
            grasped, outwards, lifted = press(scene, obj, args.trials)
            steps = f"{grasped.sum()} of {args.trials * NUM_STEPS}"
            best = f"{GRASP_REWARD * grasped.max():.1f} of {GRASP_REWARD * NUM_STEPS}"
            table.add_row(scene, obj, steps, str(outwards.sum()), best, str(lifted.sum()))
    Console().print(table)


if __name__ == "__main__":
    main()
