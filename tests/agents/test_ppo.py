import math

import numpy as np
import pytest
import torch
from dummies import TASKS, DummyPolicy
from ppo_samples import flat, make_ppo, reward_for_up, rollout

from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig
from cronos_lerobot.agents.steering.config import SteeringConfig


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


def test_accumulated_minibatches_make_the_step_of_a_large_one():
    params = []
    for options in ({"minibatch_size": 128}, {"minibatch_size": 48, "grad_accumulation": 3}):
        free = {"lr_schedule": "fixed", "max_grad_norm": 1e9, "value_max_grad_norm": 1e9}
        ppo = make_ppo(epochs=1, value_epochs=0, **free, **options)
        ppo.update(rollout(ppo, reward_for_up))
        params.append(flat(ppo.policy.parameters()))
    torch.testing.assert_close(*params, atol=2e-6, rtol=1e-4)


def test_pieces_of_a_minibatch_make_its_step(monkeypatch):
    params, seen = [], []
    for piece_bytes in (2**23, 300):
        monkeypatch.setattr("cronos_lerobot.agents.ppo.ppo.PIECE_BYTES", piece_bytes)
        ppo = make_ppo(epochs=1, value_epochs=1, lr_schedule="fixed", max_grad_norm=1e9, minibatch_size=128)
        loss_of, sizes = ppo._loss, []
        ppo._loss = lambda minibatch, of=loss_of, to=sizes: (to.append(len(minibatch.indices)), of(minibatch))[1]
        ppo.update(rollout(ppo, reward_for_up))
        params.append(flat(ppo.policy.parameters()))
        seen.append(sizes)
    assert seen[0] == [128]
    assert len(seen[1]) > 2
    assert sum(seen[1]) == 128
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
    assert config.value_max_grad_norm == 10.0
    assert (config.epochs, config.clip, config.gamma, config.gae_lambda) == (1, 0.2, 0.99, 0.95)
    assert (config.minibatch_size, config.grad_accumulation, config.entropy_coef) == (8, 20, 0.0)
    assert (config.policy_lr, config.value_lr, config.beta1, config.beta2) == (1e-4, 3e-3, 0.9, 0.999)
    assert (config.max_grad_norm, config.value_loss, config.huber_delta) == (10.0, "huber", 10.0)


def test_weights_too_coarse_for_its_steps_are_refused():
    message = r"type=ppo would learn next to nothing: torch\.bfloat16 cannot hold .* float32, or train adapters"
    with pytest.raises(ValueError, match=message):
        make_ppo(policy=DummyPolicy().bfloat16())
    make_ppo(policy=DummyPolicy().double())


def test_gradients_are_clipped_by_group():
    norms = []
    for limit in (1e9, 0.5):
        ppo = make_ppo(
            epochs=1, value_epochs=0, minibatch_size=128, max_grad_norm=1e9, value_max_grad_norm=limit,
            normalize_advantage=False, lr_schedule="fixed",
        )  # fmt: skip
        metrics = ppo.update(rollout(ppo, lambda sample: 20 * reward_for_up(sample)))
        norms.append([metrics["policy_grad_norm"], metrics["value_grad_norm"]])
        norms[-1] += [
            flat(p.grad for p in net.parameters()).norm() for net in (ppo.policy.actor, ppo.policy.critic)
        ]
    free, clipped = norms
    assert free[1] > 1
    # What is told is the norm before; a critic that is far off does not shorten the policy's step.
    assert clipped == pytest.approx([free[0], free[1], free[0], 0.5], rel=1e-4)


def test_what_is_in_no_group_is_frozen():
    policy = DummyPolicy()
    policy.rl_parameter_groups = lambda: [
        {"name": "policy", "params": [policy.actor.bias]},
        {"name": "value", "params": [*policy.critic.parameters()]},
    ]
    ppo = make_ppo(policy=policy)
    weight = policy.actor.weight.detach().clone()
    ppo.update(rollout(ppo, reward_for_up))
    assert not policy.actor.weight.requires_grad
    assert policy.actor.weight.grad is None
    assert torch.equal(policy.actor.weight, weight)


def test_a_policy_that_leaps_is_stopped_before_another_backward_pass():
    # After a step of 100 the ratios overflow: exp(100) is beyond float32.
    ppo = make_ppo(epochs=3, policy_lr=100.0, value_epochs=0)
    backward = []
    ppo.policy.actor.weight.register_hook(lambda gradient: backward.append(gradient.norm()))
    metrics = ppo.update(rollout(ppo, reward_for_up))
    assert metrics["policy_epochs"] == 0.5
    assert len(backward) == 1
    assert all(p.grad is None for p in ppo.policy.parameters())


def test_the_base_policy_keeps_what_is_trained_and_nothing_else():
    ppo = make_ppo(kl_base_coef=0.1, policy_lr=1e-2)
    assert set(ppo.base_policy.parameters) == {"actor.weight", "actor.bias"}
    batch = {"observation.state": torch.randn(5, 2), "task": [TASKS[0].instruction] * 5}
    tokens = torch.zeros(5, 7, dtype=torch.int64)
    before = ppo.policy.evaluate_actions(batch, tokens, temperature=0.7)["log_prob"].detach()
    ppo.update(rollout(ppo, reward_for_up))
    after = ppo.policy.evaluate_actions(batch, tokens, temperature=0.7)["log_prob"].detach()
    assert not torch.equal(before, after)
    torch.testing.assert_close(ppo.base_policy.log_prob(batch, tokens, 0.7), before)


def test_the_values_inputs_are_made_once_an_update():
    params, made = [], []
    for has_inputs in (False, True):
        policy = DummyPolicy()
        if has_inputs:
            policy.value_inputs = lambda batch: made.append(len(batch["task"])) or batch
        ppo = make_ppo(policy=policy, value_epochs=5, epochs=1)
        ppo.update(rollout(ppo, reward_for_up))
        params.append(flat(policy.parameters()))
    assert sum(made) == 16 * 8
    torch.testing.assert_close(*params)


@pytest.mark.parametrize(
    ("config", "options", "flag"),
    [
        (PPOConfig, {"lr_schedule": "cosine"}, "lr_schedule"),
        (PPOConfig, {"target_kl": None}, "target_kl"),
        (PPOConfig, {"value_lr": math.nan}, "value_lr"),
        (PaperPPOConfig, {"minibatch_size": 0}, "minibatch_size"),
        (PPOConfig, {"policy_lr": 2e-3}, "policy_lr"),
        (PPOConfig, {"policy_lr": 1e-7, "lr_schedule": "kl_step"}, "policy_lr"),
        (PPOConfig, {"denoising_discount": 0.5, "noise_steps": 2}, "noise_steps"),
        (SteeringConfig, {"num_target_critics": 9}, "num_target_critics"),
        (ImitationConfig, {"demos_share": 0.5}, "demos_share"),
    ],
)
def test_settings_that_would_learn_something_else_are_refused(config, options, flag):
    with pytest.raises(ValueError, match=rf"--algorithm\.{flag}"):
        config(**options)
