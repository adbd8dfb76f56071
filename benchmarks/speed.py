"""Steps per second of what a training run pays for, and their ratios to the physics alone.

    python benchmarks/speed.py [--num_envs=64] [--seconds=8] [--parts physics state pixels inference train]

All parts are measured in one run, on one machine. Compare the ratios between machines; absolute numbers depend on
the machine and on its load.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_env_cronos import CronosVectorEnv, ScriptedExpert, get_scene
from lerobot_env_cronos.simulation.rendering import RENDERERS
from lerobot_env_cronos.simulation.simulation import Simulation

PARTS = ("physics", "state", "pixels", "expert", "inference", "train")
STATE = "environment_state_agent_pos"
TRAININGS = {
    "state": (f"--env.obs_type={STATE}",),
    "pixels, frozen encoder": (),
    "pixels, all layers": ("--policy.freeze_encoder=false",),
}
"""What `cronos-train` is timed on, and its flags."""


def rate(step: Callable[[], int], seconds: float) -> float:
    """Units per second of `step`, which returns how many units it did; the first call is not timed."""
    step()
    start, done = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - start) < seconds:
        done += step()
    return done / elapsed


def expert_actions(num_envs: int, scene: str, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The expert's actions (steps, n, 7) for the training cycle, and the poses (n, bodies, 7) they start from."""
    env = CronosVectorEnv(num_envs, scene, obs_type=STATE)
    env.reset(seed=0)
    env.set_task(np.arange(num_envs), [env.scene.tasks[i % len(env.scene.tasks)] for i in range(num_envs)])
    poses, expert, actions = env.simulation.body_poses().copy(), ScriptedExpert(env), []
    for _ in range(steps):
        actions.append(expert.act())
        env.step(actions[-1])
    return np.stack(actions), poses


def physics_rate(actions: np.ndarray, poses: np.ndarray, scene: str, seconds: float) -> float:
    """Control steps per second of the simulation alone: no observation, no reward."""
    simulation, ids = Simulation(get_scene(scene), len(poses)), np.arange(len(poses))

    def segment() -> int:
        simulation.place(ids, poses)
        for action in actions:
            simulation.step(action, ids)
        return actions.shape[0] * actions.shape[1]

    return rate(segment, seconds)


def env_rate(actions: np.ndarray, poses: np.ndarray, env: CronosVectorEnv, seconds: float) -> float:
    """Control steps per second of the environment, observation and reward included."""
    ids = np.arange(len(poses))

    def segment() -> int:
        env.place_bodies(ids, poses)
        for action in actions:
            env.step(action)
        return actions.shape[0] * actions.shape[1]

    return rate(segment, seconds)


def expert_rate(num_envs: int, scene: str, seconds: float) -> float:
    """Control steps per second that the scripted expert can decide."""
    env = CronosVectorEnv(num_envs, scene, obs_type=STATE)
    env.reset(seed=0)
    expert = ScriptedExpert(env)
    return rate(lambda: len(expert.act()), seconds)


def inference_rate(num_envs: int, scene: str, seconds: float) -> float:
    """Observations per second that a fresh image PocketVLA turns into actions, preprocessing included."""
    import torch
    from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins
    from lerobot_env_cronos import CronosEnvConfig

    from cronos_lerobot.agents.processing import make_processors, observation_columns

    register_third_party_plugins()
    policy_config = make_policy_config("pocketvla", device="cpu", push_to_hub=False)
    policy: Any = make_policy(policy_config, env_cfg=CronosEnvConfig(scene=scene)).eval()
    processors = make_processors(policy, *make_pre_post_processors(policy_config))
    env = CronosVectorEnv(num_envs, scene)
    columns, instructions = observation_columns(env.observe()), env.instructions
    env.close()

    def step() -> int:
        with torch.inference_mode():
            sample = policy.sample_actions(processors.batch(columns, instructions))
            processors.physical_actions(sample["actions"][:, 0])
        return num_envs

    return rate(step, seconds)


def train_rate(num_envs: int, scene: str, flags: tuple[str, ...], updates: int) -> tuple[float, dict[str, float]]:
    """Interaction steps per second of `cronos-train`, mean over `updates`, and its shares of time."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            Path(sys.executable).with_name("cronos-train"), "--env.type=cronos", f"--env.scene={scene}",
            "--policy.type=pocketvla", "--policy.device=cpu", "--policy.push_to_hub=false",
            f"--num_envs={num_envs}", f"--steps={(1 + updates) * 160 * num_envs}", "--eval_freq=0",
            "--save_checkpoint=false", "--tensorboard=false", "--algorithm.value_warmup_updates=0",
            f"--output_dir={folder}/run", *flags,
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        lines = [json.loads(line) for line in Path(folder, "run/metrics.jsonl").read_text().splitlines()]
    # The first update pays for what is built lazily.
    rows = [line for line in lines if line["kind"] == "update"][1:]
    shares = {
        name: float(np.mean([row["time_share"].get(name, 0) for row in rows])) for name in rows[0]["time_share"]
    }
    return float(np.mean([row["steps_per_s"] for row in rows])), shares


def main() -> None:
    """Print one line per part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="kitchen_2x2")
    parser.add_argument("--renderer", default="classic", choices=RENDERERS, help="of `pixels`")
    parser.add_argument("--num_envs", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=8.0, help="time spent on each part but `train` [s]")
    parser.add_argument("--parts", nargs="*", default=PARTS, choices=PARTS, help="`physics` is always measured")
    parser.add_argument("--steps", type=int, default=80, help="control steps of a segment")
    parser.add_argument("--updates", type=int, default=2, help="policy updates that are timed in `train`")
    args = parser.parse_args()
    print(f"{args.num_envs} streams of {args.scene}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    actions, poses = expert_actions(args.num_envs, args.scene, args.steps)
    bound = physics_rate(actions, poses, args.scene, args.seconds)

    def report(name: str, speed: float, more: str = "") -> None:
        print(f"{name:36s} {speed:8.0f} steps/s  {speed / bound:.2f}{more}", flush=True)

    report("physics", bound)
    for part, obs_type in (("state", STATE), ("pixels", "pixels_agent_pos")):
        if part in args.parts:
            env = CronosVectorEnv(args.num_envs, args.scene, obs_type=obs_type, renderer=args.renderer)
            report(f"environment, {part}", env_rate(actions, poses, env, args.seconds))
            env.close()
    if "expert" in args.parts:
        report("scripted expert", expert_rate(args.num_envs, args.scene, args.seconds))
    if "inference" in args.parts:
        report("PocketVLA from pixels", inference_rate(args.num_envs, args.scene, args.seconds))
    for name, flags in TRAININGS.items() if "train" in args.parts else ():
        speed, shares = train_rate(args.num_envs, args.scene, flags, args.updates)
        report(f"cronos-train, {name}", speed, f"  ({', '.join(f'{k} {v:.0%}' for k, v in shares.items())})")


if __name__ == "__main__":
    main()
