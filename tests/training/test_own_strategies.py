"""Task orders and reset strategies that remember something of their own: it is in the checkpoint."""

from collections import deque

import numpy as np
import pytest
from runs import STEPS_PER_UPDATE, assert_same_run, config, make_trainer, resumed, train

from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.resets import EXTRA_RESETS, SceneReset
from cronos_lerobot.protocol.task_orders import TASK_ORDERS


class CountingOrder:
    """Every stream in turn, by a count of its own that `loop` does not have."""

    def __init__(self, rng):
        self.drawn = 0

    def draw(self, loop):
        self.drawn += 1
        return (np.arange(loop.num_streams) + self.drawn * self.drawn) % loop.num_tasks

    def state_dict(self):
        return {"drawn": self.drawn}

    def load_state_dict(self, state):
        self.drawn = state["drawn"]


class EveryThirdSwitch(SceneReset):
    """One stream after the other, at every third switch that it is asked at."""

    kind = Intervention.SCENE_RESET

    def __init__(self, rng, protocol):
        super().__init__(rng, protocol.num_configurations)
        self.asked = {"of": np.zeros(4, int), "history": [1.0]}

    def due(self, env, loop):
        self.asked["of"] += np.arange(1, 5)
        self.asked["history"].append(float(self.asked["of"].sum()))
        return np.flatnonzero(self.asked["of"] % 3 == 0)

    def state_dict(self):
        return self.asked

    def load_state_dict(self, state):
        self.asked = state


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(TASK_ORDERS, "counting", CountingOrder)
    monkeypatch.setitem(EXTRA_RESETS, "every_third", EveryThirdSwitch)


PROTOCOL = ProtocolConfig(4, 8, None, task_order="counting", extra_resets=["every_third"])


def test_a_resumed_run_goes_on_with_what_they_kept(tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    whole = train(config(unbroken, protocol=PROTOCOL))
    # Eight switches, at which stream i has been counted i + 1 further; and two divergences.
    asked = sum(turn * (stream + 1) % 3 == 0 for turn in range(1, 9) for stream in range(4))
    assert whole.loop.b == asked + 2
    train(config(broken, 2 * STEPS_PER_UPDATE, protocol=PROTOCOL))
    train(resumed(broken, protocol=PROTOCOL))
    assert_same_run(unbroken, broken)


def test_what_a_checkpoint_cannot_hold_is_refused_before_the_run_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(CountingOrder, "state_dict", lambda self: {"streams": [{"seen": object()}]})
    with pytest.raises(ValueError, match="CountingOrder"):
        train(config(tmp_path, protocol=PROTOCOL))
    assert not (tmp_path / "checkpoints").exists()


def test_an_agent_that_no_checkpoint_can_hold_is_refused_before_the_run_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(PPOAgent, "state_dict", lambda self: {"last": deque([1.0])})
    with pytest.raises(ValueError, match="PPOAgent"):
        make_trainer(config(tmp_path))
