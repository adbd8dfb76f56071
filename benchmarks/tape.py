"""Print hashes of what the scenes of an arm do, bit for bit: run it before and after a change, and compare.

    python benchmarks/tape.py [--scenes kitchen_2x2 ...] > before.txt

The hashes differ between machines, for the last bits of a sum do.
"""

import argparse
import hashlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_env_cronos import CronosVectorEnv, ScriptedExpert, get_scene, load_benchmark
from lerobot_env_cronos.scene.model import build_model

SCENES = ("kitchen_2x2", "kitchen_3x3", "playroom_2x2")
NUM_ENVS, STEPS = 6, 200


class Tape:
    """A running hash of arrays."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()

    def add(self, value: Any) -> None:
        """Take in an array, or a dict of them by the order of its keys."""
        if isinstance(value, dict):
            for key in sorted(value):
                self._digest.update(key.encode())
                self.add(value[key])
        else:
            array = np.ascontiguousarray(value)
            self._digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())

    def text(self) -> str:
        """What was taken in, in 16 characters."""
        return self._digest.hexdigest()[:16]


def model_hash(scene: str, looks: bool) -> str:
    """Of every array of the compiled model."""
    import mujoco  # after this package, which chooses OpenGL's platform

    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/model.mjb"
        mujoco.mj_saveModel(build_model(get_scene(scene), looks=looks), path)
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]


def rollout_hash(scene: str, actor: str) -> str:
    """Of a rollout with every intervention in it; `actor` is `random` or `expert`."""
    env = CronosVectorEnv(NUM_ENVS, scene, obs_type="environment_state_agent_pos", task_observation="one_hot")
    tape, rng, ids = Tape(), np.random.default_rng(1), np.arange(NUM_ENVS)
    tape.add(env.reset(seed=3)[0])
    expert, space = ScriptedExpert(env), env.single_action_space
    tasks = env.tasks + env.reset_tasks
    for step in range(STEPS):
        if step % 50 == 0:
            env.set_task(ids, [tasks[(i + step // 50) % len(tasks)] for i in ids])
        actions = (
            expert.act() if actor == "expert" else rng.uniform(space.low, space.high, (NUM_ENVS, len(space.low)))
        )
        if step == 60:
            env.end_effector_reset(ids[::2])
        if step in (90, 130):
            env.put_back(1, step % len(env.scene.bodies), rng)
        if step == 110:
            state = env.get_state()
            tape.add(state)
            env.step(actions)
            env.set_state(state)
        if step == 150:
            env.scene_reset(ids[:2], np.array([5, 7]), "held_out")
        observation, reward, _, _, info = env.step(actions)
        for value in (actions, observation, reward, info, env.unsuitable_bodies(), env.simulation.sensordata):
            tape.add(value)
        tape.add(env.simulation.qpos)
    tape.add(env.get_state())
    return tape.text()


def frames_hash(scene: str) -> str:
    """Of pictures of a few starts from every camera."""
    tape = Tape()
    for camera in ("front", "bridge"):
        tape.add(CronosVectorEnv(2, scene, camera_name=camera).observe())
    return tape.text()


def main() -> None:
    """Print one line for each hash."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", nargs="*", default=SCENES)
    for scene in parser.parse_args().scenes:
        print(scene, "benchmark", load_benchmark(None, scene).fingerprint)
        print(scene, "model", model_hash(scene, False), model_hash(scene, True))
        for actor in ("random", "expert"):
            print(scene, actor, rollout_hash(scene, actor))
        print(scene, "frames", frames_hash(scene), flush=True)


if __name__ == "__main__":
    main()
