"""The policy as LeRobot and as an actor-critic trainer use it."""

import pytest
import torch
from lerobot_policy_pocketvla import PocketVLAPolicy
from pocketvla_samples import CAMERA, make_batch, make_policy, take

HEADS = ["gaussian", "categorical"]


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize(
    ("image", "dtype"), [(False, "float32"), (True, "float32"), (True, "bfloat16")], ids=["state", "f32", "bf16"]
)
@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_the_ratio_is_one_before_the_first_update(head, image, dtype, temperature):
    policy = make_policy(image=image, dtype=dtype, head=head, critic_observation="environment_state")
    batch = make_batch(24)
    generator = torch.Generator().manual_seed(3)
    with torch.inference_mode():
        sampled = policy.sample_actions(batch, temperature=temperature, generator=generator)
    policy.train()
    # Minibatches are other mixtures of the samples than the rollout's batches were.
    for rows in ([5, 0, 17, 23, 9, 2, 11], list(range(24))):
        got = policy.evaluate_actions(take(batch, rows), sampled["trace"][rows], temperature=temperature)
        torch.testing.assert_close(got["log_prob"].exp(), sampled["log_prob"][rows].exp(), rtol=1e-4, atol=0)
        torch.testing.assert_close(got["value"], sampled["value"][rows], rtol=1e-4, atol=1e-5)
    assert sampled["log_prob"].std() > 0.1
    assert got["entropy"].shape == (24,)


def test_sampled_actions_are_the_bin_centres_of_the_tokens_and_inside_the_range():
    policy = make_policy(image=False)
    out = policy.sample_actions(make_batch(16))
    assert out["actions"][:, 0].dtype == torch.float32
    assert out["trace"].dtype == torch.int64
    torch.testing.assert_close(out["actions"][:, 0], -1 + (2 * out["trace"] + 1) / 256)
    assert set(out["trace"][:, 6].tolist()) <= {0, 255}
    assert out["log_prob"].shape == out["value"].shape == (16,)


def test_greedy_actions_repeat_and_sampled_ones_spread_with_the_temperature():
    policy, batch = make_policy(image=False), make_batch(1)
    with torch.no_grad():
        policy.head.project.weight.zero_()
    batch = {k: v * 400 if isinstance(v, list) else v.expand(400, *v.shape[1:]) for k, v in batch.items()}
    greedy = policy.sample_actions(batch, temperature=0.0)
    assert (greedy["trace"] == greedy["trace"][0]).all()
    assert (greedy["log_prob"] == 0).all()
    torch.testing.assert_close(policy.select_action(batch, temperature=0.0), greedy["actions"][:, 0])
    narrow = policy.select_action(batch, temperature=0.25)[:, :6].std(0)
    wide = policy.select_action(batch, temperature=1.0)[:, :6].std(0)
    # The mean is near 0, far from the edges; a quarter of the temperature is half of sigma.
    sigma = policy.head.sigma()[:6].detach()
    torch.testing.assert_close(wide, sigma, rtol=0.15, atol=0)
    torch.testing.assert_close(narrow, sigma / 2, rtol=0.15, atol=0)


def test_select_action_takes_the_configured_temperature():
    batch = make_batch(8)
    greedy = make_policy(image=False, temperature=0.0)
    assert torch.equal(greedy.select_action(batch), greedy.select_action(batch))
    assert greedy.predict_action_chunk(batch).shape == (8, 1, 7)
    sampled = make_policy(image=False)
    assert sampled.config.temperature == 0.6
    assert not torch.equal(sampled.select_action(batch), sampled.select_action(batch))


def test_a_privileged_critic_is_not_asked_for_actions():
    policy, batch = make_policy(critic_observation="environment_state"), make_batch(4)
    blind = {key: value for key, value in batch.items() if key != "observation.environment_state"}
    torch.testing.assert_close(
        policy.select_action(blind, temperature=0.0), policy.select_action(batch, temperature=0.0)
    )
    with pytest.raises(KeyError, match=r"observation\.environment_state"):
        policy.predict_values(blind)
    moved = batch | {"observation.environment_state": batch["observation.environment_state"] + 1}
    assert not torch.allclose(policy.predict_values(moved), policy.predict_values(batch))
    # It does not look at the image.
    dark = batch | {CAMERA: torch.zeros_like(batch[CAMERA])}
    torch.testing.assert_close(policy.predict_values(dark), policy.predict_values(batch))


def test_the_actor_ignores_what_observation_does_not_name():
    batch = make_batch(4)
    other_state = batch | {"observation.environment_state": -batch["observation.environment_state"]}
    other_image = batch | {CAMERA: 255 - batch[CAMERA]}
    for observation, ignored, used in (
        ("auto", other_state, other_image),
        ("image", other_state, other_image),
        ("environment_state", other_image, other_state),
    ):
        policy = make_policy(observation=observation, temperature=0.0)
        torch.testing.assert_close(policy.select_action(ignored), policy.select_action(batch))
        assert not torch.equal(policy.select_action(used), policy.select_action(batch))


@pytest.mark.parametrize("critic", ["actor", "environment_state"])
@pytest.mark.parametrize("image", [True, False])
def test_the_rl_groups_hold_every_parameter_once(image, critic):
    policy = make_policy(image=image, critic_observation=critic, freeze_encoder=False)
    groups = policy.rl_parameter_groups()
    assert [group["name"] for group in groups] == ["policy", "value"]
    ids = [id(p) for group in groups for p in group["params"]]
    assert sorted(ids) == sorted(id(p) for p in policy.parameters())
    assert sum(p.numel() for p in policy.parameters()) <= 6_000_000


@pytest.mark.parametrize("image", [True, False])
def test_a_saved_policy_is_the_same_policy(image, tmp_path):
    policy = make_policy(image=image, critic_observation="environment_state", sigma_init=0.3)
    policy.save_pretrained(tmp_path)
    loaded = PocketVLAPolicy.from_pretrained(tmp_path)
    batch = make_batch(6)
    tokens = policy.sample_actions(batch)["trace"]
    before, after = policy.evaluate_actions(batch, tokens), loaded.evaluate_actions(batch, tokens)
    for key in before:
        assert torch.equal(before[key], after[key])
    assert loaded.config == policy.config
