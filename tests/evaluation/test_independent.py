"""The evaluation while training: every episode once, as long as it lasts, and actors by themselves."""

import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicy, identity_processors

from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.evaluation.actors import SamplingPolicy
from cronos_lerobot.evaluation.independent import evaluate_independent

PROCESSORS = PolicyProcessors(*identity_processors())
OPTIONS = {"n_episodes": 6, "split": "train", "temperature": 0.6, "seed": 1000}


class ScriptedPolicy(DummyPolicy):
    """Walks towards positive goals, never towards negative ones; counts the rows that it is asked for."""

    rows = 0

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        self.rows += len(batch["task"])
        actions = torch.zeros(len(batch["task"]), 7)
        goals = torch.tensor([float(text.removeprefix("go to ")) for text in batch["task"]])
        actions[:, 0] = (goals > 0) * torch.sign(goals - batch["observation.state"][:, 0])
        return {"actions": actions[:, None]}


def evaluate(env, policy, **options):
    return evaluate_independent(env, policy, PROCESSORS, **OPTIONS | options)


@pytest.mark.parametrize("num_envs", [1, 5, 64])
def test_every_task_from_every_configuration_and_not_a_step_more(num_envs):
    env, policy = DummyEnv(num_envs), ScriptedPolicy()
    result = evaluate(env, policy)
    assert {task: rate["success"] for task, rate in result["per_task"].items()} == {
        "go to 1.0": 1, "go to -1.0": 0, "go to 2.0": 1, "go to -2.0": 0,
    }  # fmt: skip
    assert (result["success"], result["n"], result["split"], result["temperature"]) == (0.5, 24, "train", 0.6)
    # From -0.5, -0.375, ... 0.125 in steps of 0.2 to within 0.3 of 1 and of 2; two tasks for 80 steps.
    to_one, to_two = [7, 6, 5, 5, 4, 3], [12, 11, 10, 10, 9, 8]
    assert policy.rows == result["steps"] == sum(to_one) + sum(to_two) + 2 * 6 * 80
    assert result["episodes"] == [
        [1000, task, configuration, int(task in (0, 2))] for task in range(4) for configuration in range(6)
    ]


def test_repetitions_are_as_many_episodes_with_random_numbers_of_their_own():
    class Restless(DummyPolicy):
        """Keeps still, and remembers the first random number of each episode batch."""

        def sample_actions(self, batch, *, temperature=1.0, generator=None):
            draws.append(float(torch.rand(1, generator=generator)))
            return {"actions": torch.zeros(len(batch["task"]), 7)[:, None]}

    draws = []
    result = evaluate(DummyEnv(4), Restless(), n_episodes=1, repetitions=3)
    assert (result["n"], {rate["n"] for rate in result["per_task"].values()}) == (12, {3})
    assert [episode[0] for episode in result["episodes"]] == [1000] * 4 + [1001] * 4 + [1002] * 4
    # 80 decisions of all four tasks at once, three times over.
    assert len(draws) == 240
    assert len({tuple(draws[i : i + 80]) for i in (0, 80, 160)}) == 3


def test_what_does_not_sample_at_a_temperature_is_not_repeated():
    class Selecting(DummyPolicy):
        """A LeRobot policy without `sample_actions`, such as ACT."""

        sample_actions = None

        def predict_action_chunk(self, batch, **kwargs):
            return torch.zeros(len(batch["observation.state"]), 1, 7)

    result = evaluate(DummyEnv(4), Selecting(), n_episodes=1, repetitions=3)
    assert (result["n"], result["temperature"], {episode[0] for episode in result["episodes"]}) == (
        4,
        None,
        {1000},
    )


def test_it_leaves_the_global_generators_and_the_policys_mode_alone():
    policy = DummyPolicy(seed=1).train()
    torch.manual_seed(0)
    np.random.seed(0)
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    first = evaluate(DummyEnv(8), policy, seed=3)
    assert torch.equal(torch_state, torch.get_rng_state())
    assert np.array_equal(numpy_state, np.random.get_state()[1])
    assert policy.training
    torch.rand(5)
    assert evaluate(DummyEnv(8), policy, seed=3) == first
    assert evaluate(DummyEnv(8), policy, seed=4)["steps"] != first["steps"]


def test_what_has_sample_actions_alone_is_evaluated():
    """An agent's `acting` may be no module: it has no modes and no config."""

    class Acting:
        rows, sample_actions = 0, ScriptedPolicy.sample_actions

    assert evaluate(DummyEnv(5), Acting()) == evaluate(DummyEnv(5), ScriptedPolicy())


class Counting:
    """Decides on the next three whole numbers after what it sees."""

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        first = batch["observation.state"][:, :1]
        return {"actions": (first + torch.arange(3.0))[..., None].repeat(1, 1, 7)}


def make_actor(policy):
    return SamplingPolicy(policy, PolicyProcessors(lambda batch: batch, lambda action: action), 1.0, 7)


def act(actor, ids, seen):
    columns = {"agent_pos": np.array(seen, np.float32)[:, None]}
    return actor.act(columns, [""] * len(ids), np.array(ids)).action[:, 0].tolist()


def test_decisions_of_several_actions_are_played_by_each_stream_for_itself():
    actor = make_actor(Counting())
    assert act(actor, [0, 1, 2], [0, 10, 20]) == [0, 10, 20]
    assert act(actor, [0, 2], [5, 25]) == [1, 21]
    # A new task begins in 2 and 1 has been waiting; 0 plays on.
    actor.begin(np.array([2]))
    assert act(actor, [0, 1, 2], [6, 16, 26]) == [2, 11, 26]
    assert act(actor, [0, 1, 2], [7, 17, 27]) == [7, 12, 27]


def test_a_streams_randomness_is_its_own_whatever_streams_are_beside_it():
    class Uniform:
        """Plays its random numbers, each decision twice."""

        def sample_actions(self, batch, *, temperature=1.0, generator=None, uniform):
            return {"actions": uniform[:, None].repeat(1, 2, 1)}

    seeds = {0: (7, 0), 1: (7, 1)}
    rows = {i: np.random.default_rng(seed).random((6, 7), dtype=np.float32) for i, seed in seeds.items()}
    expected = {i: [row[0] for row in (r[0], r[0], r[2], r[2], r[4], r[4])] for i, r in rows.items()}
    both = make_actor(Uniform())
    both.begin(np.arange(2), [seeds[0], seeds[1]])
    played = [act(both, [0, 1], [0, 0]) for _ in range(6)]
    assert played == [[expected[0][t], expected[1][t]] for t in range(6)]
    # Stream 1 alone, in another place.
    alone = make_actor(Uniform())
    alone.begin(np.array([5]), [seeds[1]])
    assert [act(alone, [5], [0])[0] for _ in range(6)] == expected[1]
