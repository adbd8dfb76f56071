"""How long a policy keeps succeeding when nobody resets the scene: success by segment since the placement.

    python -m cronos_lerobot.stream_evaluation --policy.path=<checkpoint> [--num_streams 64] [--num_segments 16]

The streams are those of training (Algorithm 1 of the paper) without learning and without a scene reset: 80 steps
a segment, tasks in the training cycle. `python -m lerobot_env_cronos.expert_ceiling` is the same for the expert.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.statistics import wilson_interval
from tqdm import tqdm

from cronos_lerobot.loop_state import SegmentEnd, Step
from cronos_lerobot.protocol import ProtocolConfig
from cronos_lerobot.report.stream_video import Spectator, make_spectator
from cronos_lerobot.resets import make_resets
from cronos_lerobot.rf_mtrl import rf_mtrl
from cronos_lerobot.task_orders import TaskSet, make_task_order


def success_by_segment(
    env: Any, agent: Spectator, protocol: ProtocolConfig, num_segments: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Run streams and return which segments were a success, and which of these had been complete from the start.

    Both are (num_segments, num_streams) bool.

    Args:
        env: the streams.
        agent: acts in them.
        protocol: task switches and resets; nothing is learned.
        num_segments: length of every stream.
        seed: draws the first configurations, those of scene resets, and a random task order.
    """
    rng = np.random.default_rng(seed)
    task_set = TaskSet.of(env.scene, protocol)
    loop = task_set.new_loop(env.num_envs)
    total_steps = num_segments * protocol.task_switch_interval * env.num_envs
    ends: list[SegmentEnd] = []
    with tqdm(total=total_steps, unit="step", unit_scale=True, disable=None) as bar:
        agent.begin_segment()
        for event in rf_mtrl(
            env, task_set.all, agent, make_task_order(protocol.task_order, rng, task_set),
            make_resets(protocol, rng), protocol, loop, total_steps,
        ):  # fmt: skip
            if isinstance(event, Step):
                bar.update(env.num_envs)
            elif isinstance(event, SegmentEnd):
                ends.append(event)
                agent.begin_segment()
    return np.stack([end.success for end in ends]), np.stack([end.found_complete for end in ends])


def main() -> None:
    """Print a row per segment, and write them to a CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy.path", dest="policy_path", required=True, help="checkpoint or Hub id")
    parser.add_argument("--policy.device", dest="device", default="cpu")
    parser.add_argument("--num_streams", type=int, default=64)
    parser.add_argument("--num_segments", type=int, default=16, help="length of a stream, 80 steps each")
    parser.add_argument("--no_end_effector_reset", action="store_true", help="leave the arm where it is")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="CSV to write")
    args = parser.parse_args()
    register_third_party_plugins()
    set_seed(args.seed)
    env_config, agent = make_spectator(args.policy_path, args.device)
    env = CronosVectorEnv(args.num_streams, env_config.scene, **env_config.gym_kwargs)
    protocol = ProtocolConfig(scene_reset_interval=None, end_effector_reset=not args.no_end_effector_reset)
    outcomes, found = success_by_segment(env, agent, protocol, args.num_segments, args.seed)
    env.close()
    rows = [
        [i, int(row.sum()), len(row), *wilson_interval(int(row.sum()), len(row)), int(already.sum())]
        for i, (row, already) in enumerate(zip(outcomes, found, strict=True))
    ]
    print("segment  success  95 % interval  n    complete from the start")
    for i, k, n, low, high, already in rows:
        print(f"{i:7d}  {k / n:7.3f}  {low:.3f}-{high:.3f}    {n:<4d} {already / n:.3f}")
    total = outcomes.size
    print(f"   mean  {outcomes.mean():7.3f}  ({int(outcomes.sum())} of {total} segments)")
    if args.output is not None:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        with args.output.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["segment", "successes", "n", "ci95_low", "ci95_high", "found_complete"])
            writer.writerows(rows)


if __name__ == "__main__":
    main()
