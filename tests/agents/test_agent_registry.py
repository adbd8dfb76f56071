"""Agents by name."""

from types import SimpleNamespace

import pytest
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from cronos_lerobot.agents import builtin, registry
from cronos_lerobot.agents.imitation.config import DemosConfig, ImitationConfig
from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig, SelfImitationConfig
from cronos_lerobot.agents.steering.config import SteeringConfig

assert builtin

DEMOS = DemosConfig("me/demos")


def test_a_name_is_taken_once_and_needs_a_config_to_be_offered(monkeypatch):
    monkeypatch.setattr(registry, "AGENTS", dict(registry.AGENTS))
    made = registry.register_agent("of_a_test")(lambda context: ("made of", context))
    context = SimpleNamespace(config=SimpleNamespace(type="of_a_test"))
    assert registry.make_agent(context) == ("made of", context)
    assert registry.AGENTS["of_a_test"] is made
    # LeRobot's own algorithm has a config and no agent here, this one an agent and no config.
    assert {"ppo", "ppo_paper"} <= set(registry.agent_names())
    assert not {"sac", "of_a_test"} & set(registry.agent_names())
    with pytest.raises(ValueError, match=r"there is an agent 'ppo' already; taken names: \[.*'of_a_test', 'ppo'"):
        registry.register_agent("ppo")(made)
    with pytest.raises(ValueError, match=r"--algorithm\.type must be one of \[.*'ppo_paper'.*\], got 'sac'"):
        registry.check_agent("sac")


def test_every_agent_of_this_package_has_a_config():
    assert set(registry.AGENTS) <= set(RLAlgorithmConfig.get_known_choices())


@pytest.mark.parametrize(
    ("config", "needs"),
    [
        (PPOConfig(value_loss="mse", huber_delta=3.0), {"huber_delta": "value_loss=huber"}),
        (PPOConfig(lr_schedule="fixed", lr_factor=2.0), {"lr_factor": "lr_schedule of kl_step"}),
        (PPOConfig(lr_schedule="fixed", policy_lr_max=1.0, policy_lr_min=1e-9), {
            "policy_lr_max": "lr_schedule of kl_step", "policy_lr_min": "lr_schedule of kl_step",
        }),
        (PPOConfig(lr_schedule="fixed", kl_stop_factor=None, target_kl=0.1), {"target_kl": "kl_stop_factor"}),
        (PaperPPOConfig(kl_stop_factor=3.0), {"kl_stop_factor": "target_kl"}),
        (PPOConfig(self_imitation=SelfImitationConfig(max_age=3)), {"self_imitation.max_age": "imitation.coef"}),
        (PPOConfig(self_imitation=SelfImitationConfig(0.1, max_age=3), demos_share=1.0, demos=DEMOS), {
            "self_imitation.max_age": "demos_share below 1",
        }),
        (ImitationConfig(warmup_segments=3, demos_share=0.5, demos=DEMOS), {"warmup_segments": "demos_share=0"}),
        (
            ImitationConfig(demos_share=1.0, demos=DEMOS, weighting="advantage", memory_gib=1.0, tail_steps=9),
            dict.fromkeys(("weighting", "memory_gib", "tail_steps"), "demos_share below 1"),
        ),
        (ImitationConfig(gamma=0.5, max_weight=2.0), {"gamma": "weighting of return", "max_weight": "=advantage"}),
        (ImitationConfig(weighting="return", weighting_beta=1.0, max_weight=2.0), {"max_weight": "=advantage"}),
    ],
)  # fmt: skip
def test_settings_that_nothing_reads_are_refused_where_they_are_given(config, needs):
    for name, needed in needs.items():
        with pytest.raises(ValueError, match=rf"--algorithm\.{name}=.* has no effect here: it needs .*{needed}"):
            registry.check_settings(config, ["beta1", name], resume=True)
    # A run that is resumed may have them of another setting that it had.
    registry.check_settings(config, [name for name in vars(config) if name not in needs], resume=True)


@pytest.mark.parametrize(
    ("config", "given"),
    [
        (PPOConfig(huber_delta=3.0, lr_factor=2.0), ["huber_delta", "lr_factor", "epochs"]),
        (PPOConfig(self_imitation=SelfImitationConfig(0.1, max_age=3)), ["self_imitation.max_age"]),
        (PPOConfig(lr_schedule="fixed", target_kl=0.1), ["target_kl"]),
        (
            PaperPPOConfig(target_kl=None),
            ["target_kl", "lr_factor", "self_imitation.tail_steps"],
        ),
        (PaperPPOConfig(kl_stop_factor=None), ["kl_stop_factor"]),
        (ImitationConfig(weighting="advantage", max_weight=2.0, gamma=0.5), ["max_weight", "gamma"]),
        (SteeringConfig(gamma=0.5), ["gamma"]),
    ],
)
def test_settings_that_are_read_may_be_given_and_defaults_everywhere(config, given):
    registry.check_settings(config, given, resume=False)


def test_every_setting_that_may_be_unread_is_one():
    for config in (PPOConfig(value_loss="mse", lr_schedule="fixed", kl_stop_factor=None, target_kl=None),
                   PPOConfig(demos_share=1.0, demos=DEMOS, self_imitation=SelfImitationConfig(0.1)),
                   ImitationConfig(demos_share=0.5, demos=DEMOS), ImitationConfig()):  # fmt: skip
        assert config.unread
        registry.check_settings(config, config.unread, resume=False)
