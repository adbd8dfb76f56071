"""Policies that PEFT wraps, as `lerobot-train --peft.*` does it."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dummies import identity_processors
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig
from lerobot.policies.factory import get_policy_class
from peft import PeftModel
from test_act_adapter import make_act
from test_diffusion_adapter import make_diffusion
from test_imitation_agent import learn, make_imitating
from test_vla_adapters import OPTIONS, STATISTICS, TEXTS, generator, one_update
from tiny_pi0 import tiny_gemma
from tiny_pocketvla import make_pocketvla
from tiny_vlas import CHUNK, KINDS, PADDED, PLAYED, make_batch, make_processors, make_vla, save_vla

from cronos_lerobot.agents.adapters.registry import make_trainable
from cronos_lerobot.agents.base import missing_methods
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.processing import make_processors as around
from cronos_lerobot.agents.weights import load_weights, save_policy, unwrapped, weights_file, wrap
from cronos_lerobot.evaluation.actors import SamplingPolicy, make_actor


def load_as_lerobot(kind, base, adapters):
    """As LeRobot's `make_policy` does it."""
    config = PreTrainedConfig.from_pretrained(adapters)
    assert config.use_peft
    with tiny_gemma():
        loaded = get_policy_class(kind).from_pretrained(base, config=config)
    return PeftModel.from_pretrained(loaded, adapters, is_trainable=True).eval()


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
    loaded = load_as_lerobot(kind, base, tmp_path / "adapters")
    assert loaded.peft_config["default"].base_model_name_or_path == str(base)
    chunk = loaded.predict_action_chunk(dict(batch), noise=noise)
    np.testing.assert_allclose(chunk[:, :PLAYED].numpy(), actions.numpy(), atol=1e-6)
    with torch.no_grad():
        for param in loaded.parameters():
            param += param.requires_grad
    assert not torch.allclose(loaded.predict_action_chunk(dict(batch), noise=noise), chunk)
    load_weights(loaded, tmp_path / "adapters")
    assert torch.equal(loaded.predict_action_chunk(dict(batch), noise=noise), chunk)


SMALL = {"act": (make_act, ["linear1", "linear2"]), "diffusion": (make_diffusion, ["cond_encoder.1"])}
"""Policies that do not say themselves which layers get adapters, and some of their layers."""


def make_wrapped(kind, folder):
    """A small policy with adapters that do something, and what its weights are."""
    make, layers = SMALL[kind]
    policy = make()
    policy.save_pretrained(folder)
    policy.config.pretrained_path = folder
    before = {name: param.detach().clone() for name, param in policy.state_dict().items()}
    wrapped = wrap(policy, PeftConfig(target_modules=layers, r=2, lora_alpha=4)).eval()
    with torch.no_grad():
        for name, param in wrapped.named_parameters():
            if "lora_B" in name:
                param.normal_(std=0.3)
    return wrapped, before


def assert_only_adapters_moved(wrapped, before, adapters):
    for name, param in unwrapped(wrapped).state_dict().items():
        if "lora_" not in name:
            assert torch.equal(param, before[name.replace(".base_layer", "")]), name
    moved = {
        name for name, param in wrapped.named_parameters() if not torch.equal(param, adapters.get(name, param))
    }
    assert moved
    assert all(".lora_" in name for name in moved)


def trained(wrapped):
    return {name: param.detach().clone() for name, param in wrapped.named_parameters() if param.requires_grad}


@pytest.mark.parametrize("kind", SMALL)
def test_imitation_trains_adapters_only(kind, tmp_path):
    wrapped, before = make_wrapped(kind, tmp_path)
    adapters = trained(wrapped)
    agent = make_imitating(wrapped, PolicyProcessors(*identity_processors()), ema_decay=0.5)
    metrics = learn(agent)
    assert metrics["optimizer_steps"] == 1
    assert metrics["grad_norm"] > 0
    assert_only_adapters_moved(wrapped, before, adapters)
    # A checkpoint has the average's adapters, not another copy of what is frozen.
    assert dict(wrapped.named_parameters()).keys() & agent.state_dict()["learner"].keys() == adapters.keys()


def test_adapters_around_a_policy_that_trains_by_itself_leave_it_one(tmp_path):
    """The methods are those of the policy below; `isinstance` of the protocol does not see them."""
    policy = make_pocketvla("gaussian")
    assert missing_methods(torch.nn.Linear(1, 1))
    policy.config.pretrained_path = tmp_path
    wrapped = wrap(policy, PeftConfig(r=2, target_modules="all-linear"))
    assert isinstance(wrapped, PeftModel)
    assert not missing_methods(wrapped)
    assert make_trainable(wrapped, OPTIONS) is wrapped
    assert isinstance(make_actor(wrapped, PolicyProcessors(*identity_processors()), 0.5, 7), SamplingPolicy)
    # What decides in a policy's place needs no more than this.
    acting = SimpleNamespace(sample_actions=wrapped.sample_actions)
    actor = make_actor(acting, PolicyProcessors(*identity_processors()), 0.5, 7)
    assert isinstance(actor, SamplingPolicy)
    sizes = {"agent_pos": policy.config.robot_state_feature, "environment_state": policy.config.env_state_feature}
    seen = {name: np.zeros((2, *feature.shape), np.float32) for name, feature in sizes.items() if feature}
    actor.begin(np.arange(2), [(0, 0), (0, 1)])
    assert actor.act(seen, TEXTS, np.arange(2)).action.shape == (2, 7)
