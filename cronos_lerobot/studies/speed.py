"""Steps per second of everything a training run pays for, from one process on one machine.

    python -m cronos_lerobot.studies.speed [--num_envs 64] [--seconds 8] [--skip train]

Ratios against the pure-physics bound of the same run compare across machines; absolute numbers do not. To compare
versions of the physics, give the bound of the other one, measured in the same minutes, as --reference.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv, get_scene
from lerobot_env_cronos.benchmark.command_line import find_scene
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.simulation.rendering import RENDERERS
from lerobot_env_cronos.simulation.simulation import Simulation

PARTS = ("state", "pixels", "expert", "inference", "train")
TRAININGS = {"state": "state", "frozen": "pixels, frozen encoder", "all": "pixels, all layers"}
"""What `cronos-train` is timed on: the privileged state, or pixels with the encoder frozen or trained."""


def rate(step: Callable[[], int], seconds: float) -> float:
    """Units per second of `step`, which returns how many units it did; the first call is not timed."""
    step()
    start, done = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - start) < seconds:
        done += step()
    return done / elapsed


def recorded_actions(num_envs: int, scene: str, steps: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Expert actions (steps, n, 7) for the training cycle, and the poses (n, bodies, 7) they start from."""
    env = CronosVectorEnv(num_envs, scene, obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    env.set_task(np.arange(num_envs), [env.scene.tasks[i % len(env.scene.tasks)] for i in range(num_envs)])
    poses = env.simulation.body_poses().copy()
    expert = ScriptedExpert(env)
    expert.reset(np.arange(num_envs))
    actions = []
    for _ in range(steps):
        actions.append(expert.act())
        env.step(actions[-1])
    return np.stack(actions), poses


def physics_rate(num_envs: int, scene: str, seconds: float) -> float:
    """Control steps per second of the simulation alone: no observation, no reward."""
    actions, poses = recorded_actions(num_envs, scene)
    simulation = Simulation(get_scene(scene), num_envs)
    ids = np.arange(num_envs)

    def segment() -> int:
        simulation.place(ids, poses)
        for a in actions:
            simulation.step(a, ids)
        return num_envs * len(actions)

    return rate(segment, seconds)


def env_rate(num_envs: int, scene: str, obs_type: str, renderer: str, seconds: float) -> float:
    """Control steps per second of the environment, observation and reward included."""
    actions, poses = recorded_actions(num_envs, scene)
    env = CronosVectorEnv(num_envs, scene, obs_type=obs_type, renderer=renderer)
    ids = np.arange(num_envs)

    def segment() -> int:
        env.place_bodies(ids, poses)
        for a in actions:
            env.step(a)
        return num_envs * len(actions)

    try:
        return rate(segment, seconds)
    finally:
        env.close()


def expert_rate(num_envs: int, scene: str, seconds: float) -> float:
    """Control steps per second that the scripted expert can decide."""
    env = CronosVectorEnv(num_envs, scene, obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    expert = ScriptedExpert(env)

    def step() -> int:
        expert.act()
        return num_envs

    return rate(step, seconds)


def inference_rate(num_envs: int, scene: str, seconds: float) -> float:
    """Observations per second that a fresh image PocketVLA turns into actions, preprocessing included."""
    import torch
    from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors

    from cronos_lerobot.agents.processing import make_processors, observation_columns

    env_config = CronosEnvConfig(scene=scene)
    policy_config = make_policy_config("pocketvla", device="cpu", push_to_hub=False)
    policy: Any = make_policy(policy_config, env_cfg=env_config).eval()
    processors = make_processors(policy, *make_pre_post_processors(policy_config))
    env = CronosVectorEnv(num_envs, scene, **env_config.gym_kwargs)
    columns, instructions = observation_columns(env.observe()), env.instructions
    env.close()

    def step() -> int:
        with torch.inference_mode():
            sample = policy.sample_actions(processors.batch(columns, instructions))
            processors.physical_actions(sample["actions"][:, 0])
        return num_envs

    return rate(step, seconds)


def train_rate(
    num_envs: int, scene: str, record_streams: str, training: str, updates: int, torch_threads: int
) -> dict[str, float]:
    """Interaction steps per second of `cronos-train`: mean and standard deviation over updates, shares of time.

    Args:
        num_envs: streams.
        scene: its name.
        record_streams: how many of them are recorded.
        training: one of TRAININGS.
        updates: that are timed, after one that is not: it pays for what is built lazily.
        torch_threads: of PyTorch.
    """
    from lerobot.policies import make_policy_config

    from cronos_lerobot.agents.ppo.config import PPOConfig
    from cronos_lerobot.protocol.config import ProtocolConfig
    from cronos_lerobot.scripts.train import train
    from cronos_lerobot.training.config import CronosTrainConfig
    from cronos_lerobot.training.record_config import RecordConfig

    env, options = CronosEnvConfig(scene=scene, obs_type="environment_state_agent_pos"), {}
    if training != "state":
        env = CronosEnvConfig(scene=scene, privileged_state=True)
        options = {"critic_observation": "environment_state", "freeze_encoder": training == "frozen"}
    with tempfile.TemporaryDirectory() as folder:
        config = CronosTrainConfig(
            env=env,
            policy=make_policy_config("pocketvla", device="cpu", push_to_hub=False, **options),
            output_dir=Path(folder) / "run",
            steps=(1 + updates) * 160 * num_envs,
            num_envs=num_envs,
            protocol=ProtocolConfig(),
            algorithm=PPOConfig(value_warmup_updates=0),
            record=RecordConfig(repo_id="benchmark/streams", streams=record_streams)
            if record_streams != "0"
            else RecordConfig(),
            eval_freq=0,
            save_checkpoint=False,
            tensorboard=False,
            torch_threads=torch_threads,
        )
        train(config)
        lines = [json.loads(line) for line in (Path(folder) / "run/metrics.jsonl").read_text().splitlines()]
    rows = [line for line in lines if line["kind"] == "update"][1:]
    shares = {
        f"share {k}": float(np.mean([row["time_share"].get(k, 0) for row in rows])) for k in rows[0]["time_share"]
    }
    speeds = [row["steps_per_s"] for row in rows]
    return {"steps/s": float(np.mean(speeds)), "std": float(np.std(speeds))} | shares


def main() -> None:
    """Print one line per part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="kitchen_2x2")
    parser.add_argument("--renderer", default="classic", choices=RENDERERS, help="of `pixels`")
    parser.add_argument("--num_envs", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=8.0, help="time spent on each part [s]")
    parser.add_argument("--skip", nargs="*", default=[], choices=PARTS)
    parser.add_argument("--record_streams", nargs="*", default=["0", "all"], help="streams recorded in `train`")
    parser.add_argument("--trainings", nargs="*", default=list(TRAININGS), choices=TRAININGS, help="of `train`")
    parser.add_argument("--updates", type=int, default=2, help="policy updates that are timed in `train`")
    parser.add_argument(
        "--torch_threads", type=int, default=os.cpu_count() or 1, help="in `train`; the cores by default"
    )
    parser.add_argument("--reference", type=float, help="another bound [steps/s], for one more ratio in `train`")
    args = parser.parse_args()
    register_third_party_plugins()
    find_scene(parser, args.scene)
    print(f"{args.num_envs} streams of {args.scene}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    bound = physics_rate(args.num_envs, args.scene, args.seconds)
    print(f"{'pure physics (bound)':28s} {bound:8.0f} steps/s  1.00")
    for name, obs_type in (("state", "environment_state_agent_pos"), ("pixels", "pixels_agent_pos")):
        if name not in args.skip:
            speed = env_rate(args.num_envs, args.scene, obs_type, args.renderer, args.seconds)
            print(f"{'environment, ' + name:28s} {speed:8.0f} steps/s  {speed / bound:.2f}")
    if "expert" not in args.skip:
        speed = expert_rate(args.num_envs, args.scene, args.seconds)
        print(f"{'scripted expert':28s} {speed:8.0f} steps/s  {speed / bound:.2f}")
    if "inference" not in args.skip:
        speed = inference_rate(args.num_envs, args.scene, args.seconds)
        ms = 1000 * args.num_envs / speed
        print(f"{'PocketVLA from pixels':28s} {speed:8.0f} steps/s  {speed / bound:.2f}  ({ms:.0f} ms a batch)")
    for streams in [] if "train" in args.skip else args.record_streams:
        for training in args.trainings:
            result = train_rate(args.num_envs, args.scene, streams, training, args.updates, args.torch_threads)
            shares = ", ".join(f"{k[6:]} {v:.0%}" for k, v in result.items() if k.startswith("share"))
            name = f"cronos-train, {TRAININGS[training]}, {streams} recorded"
            speed = f"{result['steps/s']:8.0f} +- {result['std']:.0f} steps/s"
            ratios = f"{result['steps/s'] / bound:.2f}"
            if args.reference:
                ratios += f"  {result['steps/s'] / args.reference:.2f} of the reference"
            print(f"{name:52s} {speed}  {ratios}  ({shares})")


if __name__ == "__main__":
    main()
