"""Cloning beside PPO: which gradient is added to what, what is drawn, what is forgotten, who is refused."""

import copy
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from dummies import TASKS, DummyPolicy, DummyPolicyConfig, identity_processors
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamConfig
from lerobot_policy_pocketvla import PocketVLAConfig, PocketVLAPolicy
from ppo_samples import flat, make_ppo, reward_for_up, rollout
from test_act_adapter import make_act

from cronos_lerobot.agents.adapters import builtin as _builtin  # noqa: F401 -- registers them
from cronos_lerobot.agents.adapters.registry import AdapterOptions, make_trainable
from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.agents.imitation.memory import Segment, SegmentMemory, own_share
from cronos_lerobot.agents.imitation.weights import by_task
from cronos_lerobot.agents.ppo.config import PPOConfig, SelfImitationConfig
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.self_imitation import SelfImitation
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.processes import Processes

COEF = 0.25


@PreTrainedConfig.register_subclass("dummy_cloneable")
@dataclass
class CloneableConfig(DummyPolicyConfig):
    def get_optimizer_preset(self):
        return AdamConfig()


class CloneablePolicy(DummyPolicy):
    """Has a loss for lerobot-train, on its actor alone; keeps the batches that it saw."""

    def __init__(self):
        super().__init__(CloneableConfig())
        self.seen = []

    def forward(self, batch):
        assert not self.training
        self.seen.append(batch)
        bins = self._distribution(batch, 1.0)
        return -bins.log_prob(batch["action"] + 1).mean(), {}

    def get_optim_params(self):
        return self.actor.parameters()


def segment(task, length, update=0, action=1.0):
    rng = np.random.default_rng(length)
    state = rng.normal(size=(length, 2)).astype(np.float32)
    return Segment(task, {"observation.state": state, "action": np.full((length, 7), action, np.float32)}, update)


def make_cloning(policy, segments=(), **options):
    settings = SelfImitationConfig(**({"coef": COEF, "batch_size": 32} | options))
    config = PPOConfig(self_imitation=settings)
    processors = PolicyProcessors(*identity_processors())
    cloning = SelfImitation(policy.eval(), processors, config, 2, np.random.default_rng(0))
    for kept in segments:
        cloning.memory.add(kept)
    return cloning


def test_a_weighted_gradient_is_added_to_the_policys_and_to_no_other():
    policy = CloneablePolicy()
    cloning = make_cloning(policy, [segment(TASKS[0].instruction, 6), segment(TASKS[1].instruction, 9)])
    params = [*policy.actor.parameters()]
    assert cloning.begin_update(3) == {"memory_segments": 2, "memory_frames": 15, "memory_age": 3}
    policy.actor.weight.grad = torch.ones_like(policy.actor.weight)
    metrics = cloning.add_gradients(params)
    (batch,) = policy.seen
    twin = copy.deepcopy(policy)
    loss, _ = twin.forward(batch)
    loss.backward()
    torch.testing.assert_close(policy.actor.weight.grad, 1 + COEF * twin.actor.weight.grad)
    torch.testing.assert_close(policy.actor.bias.grad, COEF * twin.actor.bias.grad)
    assert policy.critic.weight.grad is None
    expected = flat(param.grad for param in twin.actor.parameters()).norm().item()
    assert metrics == pytest.approx({"clone_loss": loss.item(), "clone_grad_norm": expected}, rel=1e-5)


@pytest.mark.parametrize(("share", "kept"), [(0.5, 2), (1.0, 0)])
def test_where_demonstrations_alone_are_cloned_nothing_is_remembered(share, kept, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.agents.ppo.self_imitation.Demonstrations", lambda *of: None)
    settings = {
        "self_imitation": SelfImitationConfig(COEF),
        "demos": DemosConfig("me/demos"),
        "demos_share": share,
    }
    processors = PolicyProcessors(*identity_processors())
    cloning = SelfImitation(
        CloneablePolicy().eval(), processors, PPOConfig(**settings), 2, np.random.default_rng(0)
    )
    for success in (False, True):
        seen = {"observation.state": np.zeros((2, 2))}
        cloning.store(seen, ["a", "b"], np.zeros((2, 7)), np.zeros(2), np.zeros(2, bool))
        cloning.end_step(np.full(2, success))
    cloning.end_segment(np.zeros(2, bool), 1)
    assert len(cloning.memory) == kept


class Beside(Processes):
    """The first of two processes, the second of which remembers segments of these tasks and lengths."""

    count = 2

    def __init__(self, *others):
        self.others = others

    def concatenate(self, array, axis=0):
        return np.concatenate([array, np.zeros_like(array)], axis)

    def gather(self, value):
        tasks, lengths = ([other[i] for other in self.others] for i in (0, 1))
        return [value, (np.array(tasks, str), np.array(lengths, int), np.zeros(len(tasks)))]


def test_instructions_count_alike_over_all_processes():
    """Of task a six frames of eight are here, of task b all elsewhere: three quarters of one of two tasks."""
    cloning = make_cloning(CloneablePolicy(), [segment("a", 6)])
    cloning._processes = Beside(("a", 2), ("b", 4))
    cloning.begin_update(3)
    assert cloning._weights == pytest.approx([1 / 8])
    # The mean of both processes' losses, 0.75 / 2 times this one and 1.25 / 2 times the other's.
    assert cloning._share == pytest.approx(0.75)


def test_the_weight_is_that_of_the_processes_with_something_to_clone():
    policy = CloneablePolicy()
    cloning = make_cloning(policy, [segment(TASKS[0].instruction, 6)])
    cloning._processes = Beside()
    cloning.begin_update(3)
    cloning.add_gradients([*policy.actor.parameters()])
    twin = copy.deepcopy(policy)
    twin.zero_grad()
    twin.forward(policy.seen[0])[0].backward()
    # The mean over both processes, of which the other adds nothing, is COEF times the gradient.
    torch.testing.assert_close(policy.actor.weight.grad / 2, COEF * twin.actor.weight.grad)


def test_tasks_are_drawn_equally_often_and_their_frames_alike():
    # Of 20 frames 15 are of task a, 5 of task b.
    segments = [segment("a", 5), segment("a", 10), segment("b", 5)]
    tasks = np.array(["a", "a", "b"])
    assert by_task(tasks, np.array([5, 10, 5])).tolist() == pytest.approx([1 / 15, 1 / 15, 1 / 5])
    memory = SegmentMemory(max_bytes=2**20)
    for kept in segments:
        memory.add(kept)
    weights = by_task(tasks, memory.lengths)
    drawn = [(s.instruction, len(s), f) for s, f in memory.draw(6000, np.random.default_rng(0), weights)]
    frames = [("a", 5, i) for i in range(5)] + [("a", 10, i) for i in range(10)] + [("b", 5, i) for i in range(5)]
    assert set(drawn) == set(frames)
    expected = [200] * 15 + [600] * 5
    assert [drawn.count(frame) for frame in frames] == pytest.approx(expected, abs=90)


def test_successes_go_when_they_are_too_old():
    cloning = make_cloning(CloneablePolicy(), max_age=2)
    for number in range(5):
        reached = np.array([True, False])
        for step in range(3):
            state = np.full((2, 2), number, np.float32)
            tau = [task.instruction for task in TASKS[:2]]
            cloning.store({"observation.state": state}, tau, np.zeros((2, 7)), np.zeros(2), np.zeros(2, bool))
            cloning.end_step(reached & (step == 1))
        cloning.end_segment(np.array([number == 3, False]), num_updates=number)
    # One was found complete; they were over after 0, 1, 2 and 4 updates. The second stream never succeeded.
    assert cloning.begin_update(4) == {"memory_segments": 2, "memory_frames": 6, "memory_age": 1}
    assert [kept.update for kept in cloning.memory.segments] == [2, 4]
    assert {kept.instruction for kept in cloning.memory.segments} == {TASKS[0].instruction}
    assert cloning.begin_update(7) == {"memory_segments": 0, "memory_frames": 0}
    assert cloning.add_gradients([*cloning._policy.actor.parameters()]) == {}


def test_processes_share_a_memory_out():
    assert own_share([["a"], ["b", "c"]], 1, 2) == ["b", "c"]
    assert [own_share([["a"], ["b", "c"]], rank, 3) for rank in range(3)] == [["a"], ["b"], ["c"]]


def cloning_ppo(segments, coef, **options):
    policy = CloneablePolicy().eval()
    config = PPOConfig(
        self_imitation=SelfImitationConfig(coef=coef, batch_size=32),
        **({"minibatch_size": 64, "value_warmup_updates": 0, "lr_schedule": "fixed", "target_kl": None} | options),
    )
    processors = PolicyProcessors(*identity_processors())
    cloning = SelfImitation(policy, processors, config, 2, np.random.default_rng(1))
    for kept in segments:
        cloning.memory.add(kept)
    return PPO(policy, processors, config, np.random.default_rng(0), self_imitation=cloning)


def ups(buffer):
    """How often the last dimension, which no reward looks at, goes up."""
    return (buffer.traces[..., 6] == 2).mean()


def test_what_succeeded_becomes_likelier_and_the_value_learns_as_without():
    memory = [segment(task.instruction, 8) for task in TASKS]
    shares, critics = [], []
    for coef in (0.0, 1.0):
        ppo = cloning_ppo(memory, coef, policy_lr=5e-2) if coef else make_ppo(
            policy=CloneablePolicy(), policy_lr=5e-2, lr_schedule="fixed", target_kl=None
        )  # fmt: skip
        metrics = [ppo.update(rollout(ppo, reward_for_up)) for _ in range(3)]
        assert all(("clone_loss" in update) == bool(coef) for update in metrics)
        critics.append(metrics[0]["value_loss"])
        shares.append(ups(rollout(ppo, reward_for_up)))
    assert shares[1] > shares[0] + 0.1
    assert critics[0] == pytest.approx(critics[1])


def test_a_kl_that_cloning_caused_stops_the_update_as_well():
    """The rewards are all alike: whatever moves the policy is cloning."""
    memory = [segment(task.instruction, 8) for task in TASKS]
    ppo = cloning_ppo(memory, 10.0, epochs=10, policy_lr=0.1, target_kl=0.01, kl_stop_factor=2.0)
    metrics = ppo.update(rollout(ppo, lambda sample: np.ones(len(sample.value), np.float32)))
    assert metrics["policy_epochs"] < 3
    # While the value warms up nothing is cloned.
    ppo = cloning_ppo(memory, 1.0, value_warmup_updates=1)
    before = flat(ppo.policy.actor.parameters())
    metrics = ppo.update(rollout(ppo, reward_for_up))
    assert metrics["memory_segments"] == 4
    assert "clone_loss" not in metrics
    assert torch.equal(before, flat(ppo.policy.actor.parameters()))


def test_a_policy_whose_forward_does_not_train_what_acts_is_refused():
    with pytest.raises(ValueError, match=r"--policy\.type=dummy_linear cannot .*lerobot-train does not train it"):
        make_cloning(DummyPolicy())
    policy = CloneablePolicy()
    policy.get_optim_params = lambda: [{"params": [*policy.critic.parameters()]}]
    cloning = make_cloning(policy)
    with pytest.raises(ValueError, match="`forward` trains nothing of what acts"):
        PPO(policy, cloning._processors, PPOConfig(), np.random.default_rng(0), self_imitation=cloning)
    policy = CloneablePolicy()
    policy.forward = lambda batch: (policy.critic.weight.sum(), {})
    cloning = make_cloning(policy, [segment(TASKS[0].instruction, 6)])
    cloning.begin_update(0)
    with pytest.raises(ValueError, match="`forward` has no gradient for what acts"):
        cloning.add_gradients([*policy.actor.parameters()])


def make_pocketvla(head):
    torch.manual_seed(0)
    options = {"chunk_size": 3, "n_action_steps": 3} if head == "flow" else {}
    config = PocketVLAConfig(
        head=head, device="cpu", hidden_width=16, hidden_depth=1, flow_width=16, flow_depth=1, push_to_hub=False,
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (6,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))}, **options,
    )  # fmt: skip
    return PocketVLAPolicy(config).eval()


@pytest.mark.parametrize("kind", ["gaussian", "categorical", "flow", "act"])
def test_it_reaches_what_acts_of_real_policies(kind):
    policy = make_act() if kind == "act" else make_pocketvla(kind)
    action_dim = policy.config.action_feature.shape[0]
    rng = np.random.default_rng(0)
    columns = {"observation.state": 5, "observation.environment_state": 6, "action": action_dim}
    columns = {name: rng.uniform(-1, 1, (9, width)).astype(np.float32) for name, width in columns.items()}
    cloning = make_cloning(policy, [Segment("put the bear on the carpet", columns)])
    trainable = make_trainable(policy, AdapterOptions())
    groups = {group["name"]: list(group["params"]) for group in trainable.rl_parameter_groups()}
    cloning.check(groups["policy"])
    cloning.begin_update(0)
    assert cloning.add_gradients(groups["policy"])["clone_grad_norm"] > 0
    untouched = {name for name, param in trainable.named_parameters() if param.grad is None}
    value = {id(param) for param in groups["value"]}
    names = {name for name, param in trainable.named_parameters() if id(param) in value}
    # The noise around ACT's chunk is the adapter's, and its latent is 0 when it acts.
    other = {name for name in untouched if "vae_encoder" in name or name == "log_std"}
    assert untouched == names | other
    assert bool(other) == (kind == "act")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coef": -1.0}, r"algorithm\.self_imitation\.coef must be >= 0, got -1"),
        ({"batch_size": 0}, r"algorithm\.self_imitation\.batch_size must be >= 1, got 0"),
        ({"max_age": -1}, r"algorithm\.self_imitation\.max_age must be >= 0, got -1"),
        ({"memory_gib": 0.0}, r"algorithm\.self_imitation\.memory_gib must be > 0, got 0"),
    ],
)
def test_bad_values_of_a_group_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        SelfImitationConfig(**options)


def test_a_share_of_demonstrations_needs_them_and_a_weight():
    with pytest.raises(ValueError, match=r"demos_share=0\.5 needs --algorithm\.demos\.repo_id"):
        PPOConfig(demos_share=0.5)
    options = copy.deepcopy(PPOConfig().demos)
    options.repo_id = "me/demos"
    with pytest.raises(ValueError, match=r"--algorithm\.self_imitation\.coef above 0"):
        PPOConfig(demos_share=0.5, demos=options)
    with pytest.raises(ValueError, match=r"demos\.repo_id=me/demos is not learned from with .*demos_share=0: "):
        PPOConfig(demos=options)
    with pytest.raises(ValueError, match=r"algorithm\.demos_share must be >= 0 and <= 1, got 2"):
        PPOConfig(demos_share=2.0)
