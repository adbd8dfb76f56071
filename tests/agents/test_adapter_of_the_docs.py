"""The adapter that docs/extending.md shows, word for word, around a policy of no type that is known."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from cronos_lerobot.agents.adapters.registry import ADAPTERS, AdapterOptions, make_trainable
from cronos_lerobot.agents.base import check_trainable


class Mine(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 3)
        action, state = SimpleNamespace(shape=(3,)), SimpleNamespace(shape=(4,))
        self.config = SimpleNamespace(type="mine", action_feature=action, robot_state_feature=state)

    def mean(self, batch):
        return self.layer(batch["observation.state"])


def test_it_makes_a_policy_trainable():
    docs = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    (code,) = re.findall(r"```python\n([^`]*class MineAdapter[^`]*)```", docs)
    policy, batch = Mine(), {"observation.state": torch.randn(5, 4)}
    try:
        exec(code, {})
        adapter = make_trainable(policy, AdapterOptions(noise_std=0.2))
    finally:
        ADAPTERS.pop("mine", None)
    check_trainable(adapter)
    sample = adapter.sample_actions(batch, generator=torch.Generator().manual_seed(1))
    again = adapter.evaluate_actions(batch, sample["trace"])
    assert sample["actions"].shape == (5, 1, 3)
    torch.testing.assert_close(again["log_prob"], sample["log_prob"])
    # Of a normal distribution with deviation .2: .5 log(2 pi e .04).
    assert again["entropy"].tolist() == pytest.approx([-0.1905] * 5, abs=1e-3)
    still = adapter.sample_actions(batch, temperature=0.0)["actions"][:, 0]
    torch.testing.assert_close(still, policy.mean(batch), atol=1e-4, rtol=0)
    groups = {group["name"]: group["params"] for group in adapter.rl_parameter_groups()}
    assert {id(p) for p in policy.parameters()} < {id(p) for p in groups["policy"]}
    assert set(adapter.own_parameters()) == {"log_std", "critic.weight", "critic.bias"}
