import numpy as np
import pytest
import torch
from dummies import TASKS, DummyPolicy, identity_processors

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig
from cronos_lerobot.agents.ppo.ppo import (
    PPO,
    adapted_lr,
    approximate_kl,
    clipped_objective,
    explained_variance,
    value_error,
)
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.processing import PolicyProcessors


def make_ppo(seed=0, **options):
    options = {"minibatch_size": 64, "value_warmup_updates": 0} | options
    processors = PolicyProcessors(*identity_processors())
    return PPO(DummyPolicy(seed=seed), processors, PPOConfig(**options), np.random.default_rng(seed))


def rollout(ppo, reward, rows=16, streams=8):
    """Rows that each end their own trace, so that the return is the reward plus nothing."""
    rng = np.random.default_rng(3)
    buffer = RolloutBuffer(rows, streams)
    for _ in range(rows):
        columns = {"observation.state": rng.normal(size=(streams, 2)).astype(np.float32)}
        instructions = [TASKS[i].instruction for i in rng.integers(4, size=streams)]
        with torch.no_grad():
            sample = ppo.policy.sample_actions(
                ppo.processors.batch(columns, instructions), generator=torch.Generator().manual_seed(7)
            )
        sample = ActionSample(*(sample[k].numpy() for k in ("action", "tokens", "log_prob", "value")))
        buffer.add(columns, instructions, sample, reward(sample), np.full(streams, True), np.zeros(streams))
    return buffer


def reward_for_up(sample):
    return (sample.tokens[:, 0] == 2).astype(np.float32)


def flat(params):
    return torch.cat([p.detach().flatten() for p in params])


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective"),
    [(1.0, 2.0, 2.0), (1.5, 2.0, 2.4), (0.5, 2.0, 1.0), (1.5, -2.0, -3.0), (0.5, -2.0, -1.6)],
)
def test_clipped_objective_by_hand(ratio, advantage, objective):
    result = clipped_objective(torch.tensor([ratio]).log(), torch.tensor([advantage]), clip=0.2)
    assert result.item() == pytest.approx(objective)


def test_no_gradient_beyond_the_clip():
    log_ratio = torch.tensor([0.5, 0.1], requires_grad=True)
    clipped_objective(log_ratio, torch.ones(2), clip=0.2).sum().backward()
    assert log_ratio.grad[0] == 0
    assert log_ratio.grad[1] > 0


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


def test_adaptive_learning_rate():
    config = PPOConfig(target_kl=0.04, lr_factor=2.0, policy_lr_min=3e-5, policy_lr_max=3e-4)
    assert adapted_lr(1e-4, 0.09, config) == pytest.approx(5e-5)
    assert adapted_lr(1e-4, 0.05, config) == 1e-4
    assert adapted_lr(1e-4, 0.01, config) == pytest.approx(2e-4)
    assert adapted_lr(4e-5, 0.09, config) == 3e-5
    assert adapted_lr(2e-4, 0.01, config) == 3e-4


def test_explained_variance():
    returns = np.array([1.0, 2.0, 3.0])
    assert explained_variance(returns, returns) == 1
    assert explained_variance(np.full(3, 2.0), returns) == 0


def test_ratio_is_one_before_the_first_step():
    ppo = make_ppo(epochs=1, minibatch_size=16 * 8)
    metrics = ppo.update(rollout(ppo, reward_for_up))
    assert metrics["ratio_max"] == pytest.approx(1, abs=1e-5)
    assert metrics["approx_kl"] == pytest.approx(0, abs=1e-6)
    assert metrics["clip_fraction"] == 0


def test_actions_that_pay_become_likelier():
    ppo = make_ppo(epochs=4, policy_lr=1e-2, lr_schedule="fixed", target_kl=None)
    before = rollout(ppo, reward_for_up)
    for _ in range(10):
        ppo.update(rollout(ppo, reward_for_up))
    after = rollout(ppo, reward_for_up)
    assert after.rewards.mean() > before.rewards.mean() + 0.2


def test_value_warmup_leaves_the_policy_alone():
    ppo = make_ppo(value_warmup_updates=1, value_epochs=3)
    policy, value = flat(ppo.policy.actor.parameters()), flat(ppo.policy.critic.parameters())
    metrics = ppo.update(rollout(ppo, reward_for_up))
    assert metrics["policy_epochs"] == 0
    assert torch.equal(policy, flat(ppo.policy.actor.parameters()))
    assert not torch.equal(value, flat(ppo.policy.critic.parameters()))
    ppo.update(rollout(ppo, reward_for_up))
    assert not torch.equal(policy, flat(ppo.policy.actor.parameters()))


def test_value_epochs_improve_the_critic_only():
    ppo = make_ppo(epochs=1, policy_lr=0.0, policy_lr_min=0.0, value_lr=1e-2, value_epochs=30)
    policy = flat(ppo.policy.actor.parameters())
    first = ppo.update(rollout(ppo, reward_for_up))
    second = ppo.update(rollout(ppo, reward_for_up))
    assert torch.equal(policy, flat(ppo.policy.actor.parameters()))
    assert second["value_loss"] < first["value_loss"]


def test_policy_stops_early_when_it_has_moved_too_far():
    ppo = make_ppo(epochs=10, policy_lr=0.5, target_kl=0.01, kl_stop_factor=2.0)
    metrics = ppo.update(rollout(ppo, reward_for_up))
    assert metrics["policy_epochs"] < 2
    assert ppo.policy_lr == pytest.approx(0.5 / 1.5)


def test_lr_rises_while_the_policy_hardly_moves():
    ppo = make_ppo(epochs=1, policy_lr=1e-6)
    ppo.update(rollout(ppo, reward_for_up))
    assert ppo.policy_lr == pytest.approx(1.5e-6)


def test_accumulated_minibatches_make_the_step_of_a_large_one():
    params = []
    for options in ({"minibatch_size": 128}, {"minibatch_size": 48, "grad_accumulation": 3}):
        ppo = make_ppo(epochs=1, value_epochs=0, lr_schedule="fixed", max_grad_norm=1e9, **options)
        ppo.update(rollout(ppo, reward_for_up))
        params.append(flat(ppo.policy.parameters()))
    torch.testing.assert_close(*params, atol=2e-6, rtol=1e-4)


def test_kl_to_the_base_policy_holds_back():
    moved = []
    for coefficient in (0.0, 100.0):
        ppo = make_ppo(
            epochs=5, policy_lr=1e-2, lr_schedule="fixed", target_kl=None, kl_base_coef=coefficient,
            normalize_advantage=False,
        )  # fmt: skip
        start = flat(ppo.policy.actor.parameters())
        for _ in range(5):
            ppo.update(rollout(ppo, reward_for_up))
        moved.append((flat(ppo.policy.actor.parameters()) - start).norm().item())
    assert moved[1] < 0.5 * moved[0]


def test_a_loss_that_is_not_finite_stops_the_run_before_it_spoils_the_policy():
    ppo = make_ppo(normalize_advantage=False)
    policy = flat(ppo.policy.parameters())
    with pytest.raises(FloatingPointError, match="update 0"):
        ppo.update(rollout(ppo, lambda sample: np.full(len(sample.value), np.nan)))
    assert torch.equal(policy, flat(ppo.policy.parameters()))


def test_paper_settings():
    config = PaperPPOConfig()
    assert (config.epochs, config.clip, config.gamma, config.gae_lambda) == (1, 0.2, 0.99, 0.95)
    assert (config.minibatch_size, config.grad_accumulation, config.entropy_coef) == (8, 20, 0.0)
    assert (config.policy_lr, config.value_lr, config.beta1, config.beta2) == (1e-4, 3e-3, 0.9, 0.999)
    assert (config.max_grad_norm, config.value_loss, config.huber_delta) == (10.0, "huber", 10.0)


def test_untrainable_policy_is_named():
    processors = PolicyProcessors(*identity_processors())
    with pytest.raises(TypeError, match="sample_actions"):
        PPO(torch.nn.Linear(1, 1), processors, PPOConfig(), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epochs": 0}, "epochs"),
        ({"lr_schedule": "cosine"}, "kl_update"),
        ({"value_loss": "l1"}, "huber"),
        ({"target_kl": None}, "needs algorithm.target_kl"),
        ({"temperature": 0.0}, "temperature"),
    ],
)
def test_bad_settings_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PPOConfig(**options)
