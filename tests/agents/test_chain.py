"""Denoising chains against closed forms."""

import math
from types import SimpleNamespace

import pytest
import torch
from lerobot.policies.common.flow_matching import euler_integrate
from torch import nn

from cronos_lerobot.agents.adapters.denoising import Scored, chain_log_prob, sample_chain
from cronos_lerobot.agents.adapters.flow import FlowAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions

MEAN, STD = 0.7, 0.3


class GaussianFlow(nn.Module):
    """The exact velocity of actions that are all N(scale, STD), whatever is observed; scale is MEAN at first."""

    def __init__(self, n_action_steps=2):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(MEAN))
        self.config = SimpleNamespace(n_action_steps=n_action_steps, action_feature=SimpleNamespace(shape=(2,)))

    def velocity(self, x, t):
        # E[e | x] and E[a | x] of x = t e + (1 - t) a with independent Gaussians.
        t = t[:, None, None].to(x.dtype)
        variance = t**2 + (1 - t) ** 2 * STD**2
        off = x - (1 - t) * self.scale
        return t * off / variance - (self.scale + (1 - t) * STD**2 * off / variance)


class GaussianFlowAdapter(FlowAdapter):
    def observe(self, batch):
        return None, batch["observation.state"]

    def velocity(self, context, x, time):
        return self.policy.velocity(x, time)


def make_adapter(steps, level, shape=(3, 4), noise_steps=None):
    options = AdapterOptions(noise_level=level, noise_steps=noise_steps)
    return GaussianFlowAdapter(GaussianFlow(), options, shape=shape, num_steps=steps, feature_width=1)


def make_batch(n):
    return {"observation.state": torch.zeros(n, 1)}


@torch.no_grad()
@pytest.mark.parametrize("level", [0.5, 1.0])
def test_the_stochastic_chain_ends_where_the_flow_does(level):
    adapter = make_adapter(200, level, shape=(2, 2))
    sample = adapter.sample_actions(make_batch(4000), generator=torch.Generator().manual_seed(0))
    actions = sample["actions"]
    assert actions.shape == (4000, 2, 2)
    assert sample["trace"].shape == (4000, 200, 2, 2)
    # 16,000 numbers: three standard errors of the mean and of the deviation, and the Euler steps' own error.
    assert float(actions.mean()) == pytest.approx(MEAN, abs=0.02)
    assert float(actions.std()) == pytest.approx(STD, abs=0.02)
    # The noise at the start is forgotten, which a flow without noise never does.
    start = adapter.scored(sample["trace"][:, 0])
    assert abs(float(torch.corrcoef(torch.stack([start.flatten(), actions.flatten()]))[0, 1])) < 0.9


@torch.no_grad()
@pytest.mark.parametrize("steps", [2, 5, 10])
def test_few_steps_add_no_noise_to_the_actions(steps, monkeypatch):
    """Where one action is right, every denoising ends at it, whatever noise it had on its way."""
    monkeypatch.setitem(globals(), "STD", 1e-6)
    adapter = make_adapter(steps, 1.0, shape=(2, 2))
    sample = adapter.sample_actions(make_batch(1000), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(sample["actions"], torch.full((1000, 2, 2), MEAN), atol=1e-4, rtol=0)
    # (1 - t') of the actions and t' of the noise at t' = (S - k) / S: three standard errors of 4000 numbers.
    for k in range(1, steps):
        noise = sample["trace"][:, k] - k / steps * MEAN
        assert float(noise.std()) == pytest.approx(1 - k / steps, rel=0.04)


def test_a_steps_noise_by_hand():
    """Of five steps the second goes from t = .8 to .6: s = eta .6 sqrt(1 - (.6 .2 / (.8 .4))^2)."""
    s = 0.5 * 0.6 * (1 - 0.375**2) ** 0.5
    t, past, change, std = make_adapter(5, 0.5)._tables(0.5)[:, 1].tolist()
    assert (t, past, std) == pytest.approx((0.8, 0.2, s))
    assert change == pytest.approx((0.36 - s**2) ** 0.5 - 0.6)


@torch.no_grad()
@pytest.mark.parametrize("options", [{"temperature": 0.0}, {"level": 0.0}])
def test_without_noise_it_is_lerobots_integration(options):
    adapter = make_adapter(10, options.get("level", 0.5))
    noise = torch.randn(5, 3, 4, generator=torch.Generator().manual_seed(1))
    sample = adapter.sample_actions(make_batch(5), temperature=options.get("temperature", 1.0), noise=noise)
    own = euler_integrate(adapter.policy.velocity, noise, 10)
    # Two of three steps are played, two of four dimensions are the action's.
    assert torch.equal(sample["actions"], own[:, :2, :2])
    assert torch.equal(sample["log_prob"], torch.zeros(5, 9))
    assert torch.equal(adapter.denoise(None, noise), own[:, :2, :2])


def test_likelihood_of_a_chain_by_hand():
    """Two steps: x / 2 with deviation 0.1, then + 1 without noise; the last of three dimensions is padding."""

    def step(k, x):
        return (x / 2, torch.tensor(0.1)) if k == 0 else (x + 1, torch.tensor(0.0))

    scored = Scored(slice(1, 2), 2)
    start = torch.ones(1, 2, 3)
    chain, log_prob = sample_chain(step, start, 2, scored, torch.Generator().manual_seed(2))
    noise = torch.randn(1, 2, 3, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(chain[:, 1], 0.5 + 0.1 * noise)
    assert torch.equal(chain[:, 2], chain[:, 1] + 1)
    expected = sum(-0.5 * float(z) ** 2 - math.log(0.1 * math.sqrt(2 * math.pi)) for z in noise[0, 1, :2])
    assert log_prob.tolist() == [[pytest.approx(expected, abs=1e-4), 0.0]]
    assert torch.equal(chain_log_prob(step, chain, scored), log_prob)


def test_gradients_of_a_chain_are_finite_differences():
    adapter = make_adapter(4, 0.5)
    adapter.policy.double()
    batch = {"observation.state": torch.zeros(3, 1, dtype=torch.float64)}
    noise = torch.randn(3, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        sample = adapter.sample_actions(batch, generator=torch.Generator().manual_seed(4), noise=noise)
    evaluated = adapter.evaluate_actions(batch, sample["trace"])
    torch.testing.assert_close(evaluated["log_prob"], sample["log_prob"], atol=1e-9, rtol=0)
    evaluated["log_prob"].sum().backward()
    scale = adapter.policy.scale
    results = []
    for change in (1e-5, -1e-5):
        with torch.no_grad():
            scale += change
            results.append(float(adapter.evaluate_actions(batch, sample["trace"])["log_prob"].sum()))
            scale -= change
    assert float(scale.grad) == pytest.approx((results[0] - results[1]) / 2e-5, rel=1e-5)


@torch.no_grad()
def test_noise_at_some_steps_alone():
    """Two of five: the others are LeRobot's, and of five steps an update looks at two."""
    adapter, rows = make_adapter(5, 0.5, noise_steps=2), torch.arange(1000)
    looked = []
    velocity = adapter.velocity
    adapter.velocity = lambda context, x, time: looked.append(time) or velocity(context, x, time)
    noise = torch.randn(1000, 3, 4, generator=torch.Generator().manual_seed(1))
    sample = adapter.sample_actions(make_batch(1000), generator=torch.Generator().manual_seed(2), noise=noise)
    assert len(looked) == 5
    trace = sample["trace"]
    assert trace.shape == (1000, 2, 7, 4)
    before, after, numbers = trace[:, :, :3], trace[:, :, 3:6], trace[:, :, 6, 0].long()
    assert (numbers[:, 0] < numbers[:, 1]).all()
    # Each pair of the four steps that can have noise is as likely as another, within four standard errors.
    pairs = torch.bincount(5 * numbers[:, 0] + numbers[:, 1], minlength=25)
    assert (pairs > 0).sum() == 6
    assert all(abs(int(count) - 1000 / 6) < 4 * (1000 * 5 / 36) ** 0.5 for count in pairs if count)
    # From the noise to the first of them, between them, and to the actions: Euler steps of the velocity.
    x = noise.clone()
    for k in range(5):
        for j in range(2):
            here = numbers[:, j] == k
            torch.testing.assert_close(x[here], before[here, j], atol=1e-6, rtol=0)
            x[here] = after[here, j]
        quiet = (numbers != k).all(1)
        t = torch.full((int(quiet.sum()),), 1 - k / 5)
        x[quiet] -= 0.2 * adapter.policy.velocity(x[quiet], t)
    torch.testing.assert_close(sample["actions"], x[:, :2, :2], atol=1e-6, rtol=0)
    # The likelihood of the steps with noise is that of the same steps of a chain in which all have noise.
    looked.clear()
    log_prob = adapter.evaluate_actions(make_batch(1000), trace)["log_prob"]
    assert len(looked) == 2
    assert log_prob.shape == (1000, 2)
    torch.testing.assert_close(log_prob, sample["log_prob"], atol=1e-5, rtol=0)
    whole = make_adapter(5, 0.5)
    for k in range(4):
        chain = torch.zeros(1000, 5, 3, 4)
        chosen, j = (numbers == k).any(1), (numbers == k).int().argmax(1)
        chain[:, k], chain[:, k + 1] = before[rows, j], after[rows, j]
        of_step = whole.evaluate_actions(make_batch(1000), chain)["log_prob"][:, k]
        torch.testing.assert_close(of_step[chosen], log_prob[rows, j][chosen], atol=1e-5, rtol=0)


def test_noise_at_more_steps_than_can_have_it_is_refused():
    with pytest.raises(ValueError, match=r"--algorithm\.noise_steps"):
        make_adapter(5, 0.5, noise_steps=5)
    with pytest.raises(ValueError, match=r"--policy\.num_inference_steps"):
        make_adapter(1, 0.5)
