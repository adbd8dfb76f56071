"""SmolVLA, pi0 and pi0.5 as policies that PPO can train, against LeRobot's own classes on tiny checkpoints."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tiny_vlas import (
    CHUNK,
    DIMS,
    KINDS,
    PADDED,
    PLAYED,
    STATE,
    STEPS,
    make_batch,
    make_vla,
)

from cronos_lerobot.agents.adapters.registry import AdapterOptions, make_trainable
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.weights import train_in_float32

OPTIONS = AdapterOptions(noise_level=0.8)
THAWED = {"smolvla": {"train_expert_only": False, "freeze_vision_encoder": False}}
"""What makes the vision-language model trainable; that of pi0 is by default."""
FROZEN = {"train_expert_only": True, "freeze_vision_encoder": True}
NOISE = (3, CHUNK, PADDED)


def generator(seed=2):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def adapter(kind, tmp_path):
    return make_trainable(make_vla(kind, tmp_path, **THAWED.get(kind, {})), OPTIONS)


@torch.no_grad()
def test_without_noise_it_acts_as_lerobots_select_action(adapter):
    batch, noise = make_batch(), torch.randn(NOISE, generator=generator())
    actions = adapter.sample_actions(batch, temperature=0, noise=noise)["actions"]
    assert adapter.decision_steps == PLAYED
    assert actions.shape == (3, PLAYED, DIMS)
    chunk = adapter.policy.predict_action_chunk(dict(batch), noise=noise)
    assert torch.equal(actions, chunk[:, :PLAYED])
    # Its noise comes from LeRobot's own source, and the chunk is played one by one.
    torch.manual_seed(7)
    noise = torch.randn(NOISE)
    torch.manual_seed(7)
    adapter.policy.reset()
    played = torch.stack([adapter.policy.select_action(dict(batch)) for _ in range(PLAYED)], 1)
    assert torch.equal(adapter.sample_actions(batch, temperature=0, noise=noise)["actions"], played)
    assert not torch.equal(played[0], played[1])


def test_likelihoods_do_not_depend_on_the_batch(adapter):
    batch = make_batch()
    with torch.inference_mode():
        sample = adapter.sample_actions(batch, generator=generator())
    trace, log_prob = sample["trace"].clone(), sample["log_prob"].clone()
    assert trace.shape == (3, STEPS, CHUNK, PADDED)
    assert log_prob.shape == (3, STEPS - 1)
    assert log_prob.unique().numel() == 3 * (STEPS - 1)
    torch.testing.assert_close(adapter.evaluate_actions(batch, trace)["log_prob"], log_prob, atol=1e-4, rtol=0)
    for rows in ([1], [2, 0]):
        some = {key: v[rows] if isinstance(v, torch.Tensor) else [v[i] for i in rows] for key, v in batch.items()}
        # A tokenizer pads to the longest of the batch.
        longest = int(some["observation.language.attention_mask"].sum(1).max())
        for name in ("observation.language.tokens", "observation.language.attention_mask"):
            some[name] = some[name][:, :longest]
        again = adapter.evaluate_actions(some, trace[rows])
        torch.testing.assert_close(again["log_prob"], log_prob[rows], atol=1e-4, rtol=0)


def test_gradients_are_finite_differences(adapter):
    batch = make_batch()
    with torch.no_grad():
        trace = adapter.sample_actions(batch, generator=generator())["trace"]

    def log_prob():
        return adapter.evaluate_actions(batch, trace)["log_prob"].double().sum()

    log_prob().backward()
    params = {name: p for name, p in adapter.policy.named_parameters() if p.grad is not None and p.grad.any()}
    # Of the action expert, and through the cache of keys and values of the language model and the image encoder.
    for part in (
        "action_in_proj", "action_out_proj", r"expert\.(model\.)?layers\.1\.mlp",
        r"(text|language)_model\.layers\.0\.self_attn\.k_proj", "vision_.*mlp",
    ):  # fmt: skip
        name = next(name for name in params if re.search(part, name) and "weight" in name)
        param = params[name]
        direction = param.grad / param.grad.norm()
        step = min(2e-2, 0.05 / param.grad.norm().item())
        ends = []
        with torch.no_grad():
            for sign in (1, -2):
                param += sign * step * direction
                ends.append(log_prob().item())
            param += step * direction
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(param.grad.norm().item(), rel=2e-2), name


def test_what_lerobot_freezes_stays_frozen(kind, tmp_path):
    """Without a gradient, then, where nothing of the prefix is trained."""
    batch = make_batch()
    for options in (FROZEN, FROZEN | {"train_state_proj": False} if kind == "smolvla" else FROZEN):
        adapter = make_trainable(make_vla(kind, tmp_path, **options), OPTIONS)
        trained = {id(p) for p in adapter.rl_parameter_groups()[0]["params"]}
        names = {name for name, p in adapter.named_parameters() if id(p) in trained}
        assert not [name for name in names if "vlm." in name or "paligemma." in name]
        assert [name for name in names if "expert" in name]
        assert [name for name in names if "action_out_proj" in name]
        prefix_is_trained = kind == "smolvla" and "train_state_proj" not in options
        assert any("state_proj" in name for name in names) == (prefix_is_trained or kind == "pi0")
        context, features = adapter.observe(batch)
        assert context.hidden.requires_grad == prefix_is_trained
        assert not features.requires_grad
        trace = adapter.sample_actions(batch, generator=generator())["trace"].detach()
        adapter.evaluate_actions(batch, trace)["log_prob"].sum().backward()
        without = {name for name, p in adapter.named_parameters() if id(p) in trained and p.grad is None}
        assert not [name for name in without if "lm_head" not in name], without


def test_the_critic_sees_the_picture_the_instruction_and_the_state(adapter):
    batch = make_batch()
    torch.nn.init.normal_(adapter.critic.layers[-1].weight)
    adapter.predict_values(batch).sum().backward()
    assert all(p.grad is None for p in adapter.policy.parameters())
    with torch.no_grad():
        value = adapter.predict_values(batch)
        torch.testing.assert_close(adapter.predict_values(adapter.value_inputs(batch)), value)
        torch.testing.assert_close(adapter.sample_actions(batch)["value"], value)
        for name in ("observation.state", "observation.images.front", "observation.language.tokens"):
            other = batch | {name: batch[name].flip(0)}
            assert (adapter.predict_values(other) - value)[0].abs() > 1e-4, name


class Mixed(torch.nn.Module):
    """As SmolVLA is made: all of it in bfloat16, and a part of it frozen."""

    def __init__(self, policy_type):
        super().__init__()
        self.config = SimpleNamespace(type=policy_type)
        self.trained = torch.nn.Linear(3, 2, bias=False, dtype=torch.bfloat16)
        self.frozen = torch.nn.Linear(3, 2, bias=False, dtype=torch.bfloat16).requires_grad_(False)


@pytest.mark.parametrize(("policy_type", "dtype"), [("smolvla", torch.float32), ("other", torch.bfloat16)])
def test_small_steps_of_a_checkpoint_survive_its_loading(tmp_path, policy_type, dtype):
    # 1 + 2^-12 is 1 in bfloat16, which has 7 bits after the first.
    trained, frozen = torch.full((2, 3), 1 + 2**-12), torch.ones(2, 3)
    save_file({"trained.weight": trained, "frozen.weight": frozen}, tmp_path / "model.safetensors")
    policy = Mixed(policy_type)
    policy.load_state_dict({"trained.weight": trained, "frozen.weight": frozen})
    assert policy.trained.weight.float().eq(1).all(), "LeRobot's own loading rounds"
    train_in_float32(policy, tmp_path)
    assert (policy.trained.weight.dtype, policy.frozen.weight.dtype) == (dtype, torch.bfloat16)
    assert policy.trained.weight.float().equal(trained) == (policy_type == "smolvla")


STATISTICS = {
    "observation.state": {name: np.full(STATE, v, np.float32) for name, v in (("mean", 0.5), ("std", 2.0))},
    "action": {name: np.full(DIMS, v, np.float32) for name, v in (("mean", -0.5), ("std", 0.1))},
}
for stats in STATISTICS.values():
    stats |= {"q01": stats["mean"] - 2 * stats["std"], "q99": stats["mean"] + 2 * stats["std"]}
TEXTS = ["put the cup on the plate", "put 3 in 4"]


def observe(seed):
    rng = np.random.default_rng(seed)
    image = rng.integers(256, size=(2, 32, 32, 3), dtype=np.uint8)
    return {"pixels": {"front": image}, "agent_pos": rng.normal(size=(2, STATE)).astype(np.float32)}


def one_update(adapter, processors):
    """PPO's agent on made-up streams: four decisions of two streams, paid for their first action."""
    config = PPOConfig(epochs=1, value_warmup_updates=0, minibatch_size=8, ratio="factor", policy_lr=1e-3)
    ppo = PPO(adapter, processors, config, np.random.default_rng(0))
    agent = PPOAgent(ppo, RolloutBuffer(4, 2), generator())
    nobody = np.zeros(2, bool)
    for step in range(4 * PLAYED):
        sample = agent.act(observe(step), TEXTS)
        cut = np.full(2, step == 4 * PLAYED - 1)
        agent.store(observe(step), TEXTS, sample, sample.action[:, 0], observe(step + 1), cut, nobody)
    return agent.update()
