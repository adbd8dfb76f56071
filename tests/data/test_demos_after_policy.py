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

from cronos_lerobot.data.demos import DemoConfig, ExpertError, StartConfig
from cronos_lerobot.data.origin import read_origin
from cronos_lerobot.evaluation.policy_source import files_fingerprint
from cronos_lerobot.scripts import record_demos as recording
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

    def forget(self, ids):
        self.forgotten += [(len(self.executed), stream) for stream in ids.tolist()]

    def choose(self, o_t, tau):
        assert len(o_t["agent_pos"]) == len(tau)
        self.told.append((len(self.executed), list(tau)))
        return np.tile(self.action, (len(tau), 1))


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
    with pytest.raises(
        ExpertError, match=r"had left the task complete or the .* failed 5 times in a row, last 'put"
    ):
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


def test_a_policy_that_begins_is_one_that_is_given(env, tmp_path):
    with pytest.raises(ValueError, match=r"start\.policy does any tasks before: start\.occupied_receptacles"):
        StartConfig(policy="me/policy", occupied_receptacles=True)
    with pytest.raises(ValueError, match=r"start\.policy is None, and the policy that was given is <"):
        collect(env, tmp_path / "d", DemoConfig(), policy=Drifter())


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
    with pytest.raises(ValueError, match=f"after the policy {origin.start_policy}, not after "):
        record_demos(more)
    with pytest.raises(ValueError, match=r"the policy takes observation\.environment_state, which the env"):
        record_demos(pixels)
    assert not (tmp_path / "pixels").exists()
    with pytest.raises(ValueError, match="is neither a folder nor <owner>/<repository> on the Hub"):
        record_demos(command(tmp_path / "p", 1, start=StartConfig(policy="no such/policy at all")))


def test_the_last_checkpoint_is_looked_up_once(tmp_path, monkeypatch):
    checkpoints = tmp_path / "checkpoints"
    for name in ("10", "20"):
        torch.manual_seed(int(name))
        save_policy(checkpoints / name, "pocketvla", STATE)
    last = checkpoints / "last"
    last.symlink_to("10")

    def the_run_goes_on(*args, load=recording.load_spectator):
        policy = load(*args)
        last.unlink()
        last.symlink_to("20")
        return policy

    monkeypatch.setattr(recording, "load_spectator", the_run_goes_on)
    config = command(tmp_path / "d", 1, start=StartConfig(policy=str(last)))
    config.env = CronosEnvConfig(**STATE)
    record_demos(config)
    dataset = LeRobotDataset("me/d", root=tmp_path / "d")
    begun_with = read_origin(tmp_path / "d", dataset.meta.features, "it").start_policy
    assert begun_with == files_fingerprint(checkpoints / "10") != files_fingerprint(checkpoints / "20")
