"""Demonstrations that begin where a policy has left its own streams."""

import shutil

import numpy as np
import pytest
import torch
from collected_demos import Spy, collect, command, episodes_of, home_position
from lerobot.datasets import LeRobotDataset
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.config import CronosEnvConfig
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.data.demos import DemoConfig, ExpertError, StartConfig
from cronos_lerobot.data.origin import read_origin
from cronos_lerobot.evaluation.policy_source import files_fingerprint
from cronos_lerobot.scripts.record_demos import record_demos

NUM_ENVS = 4


@pytest.fixture(scope="module")
def env():
    return CronosVectorEnv(NUM_ENVS, obs_type="environment_state_agent_pos")


class Drifter:
    """A policy that drifts a little to the left with an open gripper, whatever the task."""

    action = np.array([0, 0.004, 0, 0, 0, 0, 1], np.float32)

    def __init__(self, executed=()):
        self.executed, self.told, self.forgotten = executed, [], []

    def begin(self, ids, seeds=None):
        self.forgotten += [(len(self.executed), stream) for stream in ids.tolist()]

    def act(self, observation, instructions, ids):
        assert len(observation["agent_pos"]) == len(instructions) == len(ids)
        self.told.append((len(self.executed), list(instructions)))
        return ActionSample(np.tile(self.action, (len(ids), 1)))


def test_a_policy_does_the_earlier_tasks_in_the_experts_place(env, tmp_path, monkeypatch):
    config = DemoConfig(start=StartConfig(policy="me/drifter", earlier_tasks=3, arm_pose="either"), max_steps=60)
    spy, task = Spy(env, monkeypatch), env.scene.tasks[0]
    drifter = Drifter(spy.executed)
    dataset, _ = collect(env, tmp_path / "d", config, 8, tasks=[task], expert=spy, policy=drifter)
    executed = np.array(spy.executed)
    drifts = (executed == drifter.action).all(axis=-1)
    assert drifts.any()
    for stream in range(NUM_ENVS):
        # Each of one to three tasks to its very end, after a step at rest in which it is seen.
        edges = np.flatnonzero(np.diff(np.concatenate([[0], drifts[:, stream], [0]])))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            assert end - begin == 60
            assert (begin, stream) in drifter.forgotten
    # Never the task that is demonstrated next.
    told = {told[i] for step, told in drifter.told for i in np.flatnonzero(drifts[step])}
    assert told <= {other.instruction for other in env.scene.tasks if other != task}
    at_home = []
    for episode in episodes_of(dataset):
        assert not (episode["action"] == drifter.action).all(axis=1).any()
        assert episode["next.success"][-1]
        at_home.append(np.abs(episode["observation.state"][0, :3] - home_position(env)).max() < 0.01)
    assert 0 < sum(at_home) < 8


def test_what_the_policy_has_left_complete_is_not_demonstrated(env, tmp_path, monkeypatch):
    task, set_task, found = env.scene.tasks[0], env.set_task, []

    def complete(ids, tasks):
        set_task(ids, tasks)
        if tasks[0] == task and len(found) < often:
            env.is_success[ids] = True
            found.append(ids)

    monkeypatch.setattr(env, "set_task", complete)
    config, often = DemoConfig(start=StartConfig(policy="me/drifter"), max_steps=60), 1
    dataset, collector = collect(env, tmp_path / "d", config, 2, tasks=[task], policy=Drifter())
    assert len(found) == 1
    assert dataset.num_episodes == collector.finished == collector.successes == 2
    # A policy that always leaves it complete ends the recording.
    monkeypatch.setattr("cronos_lerobot.data.demos.MAX_FAILURES_IN_A_ROW", 5)
    found, often = [], 1000
    with pytest.raises(ExpertError, match="5 times in a row, last 'put"):
        collect(env, tmp_path / "e", config, 2, tasks=[task], policy=Drifter())


def test_a_policy_that_breaks_the_simulation_is_no_failure_of_the_expert(env, tmp_path, monkeypatch):
    drifter, step, broken = Drifter(), env.step, []

    def break_down(actions):
        *result, info = step(actions)
        drifting = np.flatnonzero((actions == drifter.action).all(axis=1))
        if len(drifting) and not broken:
            broken.append(drifting[0])
            info["diverged"] = np.arange(NUM_ENVS) == drifting[0]
        return *result, info

    monkeypatch.setattr(env, "step", break_down)
    config = DemoConfig(start=StartConfig(policy="me/drifter"), max_steps=60)
    dataset, collector = collect(env, tmp_path / "d", config, 2, policy=drifter)
    assert len(broken) == 1
    assert dataset.num_episodes == collector.finished == collector.successes == 2


def test_the_command_begins_with_a_checkpoint_that_fits(tmp_path):
    start = StartConfig(policy=str(save_policy(tmp_path / "policy", "pocketvla", STATE)))
    shown, pixels = (command(tmp_path / name, 1, start=start) for name in ("shown", "pixels"))
    shown.env, pixels.env = CronosEnvConfig(**STATE), CronosEnvConfig(obs_type="pixels_agent_pos")
    record_demos(shown)
    dataset = LeRobotDataset("me/d", root=tmp_path / "shown")
    assert dataset.num_episodes == 1
    origin = read_origin(tmp_path / "shown", dataset.meta.features, "it")
    assert origin.flags["start.policy"] == "a folder"
    assert origin.start_policy == files_fingerprint(tmp_path / "policy")
    # The same folder with other weights is another policy.
    shutil.rmtree(tmp_path / "policy")
    torch.manual_seed(1)
    save_policy(tmp_path / "policy", "pocketvla", STATE)
    more = command(tmp_path / "shown", 2, start=start, resume=True)
    more.env = shown.env
    with pytest.raises(ValueError, match="start_policy"):
        record_demos(more)
    with pytest.raises(ValueError, match=r"observation\.environment_state"):
        record_demos(pixels)
    assert not (tmp_path / "pixels").exists()
    with pytest.raises(ValueError, match="no such/policy at all"):
        record_demos(command(tmp_path / "p", 1, start=StartConfig(policy="no such/policy at all")))
