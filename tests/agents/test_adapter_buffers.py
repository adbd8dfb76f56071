"""Buffers that an adapter of one's own saves are in a run's checkpoint, as its parameters are."""

from types import SimpleNamespace

import pytest
import torch
from torch import nn

from cronos_lerobot.agents.adapters.registry import Adapter


class CountingAdapter(Adapter):
    def __init__(self):
        policy = nn.BatchNorm1d(2)
        policy.config = SimpleNamespace(type="mine")
        super().__init__(policy)
        self.critic = nn.Sequential(nn.BatchNorm1d(2, affine=False), nn.Linear(2, 1))
        self.register_buffer("count", torch.tensor(0))
        self.register_buffer("scratch", torch.zeros(3), persistent=False)


def test_they_go_in_both_directions():
    adapter = CountingAdapter()
    adapter.count += 5
    adapter.critic[0].train()(torch.tensor([[1.0, 2.0], [3.0, 6.0]]))
    own = adapter.own_parameters()
    statistics = {f"critic.0.{name}" for name in ("running_mean", "running_var", "num_batches_tracked")}
    assert set(own) == {"critic.1.weight", "critic.1.bias", "count", *statistics}
    resumed = CountingAdapter()
    resumed.load_own_parameters({name: tensor.clone() for name, tensor in own.items()})
    assert resumed.count == 5
    # A tenth of the means 2 and 4.
    assert resumed.critic[0].running_mean.tolist() == pytest.approx([0.2, 0.4])
    assert torch.equal(resumed.critic[1].weight, adapter.critic[1].weight)
    # Those of the first process are copied in place.
    own["count"].fill_(7)
    assert adapter.count == 7
