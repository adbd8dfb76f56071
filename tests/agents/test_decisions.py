"""Decisions of several actions: what is played, what is summed, and what follows them, by hand. gamma = 0.5."""

import numpy as np
import pytest
import torch

from cronos_lerobot.agents.base import decision_steps
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.losses import by_factor, factor_weights
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.processing import PolicyProcessors


class Chunks(torch.nn.Module):
    """Decides on four actions: 10 * x, 10 * x + 1, ... at the observation x, whose value is x / 4."""

    decision_steps = 4

    def __init__(self):
        super().__init__()
        self.actor, self.critic = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1, bias=False)
        torch.nn.init.constant_(self.critic.weight, 0.25)
        self.config = None
        self.asked = []

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        x = batch["observation.state"][:, 0]
        self.asked.append(x.tolist())
        actions = (10 * x[:, None] + torch.arange(4.0))[..., None].repeat(1, 1, 7)
        log_prob = torch.stack([x, -3 * x], 1)
        return {"actions": actions, "trace": x[:, None], "log_prob": log_prob, "value": self.predict_values(batch)}

    def evaluate_actions(self, batch, trace, *, temperature=1.0):
        x = batch["observation.state"]
        return {
            "log_prob": torch.cat([x, -3 * x], 1) + self.actor(x),
            "entropy": None,
            "value": self.predict_values(batch),
        }

    def predict_values(self, batch):
        return self.critic(batch["observation.state"])[:, 0]

    def rl_parameter_groups(self):
        groups = {"policy": self.actor, "value": self.critic}
        return [{"name": name, "params": list(net.parameters())} for name, net in groups.items()]


def make_agent(rows=2, streams=2, **options):
    policy = Chunks()
    config = PPOConfig(gamma=0.5, gae_lambda=0.5, value_warmup_updates=0, **options)
    ppo = PPO(
        policy, PolicyProcessors(lambda batch: batch, lambda action: action), config, np.random.default_rng(0)
    )
    return PPOAgent(ppo, RolloutBuffer(rows, streams), torch.Generator()), policy


def at(*x):
    return {"agent_pos": np.array(x, np.float32)[:, None]}


def play(agent, steps, rewards, cut=(), diverged=(), said=None):
    """Stream 0 is at 1, 2, 3 ..., stream 1 at 101, 102 ...; returns the actions' first number, (steps, 2)."""
    actions = []
    for t in range(steps):
        now, after = at(1 + t, 101 + t), at(2 + t, 102 + t)
        sample = agent.act(now, ["a", "b"])
        actions.append(sample.action[:, 0].tolist())
        if said is not None:
            said.append((sample.log_prob, sample.value))
        broken = np.array([(t, i) in diverged for i in range(2)])
        ends = broken | np.array([(t, i) in cut for i in range(2)])
        agent.store(now, ["a", "b"], sample, np.array(rewards[t], np.float32), after, ends, broken)
    return actions


def test_a_decision_is_played_to_its_end_and_its_rewards_are_discounted_and_summed():
    agent, policy = make_agent()
    rewards = [[1, 0], [2, 0], [4, 8], [8, 0], [0, 0], [0, 0], [0, 0], [16, 0]]
    actions = play(agent, 8, rewards, cut={(7, 0), (7, 1)})
    assert policy.asked == [[1, 101], [5, 105]]
    assert [a[0] for a in actions] == [10, 11, 12, 13, 50, 51, 52, 53]
    buffer = agent.buffer
    # 1 + 2/2 + 4/4 + 8/8 = 4 and 8/4 = 2; then 16/8 = 2 and 0.
    assert buffer.rewards.tolist() == [[4, 2], [2, 0]]
    assert buffer.durations.tolist() == [[4, 4], [4, 4]]
    assert buffer.values.tolist() == [[0.25, 25.25], [1.25, 26.25]]
    # Only the second decisions end with a task switch: the value of x = 9 and 109, before it.
    assert buffer.boundaries.tolist() == [[False, False], [True, True]]
    assert buffer.bootstrap_values[1].tolist() == [2.25, 27.25]
    buffer.compute_advantages(0.5, 0.5)
    # delta_1 = 2 + 2.25/16 - 1.25 = .890625; delta_0 = 4 + 1.25/16 - .25 = 3.828125; A_0 = delta_0 + A_1/32
    assert buffer.advantages[:, 0].tolist() == [3.828125 + 0.890625 / 32, 0.890625]


def test_a_divergence_ends_a_decision_and_the_stream_decides_anew():
    agent, policy = make_agent(rows=1)
    rewards = [[0, 1], [0, 2], [0, 64], [1, 64]]
    said = []
    actions = play(agent, 4, rewards, diverged={(1, 1)}, cut={(3, 0), (3, 1)}, said=said)
    # After its step 1 stream 1 is somewhere else: it decides on what is left, at x = 103.
    assert policy.asked == [[1, 101], [103]]
    assert [a[1] for a in actions] == [1010, 1011, 1030, 1031]
    # What is recorded of its steps: log-probability -2 x and value x / 4 of the decision that they are of.
    assert [log_prob[1] for log_prob, _ in said] == [-202, -202, -206, -206]
    assert [value[1] for _, value in said] == [25.25, 25.25, 25.75, 25.75]
    assert [log_prob[0] for log_prob, _ in said] == [-2] * 4
    buffer = agent.buffer
    assert buffer.rewards.tolist() == [[0.125, 2.0]]
    assert buffer.durations.tolist() == [[4, 2]]
    assert buffer.boundaries.tolist() == [[True, True]]
    # V(o_4) = 5 / 4 of stream 0; of stream 1 V(o_1) = 102 / 4: there is no o_2, and the rest is not learned from.
    assert buffer.bootstrap_values.tolist() == [[1.25, 25.5]]
    assert buffer.traces.tolist() == [[[1], [101]]]
    assert buffer.log_probs.sum(-1).tolist() == [[-2, -202]]
    assert buffer.values.tolist() == [[0.25, 25.25]]
    buffer.compute_advantages(0.5, 0.5)
    assert buffer.advantages[0, 1] == 2 + 25.5 / 4 - 25.25


def test_a_divergence_in_the_first_step_and_at_a_switch():
    agent, policy = make_agent(rows=1)
    play(agent, 4, [[0, 1], [0, 0], [0, 0], [0, 0]], diverged={(0, 1), (3, 0)}, cut={(3, 0), (3, 1)})
    assert policy.asked == [[1, 101], [102]]
    # Stream 0 diverges in its last step, at x = 4; stream 1 in its first.
    assert agent.buffer.durations.tolist() == [[4, 1]]
    assert agent.buffer.bootstrap_values.tolist() == [[1.0, 25.25]]


def test_chunks_that_do_not_divide_the_interval_are_refused():
    assert decision_steps(Chunks(), 80) == 4
    with pytest.raises(ValueError, match=r"--protocol\.task_switch_interval=82.*\[1, 2\]"):
        decision_steps(Chunks(), 82)
    agent, _ = make_agent()
    agent.clock.num_steps = 5
    with pytest.raises(ValueError, match="decision_steps"):
        agent.act(at(1, 2), ["a", "b"])


def update_once(shift, **options):
    """Metrics of an update in which all factors are exp(shift) likelier than when they were drawn."""
    settings = {"target_kl": None, "lr_schedule": "fixed", "epochs": 1, "normalize_advantage": False}
    agent, policy = make_agent(**settings | options)
    torch.nn.init.zeros_(policy.actor.weight)
    torch.nn.init.constant_(policy.actor.bias, shift)
    play(agent, 8, [[1, 1]] * 8, cut={(7, 0), (7, 1)})
    return agent.update()


@pytest.mark.parametrize("ratio", ["decision", "factor"])
def test_ratios_of_decisions_and_of_factors(ratio):
    log_prob = torch.tensor([[-1.0, -2.0], [-3.0, 1.0]])
    expected = log_prob if ratio == "factor" else torch.tensor([[-3.0], [-2.0]])
    torch.testing.assert_close(by_factor(log_prob, ratio), expected)
    torch.testing.assert_close(by_factor(torch.tensor([5.0, 6.0]), ratio), torch.tensor([[5.0], [6.0]]))
    # A decision of two factors is exp(1.0) likelier.
    metrics = update_once(0.5, ratio=ratio)
    shift = 1.0 if ratio == "decision" else 0.5
    assert metrics["ratio_max"] == pytest.approx(np.exp(shift), rel=1e-4)
    factors = 1 if ratio == "decision" else 2
    assert metrics["approx_kl"] == pytest.approx(factors * (np.exp(shift) - 1 - shift), rel=1e-3)
    assert "entropy" not in metrics


def test_factors_weigh_as_much_as_decisions_beside_the_rest_of_the_loss():
    """Where all ratios are 1 both clip nothing: the gradient is that of the decision's log-probability."""
    norms = [update_once(0.0, ratio=ratio)["policy_grad_norm"] for ratio in ("decision", "factor")]
    assert norms[0] > 0
    assert norms[1] == pytest.approx(norms[0])


def test_the_first_steps_of_a_denoising_may_count_less():
    assert factor_weights(torch.zeros(5, 3), 0.5).tolist() == [0.25, 0.5, 1]
    assert factor_weights(torch.zeros(5, 1), 1.0).tolist() == [1]
    all_alike, less = (
        update_once(0.5, ratio="factor", denoising_discount=discount)["policy_loss"] for discount in (1.0, 0.5)
    )
    # Both factors of a decision have the same ratio: (1/2 + 1) / 2 of the loss is left.
    assert all_alike != 0
    assert less == pytest.approx(0.75 * all_alike)
