"""What the tests of the environments share: streams, and the scripted expert acting in them."""

import numpy as np
from lerobot_env_cronos import CronosVectorEnv, ScriptedExpert

STATE = "environment_state_agent_pos"
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])


def make(n: int, scene: str = "kitchen_2x2", **options) -> CronosVectorEnv:
    return CronosVectorEnv(n, scene, **({"obs_type": STATE} | options))


def run_expert(env: CronosVectorEnv, steps: int = 80, expert: ScriptedExpert | None = None) -> np.ndarray:
    """Success (n,) at any of so many steps of the expert; it ends as soon as all have succeeded."""
    expert, success = expert or ScriptedExpert(env), np.zeros(env.num_envs, dtype=bool)
    for _ in range(steps):
        success |= env.step(expert.act())[-1]["is_success"]
        if success.all():
            break
    return success


def keep_still(env: CronosVectorEnv, steps: int) -> np.ndarray:
    """Success (steps, n) of doing nothing."""
    return np.array([env.step(np.tile(STILL, (env.num_envs, 1)))[-1]["is_success"] for _ in range(steps)])
