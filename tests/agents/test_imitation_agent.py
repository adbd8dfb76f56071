"""An update of the imitation agent with every policy that is small enough for a test, and what it has seen."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dummies import identity_processors
from lerobot.optim import AdamWConfig
from lerobot.policies import make_pre_post_processors
from test_decisions import play
from test_history import LookingBack
from tiny_pocketvla import make_pocketvla

from cronos_lerobot.agents.imitation.agent import ImitationAgent
from cronos_lerobot.agents.imitation.config import DemosConfig, ImitationConfig
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.processing import make_processors as around
from cronos_lerobot.agents.registry import AgentContext

STEPS = 12
"""Of a segment: more than VQ-BeT leaves out at the end of an episode."""


def make_imitating(policy, processors, **options):
    """An agent of two streams."""
    config = ImitationConfig(**{"steps_per_update": 1, "batch_size": 4, "warmup_segments": 1} | options)
    return ImitationAgent(
        AgentContext(
            config, policy, processors, num_streams=2, update_interval=STEPS, task_switch_interval=STEPS,
            rng=lambda name: np.random.default_rng(0), torch_rng=lambda name: torch.Generator().manual_seed(0),
        )
    )  # fmt: skip


def learn(agent):
    """A segment that two streams succeed at in its last step, and an update; its metrics."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    shapes = {name: feature.shape for name, feature in agent.policy.config.input_features.items()}
    tau, success = ["put 3 in 4", "put the cup on the plate"], np.zeros(2, bool)

    def observe():
        seen = {"agent_pos": rng.normal(size=(2, *shapes["observation.state"])).astype(np.float32)}
        if environment_state := shapes.get("observation.environment_state"):
            seen["environment_state"] = rng.normal(size=(2, *environment_state)).astype(np.float32)
        else:
            _, *size = shapes["observation.images.front"]
            seen["pixels"] = {"front": rng.integers(256, size=(2, *size, 3), dtype=np.uint8)}
        return seen

    now = observe()
    for step in range(STEPS):
        is_last, after = step == STEPS - 1, observe()
        sample = agent.act(now, tau)
        cut = np.full(2, is_last)
        agent.store(now, tau, sample, cut.astype(np.float32), after, cut, np.zeros(2, bool))
        agent.end_step(cut)
        now = after
    agent.end_segment(cut, success)
    metrics = agent.update()
    assert np.isfinite(agent.act(now, tau).action).all()
    return metrics


def test_a_policy_that_looks_back_sees_what_happened_since_the_trace_was_cut():
    """Stream 0 is at 1, 2, 3 ..., stream 1 at 101, 102 ...; four actions at a time, three observations."""
    policy = LookingBack()
    policy.config = SimpleNamespace(get_optimizer_preset=AdamWConfig, input_features={"observation.state": None})
    policy.get_optim_params = policy.parameters
    agent = make_imitating(policy, PolicyProcessors(*identity_processors()))
    actions = play(agent, 12, [[0, 0]] * 12, cut={(7, 0), (7, 1)}, diverged={(2, 1)})
    assert agent.policy.asked == [
        [[1, 1, 1], [101, 101, 101]],
        # After 103 stream 1 was somewhere else.
        [[104, 104, 104]],
        [[3, 4, 5]],
        [[106, 107, 108]],
        # Another task.
        [[9, 9, 9], [109, 109, 109]],
    ]
    assert [a[0] for a in actions] == [10, 11, 12, 13, 50, 51, 52, 53, 90, 91, 92, 93]
    assert [a[1] for a in actions[2:5]] == [1012, 1040, 1041]


def test_warmed_up_once_is_warm_for_good():
    """Failed segments that are remembered may push the successes out; with none at all there is no step."""
    policy = make_pocketvla("categorical")
    processors = around(policy, *make_pre_post_processors(policy.config))
    agent = make_imitating(policy, processors, warmup_segments=2, weighting="return")
    assert learn(agent)["optimizer_steps"] == 1
    agent.memory.load_state_dict(agent.memory.state_dict()[:1])
    assert agent.update()["optimizer_steps"] == 1
    resumed = make_imitating(policy, processors, warmup_segments=2, weighting="return")
    resumed.load_state_dict(agent.state_dict())
    assert resumed.update()["optimizer_steps"] == 1
    (failed,) = resumed.memory.state_dict()
    resumed.memory.load_state_dict([failed | {"success": False}])
    assert resumed.update()["optimizer_steps"] == 0


@pytest.mark.parametrize(("share", "kept"), [(0.5, 2), (1.0, 0)])
def test_where_demonstrations_alone_are_cloned_nothing_is_remembered(share, kept, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.agents.imitation.agent.Demonstrations", lambda *of: None)
    monkeypatch.setattr(ImitationAgent, "update", lambda self: {})
    policy = make_pocketvla("categorical")
    processors = around(policy, *make_pre_post_processors(policy.config))
    agent = make_imitating(policy, processors, demos_share=share, demos=DemosConfig("me/demos"))
    learn(agent)
    assert len(agent.memory) == kept
