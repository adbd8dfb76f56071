"""The flow head as LeRobot's commands use it: its loss, its chunks, its queue."""

import copy

import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot_policy_pocketvla import PocketVLAConfig, PocketVLAFlowPolicy, PocketVLAPolicy
from pocketvla_samples import make_batch, make_config, make_policy

from cronos_lerobot.agents.base import TrainablePolicy
from cronos_lerobot.evaluation.actors import SamplingPolicy, SelectingPolicy, make_actor

FLOW = {"head": "flow", "image": False, "hidden_width": 32, "hidden_depth": 1, "flow_width": 32, "flow_depth": 2}


def make_flow(**options):
    return make_policy(**FLOW | options)


def make_noise(n, chunk_size=4, seed=1):
    return torch.randn(n, chunk_size, 7, generator=torch.Generator().manual_seed(seed))


def test_the_head_decides_the_class():
    flow = make_flow()
    assert type(flow) is PocketVLAFlowPolicy
    assert (flow.config.chunk_size, flow.config.n_action_steps) == (4, 2)
    assert flow.config.action_delta_indices == [0, 1, 2, 3]
    tokens = make_policy(image=False)
    assert isinstance(flow, PocketVLAPolicy)
    assert isinstance(tokens, PocketVLAPolicy)
    assert isinstance(tokens, TrainablePolicy)
    # Only what says how likely its actions were is sampled; the others are asked as lerobot-eval does.
    assert not isinstance(flow, TrainablePolicy)
    for policy, actor in ((flow, SelectingPolicy), (tokens, SamplingPolicy)):
        processors = type("Processors", (), {"device": torch.device("cpu"), "preprocessor": None})()
        assert type(make_actor(policy, processors, 0.6, 7)) is actor
    assert type(copy.deepcopy(flow)) is PocketVLAFlowPolicy


def test_the_loss_by_hand():
    policy = PocketVLAPolicy(make_config(**FLOW))
    asked = []
    policy.head.register_forward_pre_hook(lambda _, inputs: asked.append(inputs))
    # A fresh head has velocity 0, so the error is (noise - action)^2; 2 is clamped to 1.
    actions = torch.full((2, 4, 7), 0.5)
    actions[1] = 2.0
    batch = make_batch(2) | {"action": actions}
    options = {"noise": torch.full((2, 4, 7), 1.5), "time": torch.tensor([0.25, 0.75])}
    each, _ = policy.forward(batch, reduction="none", **options)
    assert each.tolist() == pytest.approx([1.0, 0.25])
    # x = t noise + (1 - t) action: 0.25 * 1.5 + 0.75 * 0.5, and 0.75 * 1.5 + 0.25 * 1.
    assert asked[0][1][:, 0, 0].tolist() == pytest.approx([0.75, 1.375])
    assert policy.forward(batch, **options)[0].item() == pytest.approx(0.625)
    # Of the first chunk one action counts, the others are far off; of the second all four do.
    actions[0, 1:] = -1.0
    batch["action_is_pad"] = torch.tensor([[False, True, True, True], [False] * 4])
    assert policy.forward(batch, reduction="none", **options)[0].tolist() == pytest.approx([1.0, 0.25])
    assert policy.forward(batch, **options)[0].item() == pytest.approx((1.0 + 4 * 0.25) / 5)


def test_chunks_relative_to_the_joints_by_hand():
    policy = PocketVLAPolicy(make_config(**FLOW | {"chunk_size": 2, "joints": [3, 4, 5, 6, 7, 8, -1]})).train()
    joints = torch.tensor([[0.2] * 6 + [0.0], [-0.4] * 6 + [0.0]])
    actions = joints[:, None] + torch.tensor([[0.1, 0.3], [-0.1, 0.5]])[..., None]
    noise, time = torch.zeros(2, 2, 7), torch.ones(2)
    batch = make_batch(2) | {"action": actions, "observation.joints": joints}
    each, _ = policy.forward(batch, reduction="none", noise=noise, time=time)
    # The first numbers have mean 0 and deviation .1, the second ones mean .4 and deviation .1: all are +-1.
    assert each.tolist() == pytest.approx([1.0, 1.0], rel=1e-3)
    # A second batch, whose first action is 0 and whose second counts once, with .8.
    batch["action"] = joints[:, None] + torch.tensor([[0.0, 0.8], [0.0, -3.0]])[..., None]
    batch["action_is_pad"] = torch.tensor([[False, False], [False, True]])
    policy.forward(batch)
    torch.testing.assert_close(policy.chunks.mean, torch.tensor([[0.0] * 7, [0.6] * 7]))
    # (.1^2 + 0) / 2, and the mean of (.3^2 + .5^2) / 2 and .8^2.
    torch.testing.assert_close(policy.chunks.square, torch.tensor([[0.005] * 7, [0.405] * 7]))
    # A chunk of 1 is one deviation above the mean, from where the joints are.
    context = policy.eval().flow_context(batch)
    played = policy.flow_actions(context, torch.ones(2, 2, 7))
    expected = torch.tensor([0.005**0.5, 0.6 + (0.405 - 0.36) ** 0.5])[:, None]
    torch.testing.assert_close(played, joints[:, None] + expected)
    policy.forward(batch)
    torch.testing.assert_close(policy.chunks.mean[1], torch.full((7,), 0.6))


def test_draws_share_the_trunk_and_are_random():
    policy = make_flow(flow_draws=8)
    rows = []
    policy.actor.register_forward_hook(lambda _, __, out: rows.append(len(out)))
    policy.head.register_forward_hook(lambda _, inputs, __: rows.append(len(inputs[1])))
    batch = make_batch(3) | {"action": torch.zeros(3, 4, 7)}
    first, second = (policy.forward(batch, reduction="none")[0] for _ in range(2))
    assert rows == [3, 24] * 2
    assert first.shape == (3,)
    assert not torch.equal(first, second)


@torch.no_grad()
def test_a_chunk_is_the_integral_and_is_played_from_a_queue():
    policy, batch, noise = make_flow(num_inference_steps=2), make_batch(3), make_noise(3)
    context = policy.flow_context(batch)
    assert context.shape == (3, 32)
    middle = noise - 0.5 * policy.flow_velocity(context, noise, torch.ones(3))
    expected = middle - 0.5 * policy.flow_velocity(context, middle, torch.full((3,), 0.5))
    chunk = policy.predict_action_chunk(batch, noise=noise)
    torch.testing.assert_close(chunk, expected)
    assert torch.equal(policy.select_action(batch, noise=noise), chunk[:, 0])
    # The second action is of the same chunk, whatever is seen; the third of a new one.
    assert torch.equal(policy.select_action(make_batch(3, seed=1)), chunk[:, 1])
    assert torch.equal(policy.select_action(batch, noise=-noise), policy.predict_action_chunk(batch, -noise)[:, 0])
    policy.reset()
    assert torch.equal(policy.select_action(batch, noise=noise), chunk[:, 0])


def test_two_ways_are_learnt_as_two():
    """From the same observation half of the demonstrations go left: the mean of both would be in the middle."""
    torch.manual_seed(0)
    policy = PocketVLAPolicy(make_config(**FLOW | {"chunk_size": 2, "num_inference_steps": 10})).train()
    batch = make_batch(1)
    batch = {key: v * 64 if isinstance(v, list) else v.repeat(64, *[1] * (v.ndim - 1)) for key, v in batch.items()}
    side = torch.tensor([-0.5, 0.5]).repeat(32)[:, None, None]
    batch["action"] = side.expand(64, 2, 7)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=5e-3)
    for _ in range(150):
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    chunk = policy.eval().predict_action_chunk(batch, make_noise(64, 2)).mean((1, 2))
    assert ((chunk.abs() - 0.5).abs() < 0.2).float().mean() > 0.8
    assert 16 < int((chunk > 0).sum()) < 48


def test_saved_and_loaded_it_acts_the_same_and_within_its_bounds(tmp_path):
    policy, batch, noise = make_flow(), make_batch(3), make_noise(3)
    policy.save_pretrained(tmp_path)
    loaded = PocketVLAPolicy.from_pretrained(tmp_path)
    assert type(loaded) is PocketVLAFlowPolicy
    chunk = policy.predict_action_chunk(batch, noise)
    assert torch.equal(loaded.predict_action_chunk(batch, noise), chunk)
    # A chain may end beyond [-1, 1]; the physical action does not.
    _, postprocessor = make_pre_post_processors(policy.config)
    assert chunk.abs().max() > 1
    physical = postprocessor(torch.full((1, 7), 3.0))
    torch.testing.assert_close(physical, postprocessor(torch.ones(1, 7)))
    assert postprocessor(torch.full((1, 7), -3.0))[0, 6] == 0


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"head": "flow", "chunk_size": 4, "n_action_steps": 5}, "n_action_steps"),
        ({"head": "gaussian", "chunk_size": 4}, "chunk_size"),
        ({"sigma_init": 0.9}, "sigma_init"),
        # Wider than sigma_min, which is 0.05.
        ({"num_bins": 39}, "num_bins"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(options, flag):
    with pytest.raises(ValueError, match=flag):
        PocketVLAConfig(device="cpu", **options)
