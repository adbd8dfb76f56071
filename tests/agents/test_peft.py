"""Policies that PEFT wraps, as `lerobot-train --peft.*` does it."""

import json
import os
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dummies import identity_processors
from huggingface_hub import HfApi
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig
from lerobot.policies.factory import get_policy_class
from lerobot_env_cronos import CronosEnvConfig
from peft import PeftModel
from test_act_adapter import make_act
from test_diffusion_adapter import HORIZON, make_diffusion
from test_imitation_agent import learn, make_imitating
from test_self_imitation import make_pocketvla
from test_vla_adapters import OPTIONS, STATISTICS, TEXTS, generator, one_update
from tiny_pi0 import tiny_gemma
from tiny_vlas import CHUNK, KINDS, PADDED, PLAYED, make_batch, make_processors, make_vla, save_vla

from cronos_lerobot.agents.adapters.registry import make_trainable
from cronos_lerobot.agents.base import is_trainable
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.processing import make_processors as around
from cronos_lerobot.agents.weights import load_weights, save_policy, unwrapped, weights_file, wrap
from cronos_lerobot.evaluation.actors import SamplingPolicy, make_actor
from cronos_lerobot.scripts.train import push_to_hub
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import check_adapters


def load_as_lerobot(kind, base, adapters):
    """As LeRobot's `make_policy` does it."""
    config = PreTrainedConfig.from_pretrained(adapters)
    assert config.use_peft
    with tiny_gemma():
        loaded = get_policy_class(kind).from_pretrained(base, config=config)
    return PeftModel.from_pretrained(loaded, adapters, is_trainable=True).eval()


def test_adapters_are_pushed_with_the_policys_config(tmp_path, monkeypatch):
    """`push_to_hub` is a flag of it, too."""
    policy = make_vla(KINDS[0], tmp_path)
    policy.config.pretrained_path = "me/base"
    wrapped = wrap(policy, PeftConfig(r=2))
    created, pushed, card = [], [], []

    def upload(self, folder_path, repo_id, **options):
        pushed.extend((repo_id, name) for name in os.listdir(folder_path))
        card.append((folder_path / "README.md").read_text())

    monkeypatch.setattr(HfApi, "create_repo", lambda self, repo_id, **kw: created.append((repo_id, kw["private"])))
    monkeypatch.setattr(HfApi, "list_repo_files", lambda self, repo_id, **kw: [])
    monkeypatch.setattr(HfApi, "upload_folder", upload)
    config = CronosTrainConfig(CronosEnvConfig(scene="playroom_2x2"), policy.config, save_checkpoint=False)
    config.policy.push_to_hub, config.policy.repo_id, config.policy.private = True, "me/lora", True
    config.policy.license, config.policy.tags = "mit", ["mine"]

    def save(folder):
        save_policy(wrapped, folder)
        # The tiny one has three actions, those of the robot are seven.
        saved = json.loads((folder / "config.json").read_text())
        saved["output_features"]["action"]["shape"] = [7]
        (folder / "config.json").write_text(json.dumps(saved))

    push_to_hub(config, SimpleNamespace(save_pretrained=save), *identity_processors())
    assert created == [("me/lora", True)]
    files = {"adapter_config.json", "adapter_model.safetensors", "config.json", "train_config.json", "README.md"}
    assert {("me/lora", name) for name in files} <= set(pushed)
    assert ("me/lora", "model.safetensors") not in pushed
    # Whoever evaluates it must be told the scene: policies of two scenes may look alike.
    head, text = card[0].split("---", 2)[1:]
    assert "license: mit" in head
    assert "- mine" in head
    assert "--env.scene=playroom_2x2" in text


def test_adapters_are_refused_twice_and_where_they_would_name_a_folder(tmp_path):
    policy = make_vla(KINDS[0], tmp_path)
    policy.config.pretrained_path, policy.config.repo_id = tmp_path, "me/lora"
    check_adapters(policy, policy.config)
    policy.config.push_to_hub = True
    with pytest.raises(ValueError, match=rf"repo_id=me/lora: .* folder {tmp_path}\. Give --policy\.push"):
        check_adapters(policy, policy.config)
    policy.config.pretrained_path = "me/base"
    check_adapters(policy, policy.config)
    with pytest.raises(ValueError, match=r"--policy\.path=me/base has adapters.*: leave --peft"):
        check_adapters(wrap(policy, PeftConfig(r=2)), policy.config)


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


def select(policy, batch, **noise):
    """The first actions of a new episode (B, n, A), by LeRobot's `select_action`."""
    policy.reset()
    steps = policy.config.n_action_steps
    return torch.stack([policy.select_action(dict(batch), **noise) for _ in range(steps)], 1)


@pytest.mark.parametrize("kind", SMALL)
def test_ppo_trains_adapters_in_policies_without_defaults(kind, tmp_path):
    wrapped, before = make_wrapped(kind, tmp_path / "base")
    adapter = make_trainable(wrapped, OPTIONS)
    batch = {"observation.state": torch.randn(2, 5), "observation.environment_state": torch.randn(2, 6)}
    noise = {"noise": torch.randn(2, HORIZON, 3, generator=generator())} if kind == "diffusion" else {}
    with torch.no_grad():
        actions = adapter.sample_actions(batch, temperature=0, **noise)["actions"]
        torch.testing.assert_close(actions, select(wrapped, batch, **noise))
        with wrapped.disable_adapter():
            assert not torch.allclose(actions, adapter.sample_actions(batch, temperature=0, **noise)["actions"])
        sample = adapter.sample_actions(batch, generator=generator())
    evaluated = adapter.evaluate_actions(batch, sample["trace"])
    torch.testing.assert_close(evaluated["log_prob"], sample["log_prob"], atol=1e-4, rtol=0)
    (evaluated["log_prob"].sum() + evaluated["value"].sum()).backward()
    learning = {name for name, param in adapter.named_parameters() if param.grad is not None}
    own = set(adapter.own_parameters())
    assert own <= learning
    # The encoder of ACT's latent has adapters too, which acting does not use.
    lora = {name for name, _ in adapter.named_parameters() if ".lora_" in name and ".vae_encoder" not in name}
    assert learning - own == lora
    assert all(param.grad.any() for name, param in adapter.named_parameters() if name in lora)
    groups = {id(param) for group in adapter.rl_parameter_groups() for param in group["params"]}
    assert {name for name, param in adapter.named_parameters() if id(param) in groups} == learning
    adapter.zero_grad()

    adapters = trained(wrapped)
    config = PPOConfig(epochs=1, value_warmup_updates=0, minibatch_size=8, ratio="factor", policy_lr=1e-3)
    processors = PolicyProcessors(*identity_processors())
    ppo = PPO(adapter, processors, config, np.random.default_rng(0))
    agent = PPOAgent(ppo, RolloutBuffer(4, 2), generator())
    seen = {"agent_pos": batch["observation.state"], "environment_state": batch["observation.environment_state"]}
    seen = {name: column.numpy() for name, column in seen.items()}
    steps = 4 * adapter.decision_steps
    for step in range(steps):
        decided = agent.act(seen, TEXTS)
        agent.store(
            seen, TEXTS, decided, decided.action[:, 0], seen, np.full(2, step == steps - 1), np.zeros(2, bool)
        )
    assert agent.update()["ratio_max"] == pytest.approx(1, abs=1e-4)
    assert_only_adapters_moved(wrapped, before, adapters)

    with torch.no_grad():
        actions = select(wrapped, batch, **noise)
        save_policy(wrapped, tmp_path / "adapters")
        loaded = load_as_lerobot(kind, tmp_path / "base", tmp_path / "adapters")
        torch.testing.assert_close(select(loaded, batch, **noise), actions)
        # A run that goes on has what is beside the policy as well.
        resumed = make_trainable(loaded, OPTIONS)
        resumed.load_own_parameters({name: param.clone() for name, param in adapter.own_parameters().items()})
        again = resumed.evaluate_actions(batch, sample["trace"])
        now = adapter.evaluate_actions(batch, sample["trace"])
    assert not torch.equal(now["value"], evaluated["value"])
    for name in ("log_prob", "value"):
        torch.testing.assert_close(again[name], now[name])


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


def test_a_policy_from_scratch_is_not_wrapped(tmp_path):
    with pytest.raises(ValueError, match=r"Supply a `policy\.pretrained_path`"):
        wrap(make_vla("pi0", tmp_path), PeftConfig())


def test_methods_that_are_none_or_take_less_are_named(tmp_path):
    policy = make_vla(KINDS[0], tmp_path)
    policy.config.pretrained_path = tmp_path
    with pytest.raises(ValueError, match=r"--peft\.method_type=LOAR is no method of PEFT; valid .*, LORA, "):
        wrap(policy, PeftConfig(method_type="LOAR"))
    with pytest.raises(ValueError, match=r"--peft\.method_type=IA3 does not take all .*argument 'r'\); LORA does"):
        wrap(policy, PeftConfig(method_type="IA3"))
    assert any(param.requires_grad for param in policy.parameters())


def test_adapters_around_a_policy_that_trains_by_itself_leave_it_one(tmp_path):
    """The methods are those of the policy below; `isinstance` of the protocol does not see them."""
    policy = make_pocketvla("gaussian")
    assert not is_trainable(torch.nn.Linear(1, 1))
    policy.config.pretrained_path = tmp_path
    wrapped = wrap(policy, PeftConfig(r=2, target_modules="all-linear"))
    assert isinstance(wrapped, PeftModel)
    assert is_trainable(wrapped)
    assert make_trainable(wrapped, OPTIONS) is wrapped
    assert isinstance(make_actor(wrapped, PolicyProcessors(*identity_processors()), 0.5), SamplingPolicy)
    # What decides in a policy's place needs no more than this.
    acting = SimpleNamespace(sample_actions=wrapped.sample_actions)
    actor = make_actor(acting, PolicyProcessors(*identity_processors()), 0.5)
    assert isinstance(actor, SamplingPolicy)
    sizes = {"agent_pos": policy.config.robot_state_feature, "environment_state": policy.config.env_state_feature}
    seen = {name: np.zeros((2, *feature.shape), np.float32) for name, feature in sizes.items() if feature}
    assert actor.act(seen, TEXTS, np.full((2, 7), 0.5, np.float32), np.arange(2)).shape == (2, 7)
