"""Behaviour cloning: the loss by hand, and that it learns."""

import math

import pytest
import torch
from lerobot_policy_pocketvla import PocketVLAPolicy
from pocketvla_samples import make_batch, make_config, make_policy


def test_the_loss_of_a_gaussian_head_by_hand():
    policy = PocketVLAPolicy(make_config(image=False, sigma_init=0.1)).eval()
    with torch.no_grad():
        policy.head.project.weight.zero_()
    action = torch.full((1, 7), 0.3)
    loss, _ = policy.forward(make_batch(1) | {"action": action})
    # Mean 0, sigma 0.1: the bin of 0.3 has its centre at 0.3008; bins are 1/128 wide, the tails are inside.
    centre = -1 + (2 * 166 + 1) / 256
    density = math.exp(-(centre**2) / 0.02) / math.sqrt(2 * math.pi * 0.01)
    expected = -6 * math.log(density / 128) + math.log(2)
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_action_shapes_padding_and_reduction():
    policy = make_policy(image=False)
    batch = make_batch(4) | {"action": torch.rand(4, 7) * 2 - 1}
    each, _ = policy.forward(batch, reduction="none")
    assert each.shape == (4,)
    torch.testing.assert_close(policy.forward(batch)[0], each.mean())
    chunked = batch | {"action": batch["action"][:, None], "action_is_pad": torch.zeros(4, 1, dtype=torch.bool)}
    chunked["action_is_pad"][2:] = True
    torch.testing.assert_close(policy.forward(chunked)[0], each[:2].mean())


@pytest.mark.parametrize(("image", "head"), [(True, "gaussian"), (False, "gaussian"), (False, "categorical")])
def test_two_instructions_are_learnt_as_two_actions(image, head):
    torch.manual_seed(0)
    policy = PocketVLAPolicy(make_config(image=image, head=head))
    targets = torch.tensor([[0.5, -0.5, 0.2, 0.0, 0.9, -0.9, 1.0], [-0.5, 0.5, -0.2, 0.4, -0.9, 0.9, -1.0]])
    batch = make_batch(16)
    # Every observation comes under both instructions, so that only the words tell the actions apart.
    for key, value in batch.items():
        batch[key] = value if key == "task" else value[:8].repeat_interleave(2, dim=0)
    batch["action"] = targets.repeat(8, 1)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3)
    policy.train()
    losses = []
    for _ in range(80):
        loss, metrics = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]
    assert metrics["greedy_abs_error"] < 0.05
    policy.eval()
    greedy = policy.select_action(batch, temperature=0.0)
    torch.testing.assert_close(greedy, batch["action"], atol=0.12, rtol=0)


def test_the_critic_gets_no_gradient_and_is_not_in_the_optimizer():
    policy = make_policy(critic_observation="environment_state", freeze_encoder=False)
    policy.forward(make_batch(2) | {"action": torch.zeros(2, 7)})[0].backward()
    value = policy.rl_parameter_groups()[1]["params"]
    assert all(p.grad is None for p in value)
    optimised = {id(p) for group in policy.get_optim_params() for p in group["params"]}
    assert optimised == {id(p) for p in policy.rl_parameter_groups()[0]["params"]}
