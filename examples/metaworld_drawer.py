"""Meta-World's drawer as a reset-free world: "open the drawer" and "close the drawer" in one scene that lives on.

    pip install 'lerobot[metaworld]'
    PYTHONPATH=examples cronos-train --env.discover_packages_path=metaworld_drawer --env.type=metaworld_drawer \
        --policy.path=<checkpoint> --output_dir=outputs/drawer

To copy it, replace `Drawer` by your Gymnasium environment, without its `reset` and `step`: they end episodes.
"""

import hashlib
from collections import namedtuple
from dataclasses import dataclass

import mujoco
import numpy as np
from gymnasium.spaces import Box, Dict
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from metaworld.envs.sawyer_drawer_open_v3 import SawyerDrawerOpenEnvV3

FPS, TRAVEL, FIRST_BAD = 80, 0.16, int(mujoco.mjtWarning.mjWARN_BADQPOS)
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
# Hand x, y, z, the cabinet's x, how far the drawer is open [m].
STARTS = np.random.default_rng(0).uniform((-0.1, 0.5, 0.2, -0.1, 0), (0.1, 0.6, 0.3, 0.1, TRAVEL), (128, 5))
SPLITS = {"train": STARTS[:64], "held_out": STARTS[64:]}

Task = namedtuple("Task", "instruction opens")
Identity = namedtuple("Identity", "id fingerprint source")


class Drawer(SawyerDrawerOpenEnvV3):
    """One scene of Meta-World."""

    def __init__(self):
        super().__init__()
        self.model.cam_pos[2] = (0.75, 0.075, 0.7)  # As LeRobot has it.
        self.model.site("goal").rgba[3] = 0  # It marks the goal of Meta-World's own task.
        self.model.mat_reflectance[:], self.model.light_castshadow[:] = 0, 0  # Ten times the pictures a second.

    def reset_mocap_welds(self):
        """Meta-World 3.0's own fails with MuJoCo 3.17: an equality constraint has 12 numbers now, not 11."""
        self.model.eq_data[:, :11] = (0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5)

    def place(self, start):
        """Put the scene into a start; returns what is seen then, as `move` does."""
        mujoco.mj_resetData(self.model, self.data)
        self.hand_init_pos, self.model.body("drawer").pos = start[:3], (start[3], 0.9, 0)
        self.data.joint("goal_slidey").qpos = -start[4]
        self._reset_hand()
        return self.look()

    def move(self, action):
        """Do one control step: 1 moves the hand's target by 1 cm, the last number closes the gripper."""
        self.set_xyz_action(action[:3])
        self.do_simulation([action[3], -action[3]], self.frame_skip)
        return self.look()

    def look(self):
        """Hand x, y, z, gripper opening, target x, y, z; handle x, y, z, how far the drawer is open [m]."""
        mujoco.mj_forward(self.model, self.data)
        hand, target = self._get_curr_obs_combined_no_goal()[:4], self.data.mocap_pos[0]
        return np.hstack((hand, target, self._get_pos_objects(), -self.data.joint("goal_slidey").qpos))


class DrawerStreams:
    """N scenes that live on: `step` resets none. The loop that calls `scene_reset` counts its calls."""

    fps, robot_type, reset_tasks = FPS, "sawyer", ()
    tasks = (Task("open the drawer", True), Task("close the drawer", False))
    identity = Identity("examples/drawer-v1", hashlib.sha256(STARTS.tobytes()).hexdigest(), "64 + 64, seed 0")
    single_action_space = Box(-1, 1, (4,))

    def __init__(self, num_envs, pixels=0):
        self.num_envs, self.pixels, self.action_names = num_envs, pixels, ["dx", "dy", "dz", "close"]
        self.state_names = ["x", "y", "z", "gripper", "target_x", "target_y", "target_z"]
        self.num_starts = {split: len(starts) for split, starts in SPLITS.items()}
        spaces = {"agent_pos": Box(-2, 2, (7,)), "environment_state": Box(-2, 2, (4,))}
        if pixels:
            spaces["pixels"] = Dict(corner2=Box(0, 255, (pixels, pixels, 3), np.uint8))
        self.single_observation_space, self._renderer = Dict(spaces), None
        self._scenes = [Drawer() for _ in range(num_envs)]
        self._all, self.opens, self.seen = np.arange(num_envs), np.full(num_envs, True), np.zeros((num_envs, 11))
        self.scene_reset(self._all, self._all % 64)

    def set_task(self, ids, tasks):
        """Give the streams `ids` their tasks; nothing moves."""
        self.opens[ids] = [task.opens for task in tasks]

    def observe(self, ids=None):
        """The robot is `agent_pos`, the rest `environment_state`; the loop tells the policy the instruction."""
        ids = self._all if ids is None else ids
        seen = self.seen[ids].astype(np.float32)
        observation = {"agent_pos": seen[:, :7], "environment_state": seen[:, 7:]}
        return observation | ({"pixels": {"corner2": self.render_streams(ids)}} if self.pixels else {})

    def step(self, actions):
        """Apply `actions` (N, 4); the reward is how far the task has come by it."""
        before, executed = self._progress(), np.clip(actions, -1, 1).astype(np.float32)
        self.seen[:] = [scene.move(action) for scene, action in zip(self._scenes, executed, strict=True)]
        diverged = np.array([scene.data.warning.number[FIRST_BAD:].any() for scene in self._scenes])
        info = {"is_success": self._succeeds(), "diverged": diverged, "executed_action": executed}
        never = np.zeros(self.num_envs, np.bool_)
        return self.observe(), self._progress() - before, never, never.copy(), info

    def scene_reset(self, ids, starts, split="train"):
        """Put the streams `ids` (k,) into the starts number `starts` (k,) of a split."""
        for i, start in zip(ids, SPLITS[split][starts], strict=True):
            self.seen[i] = self._scenes[i].place(start)

    def close(self):
        """Free the renderer."""
        if self._renderer:
            self._renderer.close()

    def _succeeds(self):
        return np.where(self.opens, self.seen[:, 10] > 0.15, self.seen[:, 10] < 0.01)

    def _progress(self):
        # The hand reaches into the handle to pull, and stands before it to push.
        hand, handle, opening = self.seen[:, :3], self.seen[:, 7:10], self.seen[:, 10] / TRAVEL
        aim = handle - np.where(self.opens[:, None], (0, 0, 0.02), (0, 0.07, 0))
        reach = np.linalg.norm(hand - aim, axis=1)
        return np.where(self.opens, opening, -opening) - 2 * reach + self._succeeds()

    # Optional: videos, and resumed runs that continue bit for bit.

    def render_streams(self, ids):
        """Frames (k, H, W, 3) uint8. One renderer serves all: what differs between scenes is in their data."""
        size, frames = self.pixels or 240, []
        self._renderer = self._renderer or mujoco.Renderer(self._scenes[0].model, size, size)
        for i in ids:
            self._renderer.update_scene(self._scenes[i].data, "corner2")
            frames.append(self._renderer.render()[::-1, ::-1])  # Meta-World's camera is upside down.
        return np.stack(frames)

    def get_state(self):
        """Everything that decides what steps do, as arrays (N, ...)."""
        physics = np.zeros((self.num_envs, mujoco.mj_stateSize(self._scenes[0].model, STATE)))
        for scene, row in zip(self._scenes, physics, strict=True):
            mujoco.mj_getState(scene.model, scene.data, row, STATE)
        cabinets = np.stack([scene.model.body("drawer").pos for scene in self._scenes])
        return {"physics": physics, "cabinets": cabinets, "opens": self.opens.copy()}

    def set_state(self, state):
        """Continue from `get_state`."""
        self.opens[:] = state["opens"]
        for scene, row, cabinet in zip(self._scenes, state["physics"], state["cabinets"], strict=True):
            mujoco.mj_setState(scene.model, scene.data, row, STATE)
            scene.model.body("drawer").pos = cabinet
        self.seen[:] = [scene.look() for scene in self._scenes]


@EnvConfig.register_subclass("metaworld_drawer")
@dataclass
class DrawerConfig(EnvConfig):
    """`--env.type=metaworld_drawer`. It declares what a policy sees, as LeRobot's own environments do."""

    fps: int = FPS
    pixels: int = 0
    """Size of a picture in the observation [px]; 0 for none."""
    steps_per_task = 150
    gym_kwargs = None

    def __post_init__(self):
        sizes = {ACTION: ("ACTION", (4,)), "agent_pos": ("STATE", (7,)), "environment_state": ("ENV", (4,))}
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
        if self.pixels:
            sizes["pixels/corner2"] = ("VISUAL", (self.pixels, self.pixels, 3))
            self.features_map["pixels/corner2"] = f"{OBS_IMAGES}.corner2"
        self.features = {name: PolicyFeature(FeatureType[kind], shape) for name, (kind, shape) in sizes.items()}

    def create_streams(self, num_envs):
        """The world that the commands run in."""
        return DrawerStreams(num_envs, self.pixels)
