"""Decisions with help: PPO keeps them and learns nothing from them."""

import numpy as np
import pytest
import torch
from dummies import TASKS, DummyPolicy
from ppo_samples import flat, make_ppo, reward_for_up, rollout

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.agents.decisions import Decision
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer


def one_stream(rewards, values, boundaries, bootstrap, helped):
    buffer = RolloutBuffer(len(rewards), 1)
    for i in range(len(rewards)):
        decision = Decision(np.zeros((1, 1, 7)), np.zeros((1, 7)), np.zeros(1), np.array([values[i]]), {})
        row = (np.array([array[i]]) for array in (rewards, boundaries, bootstrap))
        buffer.add(decision, ["a"], *row, intervened=np.array([helped[i]]))
    buffer.compute_advantages(gamma=0.5, gae_lambda=0.5)
    return buffer


def test_advantages_around_a_segment_with_help_by_hand():
    # Rows: own | helped, helped | own. The middle is a segment of its own.
    # delta_0 = 1 + .5 * 6 - 2 = 2, cut; delta_3 = 0 + .5 * 8 - 1 = 3.
    buffer = one_stream([1, 5, 5, 0], [2, 70, 70, 1], [1, 0, 1, 1], [6, -9, 50, 8], [0, 1, 1, 0])
    assert buffer.advantages[[0, 3], 0].tolist() == [2, 3]
    assert buffer.returns[[0, 3], 0].tolist() == [4, 4]
    # Whatever it earned, the policy's advantages and what an update normalises them by stay as they are.
    other = one_stream([1, 0, 900, 0], [2, -7, 3, 1], [1, 0, 1, 1], [6, -9, 0, 8], [0, 1, 1, 0])
    assert other.advantages[[0, 3], 0].tolist() == [2, 3]


def test_help_inside_a_segment_cuts_the_trace_before_and_after_it():
    # Bootstrapped from V of the next row: delta_0 = 1 + .5 * 4 - 2 = 1; delta_1 = 0 + .5 * 6 - 4 = -1, cut.
    # A_0 = 1 + .25 * -1 = .75. Row 3 ends the segment: delta_3 = 0 + .5 * 8 - 1 = 3.
    buffer = one_stream([1, 0, 77, 0], [2, 4, 6, 1], [0, 0, 0, 1], [-9, -9, -9, 8], [0, 0, 1, 0])
    assert buffer.advantages[[0, 1, 3], 0].tolist() == [0.75, -1, 3]
    assert not buffer.boundaries[:3].any()


def test_an_update_is_that_of_the_policys_own_decisions_alone():
    params = []
    for rows in ("marked", "left out"):
        ppo = make_ppo(epochs=2, value_epochs=1, minibatch_size=64)
        buffer = rollout(ppo, reward_for_up)
        if rows == "marked":
            # Somebody has helped the odd streams.
            buffer.intervened[:, 1::2] = True
            buffer.rewards[:, 1::2] = 1e6
            buffer.values[:, 1::2] = -1e6
        else:
            half = RolloutBuffer(16, 4)
            half.load_state_dict(buffer.state_dict() | {"capacity": 16}, slice(0, 8, 2))
            buffer = half
        metrics = ppo.update(buffer)
        assert metrics["reward_mean"] == pytest.approx(buffer.rewards[~buffer.intervened].mean())
        params.append(flat(ppo.policy.parameters()))
    torch.testing.assert_close(*params, atol=0, rtol=0)


def test_where_all_had_help_nothing_is_learned():
    ppo = make_ppo()
    before = flat(ppo.policy.parameters())
    buffer = rollout(ppo, reward_for_up)
    buffer.intervened[:] = True
    assert ppo.update(buffer)["policy_epochs"] == 0
    assert torch.equal(flat(ppo.policy.parameters()), before)


class TwoSteps(DummyPolicy):
    """Decides on two actions at once."""

    decision_steps = 2

    def sample_actions(self, batch, **options):
        sample = super().sample_actions(batch, **options)
        return sample | {"actions": sample["actions"].repeat(1, 2, 1)}


def test_a_decision_has_help_if_any_of_its_steps_has():
    ppo = make_ppo(policy=TwoSteps())
    agent = PPOAgent(ppo, RolloutBuffer(2, 3), torch.Generator())
    tau = [TASKS[0].instruction] * 3
    helped = [[0, 1, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0]]
    for k, now in enumerate(helped):
        o_t = {"agent_pos": np.zeros((3, 2), np.float32)}
        sample = agent.act(o_t, tau)
        sample = ActionSample(sample.action, sample.log_prob, sample.value, np.array(now, bool))
        cut = np.full(3, k == 3)
        agent.store(o_t, tau, sample, np.zeros(3, np.float32), o_t, cut, np.zeros(3, bool))
    assert agent.buffer.intervened.tolist() == [[False, True, False], [True, False, False]]
    other = RolloutBuffer(2, 3)
    other.load_state_dict(agent.buffer.state_dict())
    assert np.array_equal(other.intervened, agent.buffer.intervened)
