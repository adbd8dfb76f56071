"""Policies that PEFT wraps, as `lerobot-train --peft.*` does it."""

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig
from lerobot.policies.factory import get_policy_class
from peft import PeftModel
from test_vla_adapters import OPTIONS, STATISTICS, generator, one_update
from tiny_pi0 import tiny_gemma
from tiny_vlas import CHUNK, KINDS, PADDED, PLAYED, make_batch, make_processors, make_vla, save_vla

from cronos_lerobot.agents.adapters.registry import make_trainable
from cronos_lerobot.agents.processing import make_processors as around
from cronos_lerobot.agents.weights import load_weights, save_policy, unwrapped, weights_file, wrap


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_adapters_learn_and_are_saved(kind, tmp_path):
    policy = make_vla(kind, tmp_path)
    pair = make_processors(policy, tmp_path, STATISTICS)
    base = save_vla(policy, pair, tmp_path / "base", tmp_path)
    policy.config.pretrained_path = base
    before = {name: param.clone() for name, param in policy.state_dict().items()}
    wrapped = wrap(policy, PeftConfig(r=2, lora_alpha=4)).eval()
    assert isinstance(wrapped, PeftModel)
    assert wrap(wrapped, PeftConfig(r=8)) is wrapped
    adapter = make_trainable(wrapped, OPTIONS)
    groups = {group["name"]: {id(p) for p in group["params"]} for group in adapter.rl_parameter_groups()}
    names = {name for name, p in adapter.named_parameters() if id(p) in groups["policy"]}
    assert names == {name for name, p in wrapped.named_parameters(prefix="policy") if p.requires_grad}
    assert names
    assert all(".lora_" in name for name in names)
    metrics = one_update(adapter, around(wrapped, *pair))
    assert metrics["ratio_max"] == pytest.approx(1, abs=1e-4)
    for name, param in unwrapped(wrapped).state_dict().items():
        if "lora_" not in name:
            assert torch.equal(param, before[name.replace(".base_layer", "")]), name
    moved = [name for name, p in wrapped.named_parameters() if "lora_B" in name and p.any()]
    assert [name for name in moved if "expert" in name]

    batch, noise = make_batch(), torch.randn((3, CHUNK, PADDED), generator=generator())
    with torch.no_grad():
        actions = adapter.sample_actions(batch, temperature=0, noise=noise)["actions"]
    assert torch.equal(actions, wrapped.predict_action_chunk(dict(batch), noise=noise)[:, :PLAYED])

    save_policy(wrapped, tmp_path / "adapters")
    assert weights_file(wrapped, tmp_path / "adapters").is_file()
    # As LeRobot's `make_policy` loads it.
    config = PreTrainedConfig.from_pretrained(tmp_path / "adapters")
    assert config.use_peft
    with tiny_gemma():
        loaded = get_policy_class(kind).from_pretrained(base, config=config)
    loaded = PeftModel.from_pretrained(loaded, tmp_path / "adapters", is_trainable=True).eval()
    assert loaded.peft_config["default"].base_model_name_or_path == str(base)
    chunk = loaded.predict_action_chunk(dict(batch), noise=noise)
    np.testing.assert_allclose(chunk[:, :PLAYED].numpy(), actions.numpy(), atol=1e-6)
    with torch.no_grad():
        for param in loaded.parameters():
            param += param.requires_grad
    assert not torch.allclose(loaded.predict_action_chunk(dict(batch), noise=noise), chunk)
    load_weights(loaded, tmp_path / "adapters")
    assert torch.equal(loaded.predict_action_chunk(dict(batch), noise=noise), chunk)


def test_a_policy_from_scratch_is_not_wrapped(tmp_path):
    with pytest.raises(ValueError, match=r"Supply a `policy\.pretrained_path`"):
        wrap(make_vla("pi0", tmp_path), PeftConfig())
