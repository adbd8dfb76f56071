import numpy as np
import pytest
import torch
from dummies import TASKS, DummyEnv, DummyPolicy, identity_processors

from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.evaluation.rates import SuccessRate
from cronos_lerobot.training.evaluation import evaluate_independent

PROCESSORS = PolicyProcessors(*identity_processors())


class ScriptedPolicy(DummyPolicy):
    """Walks towards positive goals, never towards negative ones; counts its calls."""

    calls = 0

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        self.calls += 1
        actions = torch.zeros(len(batch["task"]), 7)
        goals = torch.tensor([float(text.removeprefix("go to ")) for text in batch["task"]])
        actions[:, 0] = (goals > 0) * torch.sign(goals - batch["observation.state"][:, 0])
        return {"action": actions}


def evaluate(policy, num_envs=8, **options):
    return evaluate_independent(DummyEnv(num_envs), TASKS, policy, PROCESSORS, **options)


@pytest.mark.parametrize("num_envs", [1, 5, 16])
def test_every_task_from_every_configuration(num_envs):
    result = evaluate(ScriptedPolicy(), num_envs, configurations=range(6))
    by_task = {task: sum(flags) for task, flags in result.successes.items()}
    assert by_task == {"go to 1.0": 6, "go to -1.0": 0, "go to 2.0": 6, "go to -2.0": 0}
    assert result.overall == SuccessRate(12, 24)
    record = result.to_dict()
    assert (record["success"], record["n"]) == (0.5, 24)
    assert record["per_task"]["go to 1.0"]["success"] == 1


def test_a_success_counts_at_any_step_and_80_steps_are_all():
    policy = ScriptedPolicy()
    evaluate_independent(DummyEnv(2), [TASKS[0]], policy, PROCESSORS, configurations=range(2))
    assert policy.calls < 10  # both have been there
    policy = ScriptedPolicy()
    evaluate_independent(DummyEnv(2), [TASKS[1]], policy, PROCESSORS, configurations=range(2))
    assert policy.calls == 80


@pytest.mark.parametrize("num_envs", [2, 4])
def test_an_episode_is_simulated_until_its_success(num_envs):
    env = DummyEnv(num_envs)
    # From -0.375 and 0.125, 0.2 a step, to within 0.3 of 1.0.
    evaluate_independent(env, [TASKS[0]], ScriptedPolicy(), PROCESSORS, configurations=[1, 5])
    assert env.moved == 6 + 3


def test_it_succeeds_as_if_all_episodes_were_simulated_to_the_end():
    env, policy, succeeded = DummyEnv(8), DummyPolicy(seed=1), np.zeros(8, bool)
    env.scene_reset(np.arange(8), np.arange(8))
    generator = torch.Generator().manual_seed(5)
    observation = env.observe()
    for _ in range(12):
        batch = PROCESSORS.batch({"observation.state": observation["agent_pos"]}, [TASKS[0].instruction] * 8)
        actions = policy.sample_actions(batch, temperature=0.6, generator=generator)["action"]
        observation, _, _, _, info = env.step(PROCESSORS.physical_actions(actions))
        succeeded |= info["is_success"]
    result = evaluate_independent(
        DummyEnv(8), [TASKS[0]], policy, PROCESSORS, configurations=range(8), temperature=0.6, seed=5, num_steps=12
    )
    assert result.successes[TASKS[0].instruction] == succeeded.tolist()
    assert 0 < succeeded.sum() < 8


def test_split_and_configurations_reach_the_environment():
    seen = []

    class Env(DummyEnv):
        def scene_reset(self, ids, configurations, split="train"):
            seen.append((configurations.tolist(), split))
            super().scene_reset(ids, configurations, split)

    evaluate_independent(Env(4), TASKS[:1], ScriptedPolicy(), PROCESSORS, configurations=[3, 9], split="held_out")
    assert seen == [([3, 9, 9, 9], "held_out")]


def test_sampling_is_seeded_and_leaves_the_global_generators_alone():
    policy = DummyPolicy(seed=1)
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first = evaluate(policy, seed=3, configurations=range(6))
    np.random.rand()
    torch.rand(5)
    second = evaluate(policy, seed=3, configurations=range(6))
    third = evaluate(policy, seed=4, configurations=range(6))
    assert first == second
    assert first.successes != third.successes
    torch.manual_seed(0)
    evaluate(policy, seed=3, configurations=range(6))
    assert torch.equal(state, torch.get_rng_state())


def test_a_broken_simulation_is_no_success():
    env = DummyEnv(1, diverge_at={(t, 0) for t in range(80)})
    result = evaluate_independent(env, [TASKS[0]], ScriptedPolicy(), PROCESSORS, configurations=[0])
    assert result.overall == SuccessRate(0, 1)


def test_a_broken_simulation_ends_its_episode():
    outcomes = [
        evaluate_independent(env, [TASKS[0]], ScriptedPolicy(), PROCESSORS, configurations=[0, 1]).successes
        for env in (DummyEnv(2), DummyEnv(2, diverge_at={(0, 1)}))
    ]
    assert outcomes == [{TASKS[0].instruction: [True, True]}, {TASKS[0].instruction: [True, False]}]
