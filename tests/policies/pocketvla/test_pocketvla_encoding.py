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
    tokens = policy.sample_actions(batch)["tokens"]
    expected, got = (policy.evaluate_actions(b, tokens) for b in (batch, encoded))
    for name in ("log_prob", "entropy", "value"):
        torch.testing.assert_close(got[name], expected[name])


def test_only_the_trunk_and_the_heads_are_trained(policy):
    groups = {group["name"]: group["params"] for group in policy.rl_parameter_groups()}
    trained = {id(p) for params in groups.values() for p in params}
    frozen = {name for name, p in policy.named_parameters() if id(p) not in trained}
    assert frozen
    assert all(name.startswith(("actor.encoder.", "actor.text.")) for name in frozen)


def test_a_trainable_encoder_keeps_the_images():
    policy = make_policy(observation="image", freeze_encoder=False)
    assert policy.encode_observation is None
    count = sum(len(group["params"]) for group in policy.rl_parameter_groups())
    assert count == len(list(policy.parameters()))
