"""What policies that look back have seen, at every boundary, by hand and as LeRobot's Diffusion remembers it."""

import numpy as np
import pytest
import torch
from test_decisions import Chunks, at, make_agent, play


class LookingBack(Chunks):
    """Looks at three observations x: 1, 2, 3 have the value 10203, and 101, 102, 103 have 1010203."""

    observation_steps = 3

    def sample_actions(self, batch, **options):
        seen = batch["observation.state"][..., 0]
        sample = super().sample_actions({"observation.state": seen[:, -1:]}, **options)
        self.asked[-1] = seen.tolist()
        return sample | {"trace": seen, "value": self.predict_values(batch)}

    def evaluate_actions(self, batch, trace, *, temperature=1.0):
        assert torch.equal(batch["observation.state"][..., 0], trace)
        evaluated = super().evaluate_actions({"observation.state": trace[:, -1:]}, trace)
        return evaluated | {"value": self.predict_values(batch)}

    def predict_values(self, batch):
        x = batch["observation.state"]
        if x.ndim == 2:
            return x[:, 0]
        digits = x[..., 0] % 100 @ torch.tensor([[1e4], [1e2], [1.0]])
        return 4 * self.critic(digits + 1e6 * (x[:, 0] > 100))[:, 0]


@pytest.fixture
def agent(monkeypatch):
    monkeypatch.setattr("test_decisions.Chunks", LookingBack)
    agent, _ = make_agent(rows=3, ratio="factor")
    return agent


def test_every_control_step_is_seen_and_a_switch_is_a_new_beginning(agent):
    """Stream 0 sees 1, 2, 3 ...; it decides on four actions at a time."""
    none = [[0, 0]] * 12
    play(agent, 12, none, cut={(7, 0), (7, 1), (11, 0), (11, 1)})
    # At 9 the second task began, whose first observation stands for those before it.
    assert agent.policy.asked == [
        [[1, 1, 1], [101, 101, 101]],
        [[3, 4, 5], [103, 104, 105]],
        [[9, 9, 9], [109, 109, 109]],
    ]
    buffer = agent.buffer
    assert buffer.observations["observation.state"].shape == (3, 2, 3, 1)
    assert buffer.observations["observation.state"][1, :, :, 0].tolist() == [[3, 4, 5], [103, 104, 105]]
    assert buffer.values[:, 0].tolist() == [10101, 30405, 90909]
    # What follows the last action under the old task was seen after what was seen under it.
    assert buffer.boundaries.tolist() == [[False, False], [True, True], [True, True]]
    assert buffer.bootstrap_values[1:].tolist() == [[70809, 1070809], [111213, 1111213]]


def test_a_divergence_is_a_new_beginning_for_its_stream(agent):
    play(agent, 8, [[0, 0]] * 8, diverged={(2, 1)}, cut={(7, 0), (7, 1)})
    # Stream 1 is somewhere else from 104 on.
    assert agent.policy.asked == [
        [[1, 1, 1], [101, 101, 101]],
        [[104, 104, 104]],
        [[3, 4, 5], [104, 104, 105]],
    ]
    # There is no outcome of its action at 103.
    assert agent.buffer.bootstrap_values[0].tolist() == [0, 1010203]
    assert agent.buffer.bootstrap_values[1].tolist() == [70809, 1070809]


def test_an_update_sees_what_was_decided_on(agent):
    play(agent, 12, [[1, 0]] * 12, cut={(7, 0), (7, 1), (11, 0), (11, 1)})
    with torch.no_grad():
        for param in agent.policy.actor.parameters():
            param.zero_()
    metrics = agent.update()  # with LookingBack's own check
    assert metrics["ratio_max"] == pytest.approx(1, abs=0.1)


def test_a_task_that_is_given_now_is_judged_by_its_first_observation(agent):
    """At a switch nothing is left of the task before; however often it is asked, the agent stays as it was."""
    play(agent, 8, [[0, 0]] * 8, cut={(7, 0), (7, 1)})
    for tau in (["a", "b"], ["c", "c"]):
        values = agent.predict_values(at(9, 109), tau)
        assert values.dtype == np.float32
        assert values.tolist() == [90909, 1090909]
    # In the middle of a decision, too, nothing is changed.
    play(agent, 1, [[0, 0]])
    agent.predict_values(at(50, 150), ["a", "b"])
    assert agent.act(at(2, 102), ["a", "b"]).action[:, 0].tolist() == [11, 1011]
