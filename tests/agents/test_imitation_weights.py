"""How much a segment counts, by hand and beside LeRobot's weighted loss."""

import math

import numpy as np
import pytest
import torch
from tiny_pocketvla import make_pocketvla

from cronos_lerobot.agents.imitation.batches import draw_batch, segment_batch
from cronos_lerobot.agents.imitation.memory import (
    Segment,
    SegmentMemory,
    by_advantage,
    by_return,
    discounted_returns,
    effective_share,
)


def segment(task, rewards):
    rng = np.random.default_rng(len(rewards))
    columns = {"observation.state": 5, "observation.environment_state": 6, "action": 7}
    columns = {name: rng.uniform(-1, 1, (len(rewards), n)).astype(np.float32) for name, n in columns.items()}
    columns["action"] *= len(rewards) / 3
    return Segment(task, columns | {"next.reward": np.array(rewards, np.float32)})


# With a discount of 1/2 the returns are 1/4, 0 and 1.
SEGMENTS = [segment("a", [0, 0, 1]), segment("a", [0, 0]), segment("b", [1])]
RETURNS, TASKS = np.array([0.25, 0, 1]), np.array(["a", "a", "b"])


def test_weights_by_hand():
    e = math.e
    assert discounted_returns(SEGMENTS, 0.5).tolist() == RETURNS.tolist()
    assert by_return(RETURNS, 0.25) == pytest.approx([e**-3, e**-4, 1])
    # The mean of task a is 1/8; b has one segment, which is as good as its mean.
    assert by_advantage(RETURNS, TASKS, 0.125, 20.0) == pytest.approx([e, 1 / e, 1])
    assert by_advantage(RETURNS, TASKS, 0.125, 2.0) == pytest.approx([2, 1 / e, 1])
    assert by_advantage(RETURNS, TASKS, 1e-6, 20.0) == pytest.approx([20, 0, 1])
    assert effective_share(np.ones(3), np.array([3, 2, 1])) == pytest.approx(1)
    assert effective_share(np.array([1, 0, 0]), np.array([3, 2, 1])) == pytest.approx(0.5)


class Demos:
    """Frames that tell themselves by their task."""

    def batch(self, count, rng):
        return {"task": ["shown"] * count}


@pytest.mark.parametrize(
    ("remembered", "has_success", "shown"), [(SEGMENTS, True, 3), (SEGMENTS, False, 12), ([], True, 12)]
)
def test_demonstrations_are_a_share_once_any_process_has_succeeded(remembered, has_success, shown):
    memory = SegmentMemory(2**20)
    for kept in remembered:
        memory.add(kept)
    config, rng = make_pocketvla("flow").config, np.random.default_rng(0)
    batch = draw_batch(memory, Demos(), 0.25, 12, rng, config, has_success=has_success)
    assert (batch["task"].count("shown"), len(batch["task"])) == (shown, 12)


@pytest.mark.parametrize("head", ["gaussian", "flow"])
def test_drawing_by_weight_is_the_weighted_loss(head):
    """sum w l / sum w with the policy's loss of each sample, as lerobot-train's sample weighting has it."""
    policy = make_pocketvla(head)
    weights = by_advantage(RETURNS, TASKS, 0.125, 20.0)
    memory = SegmentMemory(2**20)
    for kept in SEGMENTS:
        memory.add(kept)
    frames = [(kept, i) for kept in SEGMENTS for i in range(len(kept))]

    def losses(draws):
        options = {}
        if head == "flow":
            shape = (len(draws), *policy.head.shape)
            options = {"noise": torch.full(shape, 0.3), "time": torch.full((len(draws),), 0.4)}
        return policy.forward(segment_batch(draws, policy.config), reduction="none", **options)[0].detach()

    w = torch.from_numpy(np.repeat(weights, [3, 2, 1]))
    per_sample = losses(frames)
    expected = (w * per_sample).sum() / w.sum()
    drawn = losses(memory.draw(20_000, np.random.default_rng(0), weights)).double()
    error = drawn.std() / math.sqrt(len(drawn))
    assert abs(drawn.mean() - expected) < 4 * error
    assert abs(per_sample.mean() - expected) > 6 * error  # what drawing all alike would give
