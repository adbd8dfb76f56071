import pytest
import torch

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.losses import (
    UpdateMetrics,
    approximate_kl,
    bounded_log_ratio,
    clipped_objective,
    kl_to_base,
    value_error,
)
from cronos_lerobot.ranks import Ranks


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective"),
    [(1.0, 2.0, 2.0), (1.5, 2.0, 2.4), (0.5, 2.0, 1.0), (1.5, -2.0, -3.0), (0.5, -2.0, -1.6)],
)
def test_clipped_objective_by_hand(ratio, advantage, objective):
    result = clipped_objective(torch.tensor([ratio]).log(), torch.tensor([advantage]), clip=0.2)
    assert result.item() == pytest.approx(objective)


def test_kl_estimate_matches_the_exact_divergence():
    old, new = torch.tensor([0.5, 0.3, 0.2]), torch.tensor([0.4, 0.4, 0.2])
    estimate = (old * approximate_kl((new / old).log())).sum()
    exact = (old * (old / new).log()).sum()
    assert estimate.item() == pytest.approx(exact.item(), abs=1e-6)


def test_value_loss_by_hand():
    value, old, return_ = torch.tensor([3.0]), torch.tensor([1.0]), torch.tensor([4.0])
    assert value_error(value, old, return_, PPOConfig(value_loss="mse")).item() == pytest.approx(0.5)
    # Clipped to 1.2, the error is 2.8, which is the worse one: 2.8 ** 2 / 2.
    clipped = value_error(value, old, return_, PPOConfig(value_loss="mse", value_clip=0.2))
    assert clipped.item() == pytest.approx(3.92)
    # Huber beyond delta: delta * (|error| - delta / 2).
    far = value_error(value, old, torch.tensor([33.0]), PPOConfig(huber_delta=10.0))
    assert far.item() == pytest.approx(10 * (30 - 5))


def test_an_overflowing_ratio_costs_something_finite():
    log_ratio = bounded_log_ratio(torch.tensor([0.0, 0.0], requires_grad=True), torch.tensor([-1e4, 1e4]))
    objective = clipped_objective(log_ratio, torch.tensor([-50.0, -50.0]), clip=0.2)
    assert torch.isfinite(objective).all()
    assert torch.isfinite(approximate_kl(log_ratio)).all()
    assert approximate_kl(log_ratio).min() > 10


OLD = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
BASE = torch.tensor([0.2, 0.2, 0.6], dtype=torch.float64)
LOGITS = torch.tensor([0.3, -0.4, 0.1], dtype=torch.float64)


def divergence(p, q):
    return (p * (p / q).log()).sum()


def test_kl_to_base_is_that_of_the_new_policy_from_the_base():
    # Every action in proportion to its probability under the policy that drew the samples.
    new = LOGITS.log_softmax(0)
    estimate = (OLD * kl_to_base(new, OLD.log(), BASE.log())).sum()
    assert estimate.item() == pytest.approx(divergence(new.exp(), BASE).item(), rel=1e-9)
    assert (kl_to_base(new, OLD.log(), BASE.log()) >= 0).all()


def test_the_gradient_of_kl_to_base_is_the_divergences():
    logits = LOGITS.clone().requires_grad_(True)
    (OLD * kl_to_base(logits.log_softmax(0), OLD.log(), BASE.log())).sum().backward()
    step = 1e-6
    for i in range(3):
        shift = step * torch.eye(3, dtype=torch.float64)[i]
        up, down = (divergence((LOGITS + s).softmax(0), BASE) for s in (shift, -shift))
        assert logits.grad[i].item() == pytest.approx(((up - down) / (2 * step)).item(), abs=1e-8)


def test_metrics_are_means_by_weight_or_maxima_whatever_they_are_called():
    metrics = UpdateMetrics()
    metrics.add_means({"steps_max": 1.0}, weight=3)
    metrics.add_means({"steps_max": 5.0}, weight=1)
    metrics.add_maxima({"ratio": 2.0})
    metrics.add_maxima({"ratio": 1.0})
    assert metrics.result(Ranks()) == {"steps_max": 2.0, "ratio": 2.0}
