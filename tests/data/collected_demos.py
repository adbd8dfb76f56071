"""Demonstrations collected for a test, and what is looked at in them."""

import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot_env_cronos.config import CronosEnvConfig
from lerobot_env_cronos.expert.expert import ScriptedExpert
from lerobot_env_cronos.scene.arms.widowx.geometry import HOME_QPOS

from cronos_lerobot.data.demos import DemoCollector, DemoConfig
from cronos_lerobot.data.schema import demonstration_features
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig


def collect(env, root, config: DemoConfig, num_episodes=4, *, seed=0, tasks=None, expert=None):
    features = demonstration_features(env)
    with SegmentWriter("me/demos", root, features, 5) as writer:
        collector = DemoCollector(env, expert or ScriptedExpert(env), writer, config, seed=seed, tasks=tasks)
        collector.collect(num_episodes)
    return LeRobotDataset("me/demos", root=root), collector


def episodes_of(dataset):
    rows = dataset.hf_dataset.with_format("numpy")[:]
    for episode in range(dataset.num_episodes):
        mine = rows["episode_index"] == episode
        yield {key: column[mine] for key, column in rows.items()}


class Spy:
    """An expert whose actions, and the actions executed, are kept."""

    def __init__(self, env, monkeypatch):
        self.env, self.expert = env, ScriptedExpert(env)
        self.labels, self.seen, self.executed = [], [], []
        step = env.step

        def spy(actions):
            self.executed.append(np.array(actions))
            return step(actions)

        monkeypatch.setattr(env, "step", spy)

    def reset(self, ids):
        self.expert.reset(ids)

    def act(self):
        self.seen.append(self.env.observe()["agent_pos"])
        self.labels.append(self.expert.act().astype(np.float32))
        return self.labels[-1]


def home_position(env):
    env.scene_reset(np.array([0]), np.array([0]))
    np.testing.assert_array_equal(env.simulation.qpos[0, :6], HOME_QPOS)
    return env.simulation.end_effector()[0][0]


def command(root, num_episodes, **options) -> RecordDemosConfig:
    flags = {key: options.pop(key) for key in ("video", "overwrite") if key in options}
    dataset = DemoDatasetConfig("me/demos", root, num_episodes, **flags)
    environment = CronosEnvConfig(observation_height=64, observation_width=64)
    return RecordDemosConfig(env=environment, dataset=dataset, num_envs=2, **options)
