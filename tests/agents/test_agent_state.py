"""What an agent of one's own keeps comes back from a checkpoint as it was, or is refused before it is lost."""

from collections import OrderedDict, deque
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from cronos_lerobot.agents.state import agent_state, as_it_was


def keeping(state):
    return SimpleNamespace(state_dict=lambda: state)


def test_everything_that_is_allowed_comes_back_as_it_was(tmp_path):
    module = nn.BatchNorm1d(2)
    state = {
        "numbers": [1, 2.5, True, None, "text", np.ones(3, np.float32).mean(), np.int64(2**60), np.bool_(True)],
        "arrays": (np.arange(6).reshape(2, 3).T, np.array(1.5), np.zeros((0, 2), bool)),
        7: {"tensor": torch.tensor([1.5], dtype=torch.bfloat16)},
        # A momentum's pair, and a note on the version that PyTorch looks for.
        "optimizer": torch.optim.Adam(module.parameters()).state_dict(),
        "module": module.state_dict(),
        "read_only": np.broadcast_to(np.float32(3), 2),
        "last": OrderedDict(last=np.float64(0.1)),
    }
    torch.save(agent_state(keeping(state)), tmp_path / "agent.pt")
    assert isinstance(state["numbers"][5], np.float32), "what the agent keeps is not touched"
    again = as_it_was(torch.load(tmp_path / "agent.pt", map_location="cpu"))

    assert list(again) == list(state)
    assert again["numbers"] == state["numbers"]
    assert [type(value) for value in again["numbers"]] == [type(value) for value in state["numbers"]]
    assert type(again["arrays"]) is tuple
    for array, was in zip(
        (*again["arrays"], again["read_only"]), (*state["arrays"], state["read_only"]), strict=True
    ):
        assert (array.dtype, array.shape, array.tolist()) == (was.dtype, was.shape, was.tolist())
    assert torch.equal(again[7]["tensor"], state[7]["tensor"])
    assert again["optimizer"] == state["optimizer"]
    assert again["module"]._metadata == state["module"]._metadata
    assert type(again["last"]["last"]) is np.float64


@pytest.mark.parametrize("value", [deque([1]), np.array(["text"]), Path("here")])
def test_what_would_not_come_back_is_named(value):
    with pytest.raises(ValueError, match=r"^SimpleNamespace\.state_dict\(\)\['seen'\]\[1\]"):
        agent_state(keeping({"seen": [0, value]}))
