"""Films one reset-free stream of a policy, or of the scripted expert, as MP4 and GIF.

    python -m cronos_lerobot.report.stream_video --policy.path=<checkpoint> --output=stream.mp4 --gif=stream.gif

The stream is that of training (Algorithm 1 of the paper), without the learning: the task switches every 80
steps, the arm goes home at each switch, and the scene is reset every `--scene_reset_interval` steps or never.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.simulation.simulation import ACTION_NAMES
from tqdm import tqdm

from cronos_lerobot.agents.base import ActionSample, plain_sample
from cronos_lerobot.evaluation.actors import Actor, load_actor
from cronos_lerobot.evaluation.config import SuitesConfig
from cronos_lerobot.evaluation.policy_env import (
    check_observations,
    task_observation_of,
    trained_observations,
    trained_scene,
)
from cronos_lerobot.evaluation.policy_source import find_policy
from cronos_lerobot.film.encode import write_gif, write_mp4
from cronos_lerobot.film.overlay import Status, draw_status
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import SegmentEnd, Step
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.task_orders import TASK_ORDERS, TaskSet, check_task_order, make_task_order
from cronos_lerobot.training.seeding import NamedGenerators

EXPERT = "expert"
NOTICE_STEPS = 8
"""Control steps for which an intervention stays announced."""


class Spectator:
    """An agent of Algorithm 1 that acts and never learns."""

    def seed(self, seed: int) -> None:
        """Start all randomness of its actions anew."""

    def begin_segment(self) -> None:
        """A new task begins in every stream."""

    def forget(self, ids: np.ndarray) -> None:
        """What streams `ids` (k,) see from now on has nothing to do with what they saw before."""

    def choose(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """Actions (n, 7) in physical units."""
        raise NotImplementedError

    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """See `Agent`."""
        return plain_sample(self.choose(o_t, tau))

    def store(
        self,
        o_t: dict[str, Any],
        tau: list[str],
        a_t: ActionSample,
        r_t: np.ndarray,
        o_tp1: dict[str, Any],
        cut_t: np.ndarray,
        diverged_t: np.ndarray,
    ) -> None:
        """Keep nothing, and forget what was planned where the trace is cut."""
        self.forget(np.flatnonzero(cut_t))

    def update(self) -> dict[str, float]:
        """Learn nothing."""
        return {}


class ExpertSpectator(Spectator):
    """The scripted expert."""

    def __init__(self, env: CronosVectorEnv) -> None:
        self._expert, self._everyone = ScriptedExpert(env), np.arange(env.num_envs)

    def begin_segment(self) -> None:
        """Look at the scene anew."""
        self._expert.reset(self._everyone)

    def choose(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """What the expert does in the env's state as it is now."""
        return self._expert.act()


class PolicySpectator(Spectator):
    """A policy as `cronos-eval` plays it: each stream has its own plan, which ends where the stream is cut.

    Args:
        actor: acts in all streams at once. One with a single memory for all of them forgets it for all.
    """

    def __init__(self, actor: Actor) -> None:
        self._actor = actor
        self._rng = np.random.default_rng(0)
        # How many streams there are is not known until they are seen.
        self._streams = np.arange(0)

    def seed(self, seed: int) -> None:
        """Start the sampling anew; policies without `sample_actions` draw from torch's global generators."""
        self._actor.seed(seed)
        self._rng = np.random.default_rng(seed)

    def begin_segment(self) -> None:
        """Forget action chunks and the like."""
        self.forget(self._streams)

    def forget(self, ids: np.ndarray) -> None:
        """Forget those of streams `ids`."""
        self._actor.begin(ids)

    def choose(self, o_t: dict[str, Any], tau: list[str]) -> np.ndarray:
        """The policy's actions."""
        self._streams = np.arange(len(tau))
        uniform = self._rng.random((len(tau), len(ACTION_NAMES)), dtype=np.float32)
        return self._actor.act(o_t, tau, uniform, self._streams)


def film_stream(
    env: CronosVectorEnv, agent: Spectator, protocol: ProtocolConfig, num_segments: int, seed: int = 0
) -> Iterator[np.ndarray]:
    """Yield a frame (H, W, 3) uint8 after every control step of stream 0, with the overlay.

    Args:
        env: one stream; its `render_size` is the frames'.
        agent: acts in it.
        protocol: task switches and resets; nothing is learned.
        num_segments: how long.
        seed: draws the first configuration, those of scene resets, a random task order, and the actions.
    """
    agent.seed(seed)
    rng = NamedGenerators(seed).for_numpy
    task_set = TaskSet.of(env.scene, protocol)
    loop = task_set.new_loop(env.num_envs)
    total_steps = num_segments * protocol.task_switch_interval * env.num_envs
    events = rf_mtrl(
        env, task_set.all, agent, make_task_order(protocol.task_order, rng("task_order"), task_set),
        make_resets(protocol, rng),
        protocol, loop, total_steps,
    )  # fmt: skip
    status = Status("", 0, num_segments, succeeded=False, interventions=0)
    noticed = -NOTICE_STEPS
    agent.begin_segment()
    for event in events:
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
            agent.begin_segment()


def make_spectator(
    policy_path: str, device: str = "cpu", scene: str | None = None
) -> tuple[CronosEnvConfig, PolicySpectator]:
    """Load a policy; returns the environment that it expects, and the agent that acts by it.

    It acts as in `cronos-eval`, a steered checkpoint steered, but at its own sampling temperature, if it has one.

    Args:
        policy_path: checkpoint or Hub id.
        device: of the policy.
        scene: None for the one of its training.

    Raises:
        ValueError: there is no such checkpoint, or no environment of the scene shows it what it takes.
    """
    policy_config = _read_policy(policy_path, device)
    features = policy_config.input_features or {}
    where = {"scene": scene} if scene else trained_scene(policy_config.pretrained_path)
    env_config = CronosEnvConfig(**trained_observations(features, policy_config.pretrained_path), **where)
    told = task_observation_of(features, env_config)
    env_config = dataclasses.replace(env_config, task_observation=told)
    return env_config, _spectator(policy_config, env_config)


def load_spectator(policy_path: str, env_config: CronosEnvConfig, device: str = "cpu") -> PolicySpectator:
    """Load a policy for an environment that is given; see `make_spectator`.

    Raises:
        ValueError: there is no such checkpoint, or the environment does not show it what it takes.
    """
    return _spectator(_read_policy(policy_path, device), env_config)


def _read_policy(policy_path: str, device: str) -> PreTrainedConfig:
    folder = find_policy(policy_path).folder
    policy_config = PreTrainedConfig.from_pretrained(folder)
    policy_config.pretrained_path, policy_config.device = folder, device
    return policy_config


def _spectator(policy_config: PreTrainedConfig, env_config: CronosEnvConfig) -> PolicySpectator:
    check_observations(policy_config, env_config)
    temperature = getattr(policy_config, "temperature", SuitesConfig.temperature)
    return PolicySpectator(load_actor(policy_config, env_config, temperature))


def check_order(name: str) -> None:
    """Check that a task order can do without a training, which it would be told of by `bind`.

    Raises:
        ValueError: it cannot, or there is none of that name; the sentence names those that can.
    """
    check_task_order(name)
    if _goes_by_run(name):
        valid = sorted(other for other in TASK_ORDERS if not _goes_by_run(other))
        raise ValueError(
            f"--task_order={name} goes by what it is told of a training (bind), and here nothing is trained: "
            f"choose one of {valid}"
        )


def _goes_by_run(task_order: str) -> bool:
    return hasattr(TASK_ORDERS[task_order](np.random.default_rng(0)), "bind")


def make_parser() -> argparse.ArgumentParser:
    """The flags of this command."""
    description = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(description=description, allow_abbrev=False)
    who = parser.add_mutually_exclusive_group(required=True)
    who.add_argument("--policy.path", dest="policy_path", metavar="PATH", help="checkpoint or Hub id of a policy")
    who.add_argument("--policy", choices=[EXPERT], help="the scripted expert")
    parser.add_argument("--policy.device", dest="device", default="cpu")
    parser.add_argument("--scene", help="default: that of the policy's training, or kitchen_2x2")
    parser.add_argument("--segments", type=int, default=8, help="length of the stream, 80 steps each (default: 8)")
    parser.add_argument(
        "--scene_reset_interval", type=int, help="control steps between scene resets; never if absent"
    )
    parser.add_argument(
        "--task_order", default="heuristic", help="heuristic or random, or one of your own that asks no agent"
    )
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
    if args.seed < 0:
        parser.error(f"--seed must be at least 0, got {args.seed}")
    scene = {"scene": args.scene} if args.scene else {}
    try:
        for module in args.modules:
            import_module(module)
        check_order(args.task_order)
        protocol = ProtocolConfig(
            scene_reset_interval=args.scene_reset_interval,
            end_effector_reset=not args.no_end_effector_reset,
            task_order=args.task_order,
        )
        config, agent = CronosEnvConfig(obs_type="environment_state_agent_pos", **scene), None
        if args.policy_path:
            config, agent = make_spectator(args.policy_path, args.device, args.scene)
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    env = CronosVectorEnv(1, config.scene, **config.gym_kwargs)
    try:
        stream = film_stream(env, agent or ExpertSpectator(env), protocol, args.segments, args.seed)
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
