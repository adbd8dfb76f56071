"""An agent that keeps NumPy's numbers and arrays is resumed bit for bit, or refused before the run begins."""

from collections import deque

import numpy as np
import pytest
from runs import STEPS_PER_UPDATE, assert_same_run, config, make_trainer, resumed, train

from cronos_lerobot.agents.ppo.agent import PPOAgent, make_ppo_agent
from cronos_lerobot.agents.registry import AGENTS


class MeanAgent(PPOAgent):
    """Says a running mean of its rewards, in float32 as they are."""

    mean, rewards = np.float32(0), np.zeros(0, np.float32)

    def store(self, o_t, tau, a_t, r_t, o_tp1, cut_t, diverged_t):
        super().store(o_t, tau, a_t, r_t, o_tp1, cut_t, diverged_t)
        self.rewards = np.append(self.rewards, a_t.action[:, 0].mean()).astype(np.float32)[-5:]
        self.mean = np.float32(0.9) * self.mean + np.float32(0.1) * self.rewards.mean()

    def update(self):
        return super().update() | {"mean": float(self.mean)}

    def state_dict(self):
        return super().state_dict() | {"own": {"mean": self.mean, "rewards": self.rewards}}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.mean, self.rewards = state["own"]["mean"], state["own"]["rewards"]


class LastAgent(PPOAgent):
    def state_dict(self):
        return super().state_dict() | {"last": deque([1.0], maxlen=5)}


def use(kind, monkeypatch):
    def make(context):
        agent = make_ppo_agent(context)
        agent.__class__ = kind
        return agent

    monkeypatch.setitem(AGENTS, "ppo", make)


def test_a_run_that_goes_on_is_the_unbroken_one(tmp_path, monkeypatch):
    use(MeanAgent, monkeypatch)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    end = train(config(whole, eval_freq=0)).run.agent
    train(config(broken, 2 * STEPS_PER_UPDATE, eval_freq=0))
    again = train(resumed(broken, eval_freq=0)).run.agent
    assert_same_run(whole, broken)
    assert again.mean == end.mean != 0
    assert type(again.mean) is np.float32
    assert again.rewards.tolist() == end.rewards.tolist()


def test_what_no_checkpoint_holds_is_refused_before_the_run(tmp_path, monkeypatch):
    use(LastAgent, monkeypatch)
    with pytest.raises(ValueError, match="LastAgent"):
        make_trainer(config(tmp_path))
