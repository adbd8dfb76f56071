"""What a policy's second task suffers from: the arm or the bodies being where the first one left them.

    python -m cronos_lerobot.studies.start_bias --policy.path=<checkpoint> [--seeds=5] [--output=bias.csv]

The paper (Section 5) blames the end effector: demonstrations begin with the arm at home, reset-free segments do
not. Here every task is done for 80 steps from every configuration, then the next task of the training cycle is
given in four ways: bodies left where they are or placed anew, arm left where it is or sent home. Bodies placed
anew with the arm sent home are a scene reset; bodies left with the arm sent home an end-effector reset.
"""

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import STEPS_PER_TASK, CronosVectorEnv, load_benchmark
from lerobot_env_cronos.simulation.simulation import NUM_ARM_JOINTS
from lerobot_env_cronos.statistics import wilson_interval
from tqdm import trange

from cronos_lerobot.report.stream_video import Spectator, make_spectator
from cronos_lerobot.scripts.errors import error_line

CONDITIONS = tuple((bodies, arm) for bodies in ("new", "left") for arm in ("home", "left"))
"""How the second task is given: (bodies, arm)."""


@dataclass(frozen=True)
class SecondTask:
    """Outcomes of the second task under one condition."""

    bodies: str
    """`new` or `left`."""
    arm: str
    """`home` or `left`."""
    success: np.ndarray
    """(num_envs,) bool."""
    complete: np.ndarray
    """(num_envs,) bool: the task was complete when it was given, so that nothing had to be done."""
    grasped: np.ndarray
    """(num_envs,) bool: the object was grasped at the start or after any step."""


def run_second_tasks(env: CronosVectorEnv, agent: Spectator, split: str, seed: int = 0) -> list[SecondTask]:
    """Run the first task of every stream once and the second under each of `CONDITIONS`.

    Stream i has the i-th pair of a task of the cycle and a configuration, tasks outer; bodies placed anew are in
    the configuration after that. An arm that is left where it is over new bodies has its gripper open; one that
    stands in a body pushes it away.

    Args:
        env: as many streams as tasks times configurations of the split, or fewer.
        agent: acts in them.
        split: whose configurations.
        seed: of the policy's sampling.
    """
    ids, tasks = np.arange(env.num_envs), env.scene.tasks
    num_configurations = len(env.benchmark.configurations[split])
    first, configuration = ids // num_configurations % len(tasks), ids % num_configurations
    env.scene_reset(ids, configuration, split=split)
    env.set_task(ids, [tasks[i] for i in first])
    agent.seed(seed)
    _run_task(env, agent, "first task")
    state = env.get_state()
    arm_qpos = env.simulation.qpos[:, :NUM_ARM_JOINTS].copy()
    outcomes = []
    for bodies, arm in CONDITIONS:
        env.set_state(state)
        if bodies == "new":
            env.scene_reset(ids, (configuration + 1) % num_configurations, split=split)
            if arm == "left":
                env.simulation.move_arm(ids, arm_qpos)
        elif arm == "home":
            env.end_effector_reset(ids)
        env.set_task(ids, [tasks[(i + 1) % len(tasks)] for i in first])
        complete = env.is_success.copy()
        agent.seed(seed)
        success, grasped = _run_task(env, agent, f"bodies {bodies}, arm {arm}")
        outcomes.append(SecondTask(bodies, arm, success, complete, grasped))
    return outcomes


def _run_task(env: CronosVectorEnv, agent: Spectator, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Act for a task's steps; returns (num_envs,) bool twice: complete at any of them, its object ever grasped."""
    agent.begin_segment()
    observation, success, grasped = env.observe(), np.zeros(env.num_envs, bool), env.is_grasped.copy()
    for _ in trange(STEPS_PER_TASK, desc=name, unit="step", leave=False, disable=None):
        observation, _, _, _, info = env.step(agent.choose(observation, env.instructions))
        agent.forget(np.flatnonzero(info["diverged"]))
        success |= info["is_success"]
        grasped |= info["is_grasped"]
    return success, grasped


def pool(repetitions: list[list[SecondTask]]) -> list[SecondTask]:
    """The outcomes of several `run_second_tasks`, condition by condition."""
    return [
        SecondTask(
            same[0].bodies,
            same[0].arm,
            np.concatenate([outcome.success for outcome in same]),
            np.concatenate([outcome.complete for outcome in same]),
            np.concatenate([outcome.grasped for outcome in same]),
        )
        for same in zip(*repetitions, strict=True)
    ]


Row = tuple[str, str, int, int, float, float, int, int]


def rows(outcomes: list[SecondTask]) -> list[Row]:
    """Bodies, arm, successes, n, 95 % interval, those left out as complete, and successes without a grasp."""
    table = []
    for outcome in outcomes:
        k, n = int(outcome.success[~outcome.complete].sum()), int((~outcome.complete).sum())
        never_grasped = int((outcome.success & ~outcome.complete & ~outcome.grasped).sum())
        apart = int(outcome.complete.sum()), never_grasped
        table.append((outcome.bodies, outcome.arm, k, n, *wilson_interval(k, n), *apart))
    return table


def main() -> None:
    """Print a row for each way of giving the second task, and write them to a CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy.path", dest="policy_path", required=True, help="checkpoint or Hub id")
    parser.add_argument("--policy.device", dest="device", default="cpu")
    parser.add_argument("--scene", help="default: that of the policy's training, or kitchen_2x2")
    parser.add_argument("--split", default="train", choices=["train", "held_out"])
    parser.add_argument(
        "--seeds", type=int, default=1, help="of the policy's sampling: all of it so often, from seeds 0, 1, ..."
    )
    parser.add_argument("--output", type=Path, help="CSV to write")
    args = parser.parse_args()
    if args.seeds < 1:
        parser.error(f"--seeds={args.seeds}: give 1 or more")
    register_third_party_plugins()
    with error_line():
        env_config, agent = make_spectator(args.policy_path, args.device, args.scene)
    benchmark = load_benchmark(env_config.benchmark, env_config.scene)
    num_envs = len(benchmark.scene.tasks) * len(benchmark.configurations[args.split])
    env = CronosVectorEnv(num_envs, env_config.scene, **env_config.gym_kwargs)
    table = rows(pool([run_second_tasks(env, agent, args.split, seed) for seed in range(args.seeds)]))
    env.close()
    print("bodies  arm   success  95 % interval    n  complete from the start (left out)  never grasped")
    for bodies, arm, k, n, low, high, complete, never in table:
        print(f"{bodies:6s}  {arm:4s}  {k / n:7.3f}  {low:.3f}-{high:.3f}  {n:>4d}  {complete:<34d}  {never}")
    if args.output is not None:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        with args.output.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(
                ["bodies", "arm", "successes", "n", "ci95_low", "ci95_high", "left_out", "never_grasped"]
            )
            writer.writerows(table)


if __name__ == "__main__":
    main()
