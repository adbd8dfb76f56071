import logging

import numpy as np
import pytest
from ppo_samples import make_ppo, reward_for_up, rollout

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.learning_rate import adapted_lr, target_kl


def test_adaptive_learning_rate():
    config = PPOConfig(lr_factor=2.0, policy_lr_min=3e-5, policy_lr_max=3e-4)
    assert adapted_lr(1e-4, 0.09, 0.04, config) == pytest.approx(5e-5)
    assert adapted_lr(1e-4, 0.05, 0.04, config) == 1e-4
    assert adapted_lr(1e-4, 0.01, 0.04, config) == pytest.approx(2e-4)
    assert adapted_lr(4e-5, 0.09, 0.04, config) == 3e-5
    assert adapted_lr(2e-4, 0.01, 0.04, config) == 3e-4


def test_target_kl_halves_after_so_many_updates():
    config = PPOConfig(target_kl=0.08, kl_decay_updates=4)
    assert [target_kl(config, updates) for updates in (0, 1, 4, 12)] == pytest.approx([0.08, 0.064, 0.04, 0.02])
    assert target_kl(PPOConfig(target_kl=0.08), 12) == 0.08


def test_the_learning_rate_follows_the_falling_target():
    """The same update is far below the target that stays, and far above the one that fell."""
    options = {"epochs": 1, "policy_lr": 1e-2, "policy_lr_max": 1.0, "kl_stop_factor": None, "target_kl": 0.05}
    options |= {"lr_schedule": "kl_update"}
    ends = []
    for decay in (None, 1e-6):
        ppo = make_ppo(kl_decay_updates=decay, **options)
        for _ in range(2):
            before = ppo.policy_lr
            ppo.update(rollout(ppo, reward_for_up))
        ends.append(ppo.policy_lr / before)
    assert ends[0] > 1 > ends[1]


def test_lr_holds_where_there_is_no_gradient_and_a_warning_says_so_once(caplog):
    ppo = make_ppo(policy_lr=5e-5)
    # The value of the dummy policy is no constant; what is not rewarded shall be as good as expected.
    ppo.policy.critic.weight.data.zero_()
    ppo.policy.critic.bias.data.zero_()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            metrics = ppo.update(rollout(ppo, lambda sample: np.zeros(len(sample.value))))
    assert metrics["policy_grad_norm"] == 0
    assert ppo.policy_lr == 5e-5
    assert [record.message for record in caplog.records if "no gradient" in record.message] == [
        "The policy got no gradient: no reward told one action from another in this update. Its learning rate "
        "stays at 5e-05."
    ]
    ppo.update(rollout(ppo, reward_for_up))
    assert ppo.policy_lr != 5e-5


def test_an_early_stop_lowers_the_lr_below_twice_the_target_too():
    options = {"epochs": 1, "policy_lr": 1e-3, "value_epochs": 0}
    free = make_ppo(**options, lr_schedule="fixed", target_kl=None)
    # Two steps: the first one is taken from the old policy, the second one sees its divergence from it.
    kl = 2 * free.update(rollout(free, reward_for_up))["approx_kl"]
    ppo = make_ppo(**options, target_kl=kl / 1.5, kl_stop_factor=1.2)
    metrics = ppo.update(rollout(ppo, reward_for_up))
    assert metrics["policy_epochs"] == 0.5
    assert ppo.policy_lr == pytest.approx(1e-3 / 1.5)
