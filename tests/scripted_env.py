"""Chains whose outcomes are known beforehand, for exact tests of the sequential suite."""

import numpy as np
from lerobot_env_cronos import SequentialVectorEnv, get_scene

TASKS = get_scene("kitchen_2x2").tasks


class ScriptedEnv(SequentialVectorEnv):
    """No physics: task j of chain i is complete `script[i][j]` steps after it begins, or never (None)."""

    def __init__(self, script, diverge_at=(), **kwargs):
        self.script, self.diverge_at, self.homed, self.clock, self.stepped = script, diverge_at, [], 0, []
        super().__init__(len(script), ordering=TASKS, obs_type="environment_state_agent_pos", **kwargs)

    def step_streams(self, actions, ids):
        self.clock += 1
        self.stepped.append(ids.tolist())
        due = [self.script[i][TASKS.index(self.current_tasks[i])] for i in range(self.num_envs)]
        # Held for this one step only: that is enough, whatever happens to the object afterwards.
        self.is_success = np.array([when == n + 1 for when, n in zip(due, self._elapsed, strict=True)])
        diverged = np.array([(self.clock, i) in self.diverge_at for i in range(self.num_envs)])
        return np.zeros(self.num_envs, np.float32), diverged

    def end_effector_reset(self, ids):
        self.homed.append((self.clock, list(ids)))
