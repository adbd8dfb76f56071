"""Reinforcement learning on a frozen encoder: encodings are made once, while acting, and trained on later."""

import pytest
import torch
from pocketvla_samples import make_batch, make_policy


@pytest.fixture
def policy():
    torch.manual_seed(0)
    return make_policy(observation="image", freeze_encoder=True, dtype="float32").eval()


def test_encodings_stand_in_for_the_images(policy):
    batch = make_batch(6)
    encoded = policy.encode_observation(batch)
    assert not [key for key in encoded if "images" in key]
    tokens = policy.sample_actions(batch)["trace"]
    expected, got = (policy.evaluate_actions(b, tokens) for b in (batch, encoded))
    for name in ("log_prob", "entropy", "value"):
        torch.testing.assert_close(got[name], expected[name])


def test_only_the_trunk_and_the_heads_are_trained(policy):
    groups = {group["name"]: group["params"] for group in policy.rl_parameter_groups()}
    trained = {id(p) for params in groups.values() for p in params}
    frozen = {name for name, p in policy.named_parameters() if id(p) not in trained}
    assert frozen
    assert all(name.startswith("encoder.") for name in frozen)


def test_a_trainable_encoder_keeps_the_images():
    policy = make_policy(observation="image", freeze_encoder=False)
    assert policy.encode_observation is None
    count = sum(len(group["params"]) for group in policy.rl_parameter_groups())
    assert count == len(list(policy.parameters()))


CRITICS = {
    "privileged": {"critic_observation": "environment_state"},
    "actor": {},
    "state": {"image": False},
}


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("options", CRITICS.values(), ids=CRITICS)
def test_the_values_inputs_stand_in_for_the_batch(options, frozen):
    policy = make_policy(freeze_encoder=frozen, **options)
    batch = make_batch(6)
    if policy.encode_observation is not None:
        batch = policy.encode_observation(batch)
    inputs = policy.value_inputs(batch)
    assert not [key for key in inputs if "images" in key]
    values = policy.predict_values(inputs | {"task": batch["task"]})
    torch.testing.assert_close(values, policy.predict_values(batch))
    values.sum().backward()
    params = {group["name"]: group["params"] for group in policy.rl_parameter_groups()}
    assert all(p.grad is not None for p in params["value"])
    assert all(p.grad is None for p in params["policy"])
