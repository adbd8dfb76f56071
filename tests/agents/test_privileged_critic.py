"""A critic on the privileged state beside policies that do not see it."""

import numpy as np
import pytest
import torch
from tiny_vlas import STATE, make_batch, make_processors, make_vla

from cronos_lerobot.agents.adapters.privileged import PrivilegedCritic, text_vector
from cronos_lerobot.agents.adapters.registry import FEATURES, AdapterOptions, make_trainable
from cronos_lerobot.agents.processing import make_processors as around

SHAPES = {"observation.environment_state": (12,), "observation.state": (STATE,), "action": (3,)}
TEXTS = ["put the cup on the plate", "put the plate on the cup", "put the cup on the cloth"]


@pytest.fixture
def adapter(tmp_path):
    torch.manual_seed(0)
    inner = make_trainable(make_vla("smolvla", tmp_path), AdapterOptions())
    critic = PrivilegedCritic(inner, SHAPES)
    torch.nn.init.normal_(critic.critic.layers[-1].weight)
    return critic


def privileged_batch():
    return make_batch() | {"observation.environment_state": torch.randn(3, 12), "task": TEXTS}


def test_the_policy_is_the_adapters_and_the_value_is_of_the_privileged_state(adapter):
    batch = privileged_batch()
    with torch.no_grad():
        sample = adapter.sample_actions(batch, generator=torch.Generator().manual_seed(1))
        own = adapter.adapter.sample_actions(batch, generator=torch.Generator().manual_seed(1))
        again = adapter.evaluate_actions(batch, sample["trace"])
        value = adapter.predict_values(batch)
        made = adapter.value_inputs(batch)
        for name in ("actions", "trace", "log_prob"):
            assert torch.equal(sample[name], own[name])
        for found in (sample["value"], again["value"], adapter.predict_values(made)):
            torch.testing.assert_close(found, value)
        # 12 numbers of the scene, 4 of the robot, 32 of the instruction; no picture.
        assert made[FEATURES].shape == (3, 48)
        assert torch.equal(made[FEATURES][:, 12:16], batch["observation.state"])
        blind = {name: column for name, column in batch.items() if "image" not in name and "language" not in name}
        torch.testing.assert_close(adapter.predict_values(blind), value)
        for name in ("observation.environment_state", "observation.state"):
            assert ((adapter.predict_values(batch | {name: batch[name] + 1}) - value).abs() > 1e-4).all()
        history = {name: torch.stack([x.flip(0), x], 1) for name, x in blind.items() if name != "task"}
        torch.testing.assert_close(adapter.predict_values(history | {"task": TEXTS}), value)


def test_only_its_own_critic_learns(adapter):
    groups = {group["name"]: {id(p) for p in group["params"]} for group in adapter.rl_parameter_groups()}
    assert groups["value"] == {id(p) for p in adapter.critic.parameters()}
    assert groups["policy"] == {id(p) for p in adapter.policy.parameters() if p.requires_grad}
    own = adapter.own_parameters()
    assert {name for name in own if name.startswith("critic.")}
    assert not [name for name in own if "policy" in name]


def test_instructions_are_told_apart_by_words_and_their_order():
    a, b, c = map(text_vector, TEXTS)
    assert a.dtype == np.float32
    # The same words in another order, and another word.
    assert np.abs(a - b).max() > 0.1
    assert np.abs(a - c).max() > 0.1
    np.testing.assert_array_equal(text_vector("Put the cup\non  the plate\n"), a)
    many = np.array([text_vector(f"word{i} other{i}") for i in range(200)])
    assert many.std() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("kind", ["smolvla", "pi0", "pi05"])
def test_state_and_instruction_survive_lerobots_preprocessors(kind, tmp_path):
    policy = make_vla(kind, tmp_path)
    processors = around(policy, *make_processors(policy, tmp_path))
    adapter = PrivilegedCritic(make_trainable(policy, AdapterOptions()), SHAPES)
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=(2, *SHAPES[name])).astype(np.float32) for name in SHAPES if name != "action"}
    columns["observation.images.front"] = np.zeros((2, 32, 32, 3), np.uint8)
    batch = processors.batch(columns, TEXTS[:1] * 2)
    assert torch.equal(
        batch["observation.environment_state"], torch.from_numpy(columns["observation.environment_state"])
    )
    texts = adapter.value_inputs(batch)[FEATURES][:, -32:]
    # pi0.5's prompt has the state in it, which differs.
    np.testing.assert_array_equal(texts, np.stack([text_vector(TEXTS[0])] * 2))
