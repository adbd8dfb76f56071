"""What is trained of a policy in bfloat16 has float32, and none of it is rounded on the way."""

from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file

from cronos_lerobot.agents.weights import train_in_float32


class Mixed(torch.nn.Module):
    """As SmolVLA is made: all of it in bfloat16, and a part of it frozen."""

    def __init__(self, kind):
        super().__init__()
        self.config = SimpleNamespace(type=kind)
        self.trained = torch.nn.Linear(3, 2, bias=False, dtype=torch.bfloat16)
        self.frozen = torch.nn.Linear(3, 2, bias=False, dtype=torch.bfloat16).requires_grad_(False)


@pytest.mark.parametrize(("kind", "dtype"), [("smolvla", torch.float32), ("other", torch.bfloat16)])
def test_small_steps_of_a_checkpoint_survive_its_loading(tmp_path, kind, dtype):
    # 1 + 2^-12 is 1 in bfloat16, which has 7 bits after the first.
    trained, frozen = torch.full((2, 3), 1 + 2**-12), torch.ones(2, 3)
    save_file({"trained.weight": trained, "frozen.weight": frozen}, tmp_path / "model.safetensors")
    policy = Mixed(kind)
    policy.load_state_dict({"trained.weight": trained, "frozen.weight": frozen})
    assert policy.trained.weight.float().eq(1).all(), "LeRobot's own loading rounds"
    train_in_float32(policy, tmp_path)
    assert (policy.trained.weight.dtype, policy.frozen.weight.dtype) == (dtype, torch.bfloat16)
    assert policy.trained.weight.float().equal(trained) == (kind == "smolvla")
