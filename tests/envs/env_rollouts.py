"""What the tests of the environments share: streams, and the scripted expert acting in them."""

import numpy as np
from lerobot_env_cronos import SCENES, CronosVectorEnv, ScriptedExpert
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM, from_joints

STATE = "environment_state_agent_pos"
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])
"""Of the WidowX."""
HOME = from_joints(SO101_ARM.home_qpos[None])[0]
"""Of the SO-101, which holds still where it is told to be."""
WIDOWX_SCENES = [name for name, scene in SCENES.items() if scene.arm == "widowx"]


def make(n: int, scene: str = "kitchen_2x2", **options) -> CronosVectorEnv:
    return CronosVectorEnv(n, scene, **({"obs_type": STATE} | options))


def run_expert(env: CronosVectorEnv, steps: int | None = None, expert: ScriptedExpert | None = None) -> np.ndarray:
    """Success (n,) at any of so many steps of the expert, a task's by default; it ends once all have succeeded."""
    expert, success = expert or ScriptedExpert(env), np.zeros(env.num_envs, dtype=bool)
    for _ in range(steps or env.steps_per_task):
        success |= env.step(expert.act())[-1]["is_success"]
        if success.all():
            break
    return success


def keep_still(env: CronosVectorEnv, steps: int) -> np.ndarray:
    """Success (steps, n) of doing nothing."""
    action = {"widowx": STILL, "so101": HOME}[env.scene.arm]
    return np.array([env.step(np.tile(action, (env.num_envs, 1)))[-1]["is_success"] for _ in range(steps)])
