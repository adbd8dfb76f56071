"""A recorded stream into LeRobot's replay buffer and out again."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.rl.buffer import random_shift
from lerobot_env_cronos import CronosVectorEnv
from synthetic_streams import make_step

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.protocol.interventions import Intervention

K, SEGMENTS, STREAMS = 5, 4, 2
KEYS = ("observation.state", "observation.environment_state")
SWITCHES = {5: Intervention.TASK_SWITCH, 10: Intervention.END_EFFECTOR_RESET, 15: Intervention.TASK_SWITCH}


@pytest.fixture
def to_replay_buffer(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples")
    return import_module("replay_buffer").to_replay_buffer


def observed(observation):
    """A state (streams, 61) as KEYS has it."""
    return np.concatenate([observation["agent_pos"], observation["environment_state"]], axis=1)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two streams of the scene under random actions; (stream, t) -> state, action, reward, what followed."""
    root = tmp_path_factory.mktemp("recorded") / "d"
    env = CronosVectorEnv(STREAMS, obs_type="environment_state_agent_pos", num_threads=1)
    recorder = StreamRecorder.open(env, "me/stream", root, segment_length=K, flags={"seed": 0})
    rng = np.random.default_rng(0)
    everyone, tape = np.arange(STREAMS), {}
    for t in range(K * SEGMENTS):
        if SWITCHES.get(t) == Intervention.END_EFFECTOR_RESET:
            env.end_effector_reset(everyone)
        if t % K == 0:
            env.set_task(everyone, [env.scene.tasks[(t // K + i) % 4] for i in everyone])
        before = env.observe()
        action = rng.uniform(env.single_action_space.low, env.single_action_space.high, (STREAMS, 7)).astype("f")
        after, reward, _, _, info = env.step(action)
        for i in everyone:
            tape[i, t] = observed(before)[i], action[i], reward[i], observed(after)[i]
        kind = SWITCHES.get(t, Intervention.NONE) if t else Intervention.INITIAL
        step = make_step(
            t, observation=before, instructions=env.instructions, actions=action, reward=reward,
            success=info["is_success"], log_prob=np.full(STREAMS, -t / 4), value=np.zeros(STREAMS),
            preceded_by=np.full(STREAMS, kind), piece=np.full(STREAMS, t // K),
            segments_since_reset=np.full(STREAMS, t // K), cut=np.full(STREAMS, t % K == K - 1),
        )  # fmt: skip
        recorder.on_step(step)
    recorder.close()
    env.close()
    return root, tape


def rows(buffer):
    """The buffer's content: (stream, t) -> state, action, reward, successor, done, truncated."""
    info = buffer.complementary_info
    found = {}
    for row in range(len(buffer)):
        state, following = (
            torch.cat([part[key][row] for key in KEYS]) for part in (buffer.states, buffer.next_states)
        )
        place = int(info["stream_id"][row]), int(info["step"][row])
        assert place not in found
        assert info["log_prob"][row] == -place[1] / 4
        found[place] = (
            state.numpy(), buffer.actions[row].numpy(), float(buffer.rewards[row]), following.numpy(),
            bool(buffer.dones[row]), bool(buffer.truncateds[row]),
        )  # fmt: skip
    return found


def test_dones_truncations_and_successors_are_those_that_happened(recorded, to_replay_buffer):
    root, tape = recorded
    streams = StreamDataset("me/stream", root)
    found = rows(to_replay_buffer(streams, KEYS, image_augmentation_function=random_shift))
    # Frame 9 was followed by a reset of the arm, 19 is the last: what followed them is not in the data.
    assert set(found) == {(i, t) for i in range(STREAMS) for t in range(K * SEGMENTS) if t not in (9, 19)}
    for (i, t), (state, action, reward, following, done, truncated) in found.items():
        before, acted, earned, after = tape[i, t]
        np.testing.assert_array_equal(state, before)
        np.testing.assert_array_equal(action, acted)
        assert reward == earned
        np.testing.assert_array_equal(following, after, err_msg=f"stream {i}, step {t}")
        assert (done, truncated) == (False, t in (4, 14))


def test_what_no_buffer_can_hold_is_refused(recorded, to_replay_buffer):
    streams = StreamDataset("me/stream", recorded[0])
    with pytest.raises(ValueError, match=r"observation\.smell"):
        to_replay_buffer(streams, ["observation.smell"])
    with pytest.raises(ValueError, match="optimize_memory"):
        to_replay_buffer(streams, KEYS, optimize_memory=True)
