"""Films one reset-free stream of a policy, or of the scripted expert, as MP4 and GIF.

    python -m cronos_lerobot.film.stream_video --policy.path=<checkpoint> --output=stream.mp4 --gif=stream.gif

The stream is that of training (Algorithm 1 of the paper), without the learning: the task switches every 80
steps, the arm goes home at each switch, and the scene is reset every `--scene_reset_interval` steps or never.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from tqdm import tqdm

from cronos_lerobot.evaluation.actors import ExpertActor, Spectator, load_actor
from cronos_lerobot.evaluation.config import SuitesConfig
from cronos_lerobot.evaluation.policy_env import expected_env
from cronos_lerobot.evaluation.policy_source import find_policy, load_policy_config
from cronos_lerobot.film.encode import write_gif, write_mp4
from cronos_lerobot.film.overlay import Status, draw_status
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import SegmentEnd, Step
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.task_orders import TaskSet, make_task_order
from cronos_lerobot.training.seeding import NamedGenerators

NOTICE_STEPS = 8
"""Control steps for which an intervention stays announced."""


def film_stream(
    env: CronosVectorEnv, agent: Spectator, protocol: ProtocolConfig, num_segments: int, seed: int = 0
) -> Iterator[np.ndarray]:
    """Yield a frame (H, W, 3) uint8 after every control step of stream 0, with the overlay.

    Args:
        env: one stream; its `render_size` is the frames'.
        agent: acts in it.
        protocol: task switches and resets; nothing is learned.
        num_segments: how long.
        seed: draws the first configuration, those of scene resets, and a random task order.
    """
    rng = NamedGenerators(seed).for_numpy
    task_set = TaskSet.of(env.scene, protocol)
    loop = task_set.new_loop(env.num_envs)
    order, resets = make_task_order(protocol.task_order, rng("task_order"), task_set), make_resets(protocol, rng)
    total_steps = num_segments * protocol.task_switch_interval * env.num_envs
    status = Status("", 0, num_segments, succeeded=False, interventions=0)
    noticed = -NOTICE_STEPS
    for event in rf_mtrl(env, task_set.all, agent, order, resets, protocol, loop, total_steps):
        if isinstance(event, Step):
            if event.preceded_by[0] != Intervention.NONE:
                status.notice, noticed = Intervention(event.preceded_by[0]), event.t
            elif event.t - noticed >= NOTICE_STEPS:
                status.notice = Intervention.NONE
            status.instruction = event.instructions[0]
            status.interventions = int(event.interventions[0])
            status.succeeded |= bool(event.success[0])
            yield draw_status(env.render_streams(np.array([0]))[0], status)
        elif isinstance(event, SegmentEnd):
            outcomes = [*status.outcomes, bool(event.success[0])]
            status = dataclasses.replace(status, segment=status.segment + 1, succeeded=False, outcomes=outcomes)


def open_stream(
    policy_path: str | None, device: str = "cpu", scene: str | None = None, seed: int = 0
) -> tuple[CronosVectorEnv, Spectator]:
    """Make one stream and who acts in it.

    A policy acts as in `cronos-eval`, but at its own sampling temperature, if it has one.

    Args:
        policy_path: checkpoint or Hub id; None for the scripted expert.
        device: of the policy.
        scene: None for the one of the policy's training, or kitchen_2x2.
        seed: of the policy's sampling.

    Raises:
        ValueError: there is no such checkpoint or scene, or the scene does not show what the policy takes.
    """
    if policy_path is None:
        config = CronosEnvConfig(obs_type="environment_state_agent_pos", scene=scene or "")
        env = CronosVectorEnv(1, config.scene, **config.gym_kwargs)
        return env, Spectator(ExpertActor(env), 1, seed)
    policy = load_policy_config(find_policy(policy_path).folder, [f"--device={device}"])
    config = expected_env(policy, scene)
    actor = load_actor(policy, config, getattr(policy, "temperature", SuitesConfig.temperature))
    return CronosVectorEnv(1, config.scene, **config.gym_kwargs), Spectator(actor, 1, seed)


def make_parser() -> argparse.ArgumentParser:
    """The flags of this command."""
    description = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(description=description, allow_abbrev=False)
    who = parser.add_mutually_exclusive_group(required=True)
    who.add_argument("--policy.path", dest="policy_path", metavar="PATH", help="checkpoint or Hub id of a policy")
    who.add_argument("--policy", choices=["expert"], help="the scripted expert")
    parser.add_argument("--policy.device", dest="device", default="cpu")
    parser.add_argument("--scene", help="default: that of the policy's training, or kitchen_2x2")
    parser.add_argument("--segments", type=int, default=8, help="length of the stream, 80 steps each (default: 8)")
    parser.add_argument(
        "--scene_reset_interval", type=int, help="control steps between scene resets; never if absent"
    )
    parser.add_argument("--task_order", default="heuristic", help="heuristic, random, or your own")
    parser.add_argument(
        "--discover_packages_path", "--env.discover_packages_path", "--protocol.discover_packages_path",
        dest="modules", action="append", default=[], metavar="MODULE",
        help="import a module first, which registers a scene or a task order",
    )  # fmt: skip
    parser.add_argument("--no_end_effector_reset", action="store_true", help="leave the arm where it is")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("stream.mp4"), help="the MP4 (default: stream.mp4)")
    parser.add_argument("--fps", type=int, default=20, help="frames per second; 5 is real time (default: 20)")
    parser.add_argument("--gif", type=Path, help="also write a small GIF of the first segments")
    parser.add_argument("--gif_segments", type=int, default=4, help="how many segments (default: 4)")
    return parser


def main() -> None:
    """Film a stream as the command line says."""
    parser = make_parser()
    args = parser.parse_args()
    register_third_party_plugins()
    for name in ("segments", "gif_segments", "fps"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(args, name)}")
    try:
        for module in args.modules:
            import_module(module)
        protocol = ProtocolConfig(
            scene_reset_interval=args.scene_reset_interval,
            end_effector_reset=not args.no_end_effector_reset,
            task_order=args.task_order,
        )
        env, agent = open_stream(args.policy_path, args.device, args.scene, args.seed)
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    try:
        stream = film_stream(env, agent, protocol, args.segments, args.seed)
        total = args.segments * protocol.task_switch_interval
        frames = list(tqdm(stream, total=total, unit="frame", desc="filming"))
    finally:
        env.close()
    write_mp4(args.output, frames, args.fps)
    print(f"{args.output}: {len(frames)} frames, {args.output.stat().st_size / 1e6:.1f} MB")
    if args.gif:
        size = write_gif(args.gif, frames[: args.gif_segments * protocol.task_switch_interval])
        print(f"{args.gif}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
