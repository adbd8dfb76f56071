"""Your own simulator as a reset-free world, to copy: a finger pushes a puck along a rail (see docs/extend.md)."""

import hashlib
from collections import namedtuple
from dataclasses import dataclass

import mujoco
import numpy as np
from gymnasium.spaces import Box, Dict
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

MJCF = """<mujoco> <option timestep="0.005"> <flag warmstart="disable"/> </option> <worldbody>
  <camera name="top" pos="0 0 0.7" fovy="45"/> <geom type="plane" size="0.4 0.4 0.01" rgba="0.9 0.9 0.9 1"/>
  <site type="box" size="0.002 0.1 0.01" pos="-0.15 0 0"/> <site type="box" size="0.002 0.1 0.01" pos="0.15 0 0"/>
  <body pos="0 0 0.03"> <geom size="0.02" mass="0.2" rgba="0.9 0.3 0.2 1"/>
    <joint name="x" type="slide" axis="1 0 0" range="-0.3 0.3" limited="true"/>
    <joint name="y" type="slide" axis="0 1 0" range="-0.2 0.2" limited="true"/> </body>
  <body pos="0 0 0.03"> <geom type="cylinder" size="0.04 0.02" mass="0.1" rgba="0.2 0.4 0.8 1"/>
    <joint name="puck" type="slide" axis="1 0 0" range="-0.2 0.2" limited="true" damping="2"/> </body>
</worldbody> <actuator> <velocity joint="x" kv="10"/> <velocity joint="y" kv="10"/> </actuator> </mujoco>"""
FPS, SUBSTEPS, SPEED, GOAL = 20, 10, 0.5, 0.15
STARTS = np.random.default_rng(0).uniform((-0.25, -0.18, -0.18), (0.25, -0.08, 0.18), (128, 3))
SPLITS = {"train": STARTS[:64], "held_out": STARTS[64:]}

Task = namedtuple("Task", "instruction side")
Identity = namedtuple("Identity", "id fingerprint source")


class PointMass:
    """N tables that live on: `step` resets none. The loop that calls `scene_reset` counts its calls."""

    fps, robot_type, reset_tasks = FPS, "point_mass", ()
    tasks = (Task("push the puck to the left", -1), Task("push the puck to the right", 1))
    identity = Identity("examples/point_mass-v1", hashlib.sha256(STARTS.tobytes()).hexdigest(), "64 + 64, seed 0")
    single_action_space = Box(-1, 1, (2,))
    single_observation_space = Dict(agent_pos=Box(-1, 1, (2,)), environment_state=Box(-1, 1, (1,)))

    def __init__(self, num_envs):
        self.num_envs, self.state_names, self.action_names = num_envs, ["x", "y"], ["vx", "vy"]
        self.num_starts = {split: len(starts) for split, starts in SPLITS.items()}
        self._model, self._renderer = mujoco.MjModel.from_xml_string(MJCF), None
        self._data = mujoco.MjData(self._model)
        self._qpos, self._qvel = np.zeros((2, num_envs, 3))
        self._sides = np.full(num_envs, self.tasks[0].side)

    def set_task(self, ids, tasks):
        """Give the streams `ids` their tasks; nothing moves."""
        self._sides[ids] = [task.side for task in tasks]

    def observe(self, ids=None):
        """The robot is `agent_pos`, the rest `environment_state`; the loop tells the policy the instruction."""
        qpos = self._qpos[slice(None) if ids is None else ids].astype(np.float32)
        return {"agent_pos": qpos[:, :2], "environment_state": qpos[:, 2:]}

    def step(self, actions):
        """Move the fingers at `actions` (N, 2) [0.5 m/s]; the reward is how far the task has come by it."""
        before, executed = self._progress(), np.clip(actions, -1, 1).astype(np.float32)
        for i, action in enumerate(executed):
            self._data.qpos, self._data.qvel, self._data.ctrl = self._qpos[i], self._qvel[i], SPEED * action
            mujoco.mj_step(self._model, self._data, SUBSTEPS)
            self._qpos[i], self._qvel[i] = self._data.qpos, self._data.qvel
        never = np.zeros(self.num_envs, np.bool_)
        info = {"is_success": self._succeeds(), "diverged": never, "executed_action": executed}
        return self.observe(), self._progress() - before, never, never.copy(), info

    def scene_reset(self, ids, starts, split="train"):
        """Put the streams `ids` (k,) into the starts number `starts` (k,) of a split."""
        self._qpos[ids], self._qvel[ids] = SPLITS[split][starts], 0

    def close(self):
        """Free the renderer."""
        self._renderer = None

    def _succeeds(self):
        return self._sides * self._qpos[:, 2] >= GOAL

    def _progress(self):
        x, y, puck = self._qpos.T
        from_behind = np.hypot(x - (puck - 0.07 * self._sides), y)
        return 2 * self._sides * puck - from_behind + self._succeeds()

    def render_streams(self, ids):
        """Frames (k, 240, 320, 3) uint8. Optional, for videos."""
        self._renderer, frames = self._renderer or mujoco.Renderer(self._model), []
        for i in ids:
            self._data.qpos = self._qpos[i]
            mujoco.mj_forward(self._model, self._data)
            self._renderer.update_scene(self._data, "top")
            frames.append(self._renderer.render())
        return np.stack(frames)

    def get_state(self):
        """Everything that decides what steps do, as arrays (N, ...). Optional: runs then resume bit for bit."""
        return {"qpos": self._qpos.copy(), "qvel": self._qvel.copy(), "sides": self._sides.copy()}

    def set_state(self, state):
        """Continue from `get_state`."""
        self._qpos[:], self._qvel[:], self._sides[:] = state["qpos"], state["qvel"], state["sides"]


@EnvConfig.register_subclass("point_mass")
@dataclass
class PointMassConfig(EnvConfig):
    """`--env.type=point_mass`. It declares what a policy sees, as LeRobot's own environments do."""

    fps: int = FPS
    steps_per_task = 40
    gym_kwargs = None

    def __post_init__(self):
        sizes = {ACTION: ("ACTION", 2), "agent_pos": ("STATE", 2), "environment_state": ("ENV", 1)}
        self.features = {name: PolicyFeature(FeatureType[kind], (n,)) for name, (kind, n) in sizes.items()}
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}

    def create_streams(self, num_envs):
        """The world that the commands run in."""
        return PointMass(num_envs)
