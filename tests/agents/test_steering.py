"""Steering, by hand and on problems whose best noise is known."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_chain import STD, GaussianFlow, GaussianFlowAdapter
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from cronos_lerobot.agents.adapters.registry import AdapterOptions
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.registry import AgentContext
from cronos_lerobot.agents.steering.agent import SteeringAgent
from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.agents.steering.replay import ReplayMemory
from cronos_lerobot.agents.steering.sac import SAC, NoiseActor, Whitening
from cronos_lerobot.agents.steering.steered import SteeredPolicy, SteeringShape


class Noises(torch.nn.Module):
    """Plays four actions, 10 * noise of the chunk's first four of five steps; its feature is the state."""

    decision_steps, shape = 4, (5, 3)

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor(10.0))
        features = {"observation.state": SimpleNamespace(shape=(1,))}
        self.config = SimpleNamespace(
            type="noises", input_features=features, action_feature=SimpleNamespace(shape=(2,))
        )
        self.asked = []

    def observe(self, batch):
        x = batch["observation.state"].flatten(1)
        self.asked.append(x[:, 0].tolist())
        return x, x

    def denoise(self, context, noise):
        assert noise[..., 2].abs().max() == 0
        return self.weight * noise[:, :4, :2]


PAIR = {"num_critics": 2, "num_target_critics": 2}


def make_agent(policy=None, streams=2, **options):
    generators = np.random.default_rng(0), torch.Generator().manual_seed(0)
    context = AgentContext(
        config=SteeringConfig(
            **{"gamma": 0.5, "hidden_width": 16, "warmup_decisions": 1, "batch_size": 8, "utd": 1} | PAIR | options
        ),
        policy=policy or Noises(),
        processors=PolicyProcessors(lambda batch: batch, lambda action: action),
        num_streams=streams,
        update_interval=8,
        task_switch_interval=8,
        rng=lambda name: generators[0],
        torch_rng=lambda name: generators[1],
    )
    torch.manual_seed(0)
    return SteeringAgent(context)


def at(*x):
    return {"agent_pos": np.array(x, np.float32)[:, None]}


def play(agent, rewards, cut=(), diverged=(), helped=()):
    """Stream 0 is at 1, 2, 3 ..., stream 1 at 101, 102 ...; returns the actions (steps, 2, 2).

    `cut`, `diverged` and `helped` are (step, stream).
    """
    actions = []
    for t, reward in enumerate(rewards):
        now, after = at(1 + t, 101 + t), at(2 + t, 102 + t)
        sample = agent.act(now, ["a", "b"])
        actions.append(sample.action)
        broken = np.array([(t, i) in diverged for i in range(2)])
        ends = broken | np.array([(t, i) in cut for i in range(2)])
        sample = replace(sample, intervened=np.array([(t, i) in helped for i in range(2)]))
        agent.store(now, ["a", "b"], sample, np.array(reward, np.float32), after, ends, broken)
    return np.stack(actions)


def test_what_is_remembered_of_decisions():
    agent = make_agent()
    policy = agent.policy
    policy.asked.clear()
    rewards = [[1, 0], [2, 0], [4, 8], [8, 0], [0, 0], [0, 0], [0, 0], [16, 0]]
    actions = play(agent, rewards, cut={(7, 0), (7, 1)})
    # Looked at when deciding, and once more where all traces end.
    assert policy.asked == [[1, 101], [5, 105], [9, 109]]
    kept = agent.memory.state_dict()
    assert kept["features"].tolist() == [[1], [101], [5], [105]]
    assert kept["next_features"].tolist() == [[5], [105], [9], [109]]
    # 1 + 2/2 + 4/4 + 8/8 and 8/4; then 16/8 and 0.
    assert kept["reward"].tolist() == [4, 2, 2, 0]
    assert kept["discount"].tolist() == [0.5**4] * 4
    # 1.5 * 10 * choice, of the first four of five steps.
    chosen = kept["choice"].astype(np.float32).reshape(2, 2, 5, 2)
    played = actions.reshape(2, 4, 2, 2).swapaxes(1, 2)
    np.testing.assert_allclose(played, 15 * chosen[:, :, :4], atol=0.01)


def test_a_decision_with_help_is_not_remembered():
    """Help in the last step of the first decision of stream 1, and all through the second one of stream 0."""
    agent = make_agent()
    helped = {(3, 1), (4, 0), (5, 0), (6, 0), (7, 0)}
    play(agent, [[1, 2]] * 8, cut={(7, 0), (7, 1)}, helped=helped)
    kept = agent.memory.state_dict()
    assert kept["features"].tolist() == [[1], [105]]
    assert kept["reward"].tolist() == [1.875, 3.75]
    assert agent.update()["decisions"] == 2


def test_a_divergence_is_followed_by_what_came_before_it():
    agent = make_agent()
    agent.policy.asked.clear()
    cut = {(3, 0), (3, 1)}
    play(agent, [[0, 1], [0, 2], [0, 64], [1, 64]], diverged={(1, 1)}, cut=cut)
    # o_1 of stream 1 before its divergence; it decides anew at o_2; the end of stream 0.
    assert agent.policy.asked == [[1, 101], [2, 102], [103], [5, 105]]
    kept = agent.memory.state_dict()
    assert kept["reward"].tolist() == [0.125, 2.0]
    assert kept["discount"].tolist() == [0.5**4, 0.5**2]
    assert kept["next_features"].tolist() == [[5], [102]]
    # In a first step it is the observation that was decided on, which was looked at already.
    agent.policy.asked.clear()
    play(agent, [[0, 1], [0, 0], [0, 0], [0, 0]], diverged={(0, 1)}, cut=cut)
    assert agent.policy.asked == [[1, 101], [102], [5, 105]]
    kept = agent.memory.state_dict()
    assert kept["discount"].tolist()[2:] == [0.5**4, 0.5]
    assert kept["next_features"].tolist()[2:] == [[5], [101]]


def make_sac(**options):
    config = SteeringConfig(**{"gamma": 0.99, "hidden_width": 8, "initial_alpha": 0.5} | PAIR | options)
    torch.manual_seed(0)
    actor, whitening = NoiseActor(3, 2, 8), Whitening(3)
    return SAC(config, actor, whitening, 3, 2, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("backup_entropy", [False, True])
def test_targets_by_hand(backup_entropy):
    sac = make_sac(backup_entropy=backup_entropy)
    with torch.no_grad():
        # Target critics that say 2 and 3 whatever they see; critics that say 100.
        for critics, values in ((sac.target_critics, (2.0, 3.0)), (sac.critics, (100.0, 100.0))):
            critics.weights[-1].zero_()
            critics.biases[-1].copy_(torch.tensor(values)[:, None, None])
    features = torch.zeros(2, 3)
    targets = sac.targets(torch.tensor([1.0, -1.0]), torch.tensor([0.125, 0.5]), features)
    expected = torch.tensor([1.0 + 0.125 * 2.0, -1.0 + 0.5 * 2.0])
    if backup_entropy:
        _, log_prob = sac.actor(features, generator=torch.Generator().manual_seed(0))
        expected -= torch.tensor([0.125, 0.5]) * 0.5 * log_prob.detach()
    torch.testing.assert_close(targets, expected)


def test_target_critics_follow_and_some_of_many_are_asked():
    sac = make_sac(num_critics=5, target_update=0.25)
    with torch.no_grad():
        sac.target_critics.weights[-1].zero_()
        sac.target_critics.biases[-1].copy_(torch.arange(5.0)[:, None, None])
    one, zero = torch.ones(1), torch.zeros(1, 3)
    asked = [float(sac.targets(0 * one, one, zero)) for _ in range(200)]
    # The least of two of five: 0 in 4 of 10 pairs, 3 in one of them, 4 in none.
    assert set(asked) == {0, 1, 2, 3}
    assert np.mean([value == 0 for value in asked]) == pytest.approx(0.4, abs=0.1)
    before = sac.target_critics.weights[0].clone()
    rng = np.random.default_rng(0)
    shapes = {"features": (4, 3), "choice": (4, 2), "reward": (4,), "discount": (4,), "next_features": (4, 3)}
    sac.step({name: rng.random(shape, dtype=np.float32) for name, shape in shapes.items()})
    moved = 0.75 * before + 0.25 * sac.critics.weights[0]
    torch.testing.assert_close(sac.target_critics.weights[0], moved)


def test_densities_of_choices_are_those_of_a_squashed_gaussian():
    actor = NoiseActor(3, 2, 8)
    torch.nn.init.normal_(actor.head.weight)
    features = torch.randn(5, 3, generator=torch.Generator().manual_seed(1))
    choice, log_prob = actor(features, generator=torch.Generator().manual_seed(2))
    mean, log_std = actor.head(actor.body(features)).chunk(2, -1)
    base = Independent(Normal(mean, log_std.exp()), 1)
    torch.testing.assert_close(log_prob, TransformedDistribution(base, [TanhTransform()]).log_prob(choice))
    torch.testing.assert_close(actor(features, temperature=0.0)[0], torch.tanh(mean))


def test_the_memory_forgets_the_oldest_and_draws_alike_after_loading():
    memory = ReplayMemory(5)

    def add(*numbers):
        column = np.array(numbers, np.float32)
        memory.add(
            features=column[:, None], choice=column[:, None] / 100, reward=column, discount=column,
            next_features=column[:, None] * 1e5,
        )  # fmt: skip

    for numbers in ((0, 1), (2, 3), (4, 5), (6,)):
        add(*numbers)
    assert memory.state_dict()["reward"].tolist() == [2, 3, 4, 5, 6]
    # Half precision ends at 65504.
    assert memory.state_dict()["next_features"].max() == 65504
    np.testing.assert_allclose(memory.moments(), [[4], [18]])
    loaded = ReplayMemory(5)
    loaded.load_state_dict(memory.state_dict())
    draws = [each.draw(50, np.random.default_rng(3))["reward"].tolist() for each in (memory, loaded)]
    assert draws[0] == draws[1]
    assert set(draws[0]) == {2, 3, 4, 5, 6}


class StateFlow(GaussianFlowAdapter):
    """The flow of N(0.7, 0.3), whatever is seen; what is seen are 8 numbers and the instruction."""

    def __init__(self):
        policy = GaussianFlow()
        policy.config.type = "gaussian_flow"
        policy.config.input_features = {"observation.state": SimpleNamespace(shape=(8,))}
        super().__init__(policy, AdapterOptions(), shape=(3, 4), num_steps=10, feature_width=8)


@pytest.mark.parametrize(("repeat", "is_late"), [(False, False), (True, True)])
def test_it_finds_the_noise_that_is_paid_for(repeat, is_late):
    """Best is 0.4 = 0.7 - 0.3, a noise of about -1, under one instruction, and 1.0, about 1, under the other.

    Of two decisions each is paid at once, or the first one only at the end of the second, which sees where it led.
    """
    adapter = StateFlow()
    weights = adapter.policy.scale.clone()
    agent = make_agent(
        adapter, streams=32, observation="state", noise_repeat=repeat, warmup_decisions=64, batch_size=64,
        gamma=0.8, hidden_width=32, lr=3e-3, utd=0.5, target_update=0.05, target_entropy=-2.0,
    )  # fmt: skip
    assert agent.steered.dims == (2 if repeat else 6)
    rng = np.random.default_rng(0)
    tau = ["go down", "go up"] * 16
    targets = np.array([0.4, 1.0] * 16)

    def two_decisions():
        errors, never, seen = [], np.zeros(32, bool), rng.normal(size=(32, 8)).astype(np.float32)
        seen[:, 0] = 0
        for k in range(4):
            sample = agent.act({"agent_pos": seen}, tau)
            errors.append(((sample.action - targets[:, None]) ** 2).mean(1))
            after = seen.copy()
            if k == 1:
                after[:, 0] = sample.action.mean(1) - 0.7
            paid = (errors[1] if k == 3 else 0 * errors[0]) if is_late else errors[-1]
            agent.store(
                {"agent_pos": seen}, tau, sample, -10 * paid, {"agent_pos": after}, never | (k == 3), never
            )
            seen = after
        return np.mean(errors[1] if is_late else errors)

    first = two_decisions()
    # The flow's own: 0.3^2 off target and 0.3^2 about it, less what the box cuts off.
    assert first == pytest.approx(2 * STD**2, rel=0.4)
    for _ in range(40):
        agent.update()
        last = two_decisions()
    assert last < 0.2 * first
    batch = {"observation.state": torch.zeros(2, 8), "task": ["go down", "go up"]}
    actions = agent.acting.sample_actions(batch, temperature=0.0)["actions"].mean((1, 2))
    assert actions.tolist() == pytest.approx([0.4, 1.0], abs=0.1)
    assert torch.equal(adapter.policy.scale, weights)


def test_the_prior_is_the_policys_own_noise_in_the_box():
    shape = SteeringShape(
        features=1, observation="policy", noise_magnitude=1.5, noise_repeat=False, hidden_width=8
    )
    steered = SteeredPolicy(Noises(), shape)
    draws = 1.5 * steered.prior(20000, torch.Generator().manual_seed(0))
    assert draws.shape == (20000, 10)
    assert float(draws.abs().max()) <= 1.5
    # Variance of N(0, 1) between -b and b: 1 - 2 b phi(b) / (2 Phi(b) - 1).
    density = math.exp(-0.5 * 1.5**2) / math.sqrt(2 * math.pi)
    assert float(draws.var()) == pytest.approx(1 - 3 * density / math.erf(1.5 / math.sqrt(2)), abs=0.01)


def test_repeated_noise_is_the_same_in_every_step_and_padding_is_none():
    shape = SteeringShape(features=1, observation="policy", noise_magnitude=2.0, noise_repeat=True, hidden_width=8)
    steered = SteeredPolicy(Noises(), shape)
    actions = steered.denoise(None, torch.tensor([[0.5, -1.0]]))
    assert actions.tolist() == [[[10.0, -20.0]] * 4]


def test_decisions_since_the_last_update_are_saved():
    """A budget may end a run between two updates."""
    whole, broken = make_agent(), make_agent()
    for agent in (whole, broken):
        play(agent, [[0, 0]] * 8, cut={(7, 0), (7, 1)})
    resumed = make_agent()
    resumed.load_state_dict(broken.state_dict())
    for agent in (whole, resumed):
        play(agent, [[0, 0]] * 8, cut={(7, 0), (7, 1)})
    # Two streams, two decisions in each half.
    assert [agent.update()["optimizer_steps"] for agent in (whole, resumed)] == [8, 8]
