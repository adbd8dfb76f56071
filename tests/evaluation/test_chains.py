"""Chains in slots: the order of work, refilling, what actors are told, and that batches do not matter."""

import numpy as np
import pytest
from lerobot_env_cronos import get_scene
from scripted_env import ScriptedEnv

from cronos_lerobot.evaluation.chains import Chain, ChainRunner, chain_noise

TASKS = get_scene("kitchen_2x2").tasks


class ConfigurationEnv(ScriptedEnv):
    """Task j of the chain of configuration c is complete `by_configuration[c][j]` steps after it begins."""

    def __init__(self, num_envs, by_configuration, **kwargs):
        self.by_configuration = by_configuration
        super().__init__([[NEVER] * 4] * num_envs, **kwargs)

    def start(self, ids, orderings, configurations):
        for i, configuration in zip(ids, configurations, strict=True):
            self.script[i] = self.by_configuration[configuration]
        super().start(ids, orderings, configurations)


class Actor:
    """Does nothing, and keeps what it was told."""

    def __init__(self, is_per_environment=True):
        self.is_per_environment, self.begun, self.asked, self.uniform = is_per_environment, [], [], []

    def seed(self, seed):
        pass

    def begin(self, ids):
        self.begun.append(ids.tolist())

    def act(self, observation, instructions, uniform, ids):
        assert len(observation["agent_pos"]) == len(instructions) == len(uniform) == len(ids)
        self.asked.append(ids.tolist())
        self.uniform.append(uniform)
        return np.zeros((len(ids), 7))


NEVER = 81
SCRIPT = {
    0: [10, 20, 30, 40],  # all four tasks
    1: [10, NEVER, 1, 1],  # one
    2: [NEVER, 1, 1, 1],  # none
    3: [1, 1, 1, NEVER],  # three
    4: [80, 80, 80, 80],  # all four, at the last moment
}
LENGTHS = [4, 1, 0, 3, 4]
STEPS = {
    "window": [3 * 80 + 40, 2 * 80, 80, 4 * 80, 320],
    "on_success": [100, 10 + 80, 80, 3 + 80, 320],
}
CHAINS = [Chain(0, TASKS, configuration) for configuration in SCRIPT]


def no_noise(chain):
    return np.zeros((320, 7), np.float32)


def run(num_envs, actor=None, chains=CHAINS, noise=no_noise, **kwargs):
    env = ConfigurationEnv(num_envs, SCRIPT, **kwargs)
    return ChainRunner(env, actor or Actor()).run(chains, noise), env


@pytest.mark.parametrize("advance", ["window", "on_success"])
@pytest.mark.parametrize("is_per_environment", [True, False])
@pytest.mark.parametrize("num_envs", [1, 2, 3, 5, 7])
def test_lengths_and_steps_by_hand_whatever_the_batch(num_envs, is_per_environment, advance):
    results, _ = run(num_envs, Actor(is_per_environment), advance=advance)
    assert [r.chain for r in results] == CHAINS
    assert [r.length for r in results] == LENGTHS
    assert [r.steps for r in results] == STEPS[advance]
    assert [r.is_success for r in results] == [True, False, False, False, True]


def test_a_failed_chain_makes_room_at_once_and_costs_nothing_any_more():
    actor = Actor()
    _, env = run(2, actor, advance="on_success")
    # Slot 0: chains 0 (100 steps), 3 (83) to 183. Slot 1: chains 1 (90), 2 (80) to 170, then 4 (320) to 490.
    expected = [[0, 1]] * 183 + [[1]] * (490 - 183)
    assert actor.asked == env.stepped == expected
    begun = [(step, ids) for step, ids in enumerate(actor.begun) if ids]
    assert [step for step, ids in begun if 0 in ids] == [0, 10, 30, 60, 100, 101, 102, 103]
    assert [step for step, ids in begun if 1 in ids] == [0, 10, 90, 170, 250, 330, 410]


def test_a_policy_with_a_memory_is_started_for_all_at_once_and_always_asked_for_all():
    actor = Actor(is_per_environment=False)
    run(2, actor)
    # Batches of chains (0, 1), (2, 3) and (4): as long as the longest of each.
    assert len(actor.asked) == 280 + 320 + 320
    assert actor.asked == [[0, 1]] * len(actor.asked)
    # At the start, and at every switch of windows: the task is new for all that run.
    assert [step for step, ids in enumerate(actor.begun) if ids] == [
        0,
        80,
        160,
        240,
        280,
        360,
        440,
        520,
        600,
        680,
        760,
        840,
    ]


def test_every_chain_gets_its_own_noise_step_by_step():
    seen = {}
    for num_envs in (1, 5):
        actor, noise = Actor(), chain_noise(80, 7, 1, 0)
        run(num_envs, actor, noise=noise)
        rows = [u for uniform in actor.uniform for u in uniform]
        assert len(rows) == sum(STEPS["window"])
        seen[num_envs] = sorted(map(tuple, rows))
        if num_envs == 1:
            drawn = [noise(chain)[:steps] for chain, steps in zip(CHAINS, STEPS["window"], strict=True)]
            np.testing.assert_array_equal(np.concatenate(drawn), rows)
    assert seen[1] == seen[5]


def test_noise_differs_by_seed_suite_split_number_and_configuration_and_lies_in_the_unit_interval():
    chain = Chain(3, TASKS, 5)
    draws = [chain_noise(80, 7, 1, 0)(chain)]
    assert draws[0].shape == (320, 7)
    assert 0 <= draws[0].min() < draws[0].max() < 1
    np.testing.assert_array_equal(draws[0], chain_noise(80, 7, 1, 0)(chain))
    draws += [chain_noise(80, *key)(chain) for key in ((8, 1, 0), (7, 0, 0), (7, 1, 1))]
    draws += [chain_noise(80, 7, 1, 0)(other) for other in (Chain(4, TASKS, 5), Chain(3, TASKS, 6))]
    assert len({draw.tobytes() for draw in draws}) == len(draws)


def test_trajectories_tell_what_happened():
    results, env = run(2)
    for result in results:
        trajectory = result.trajectory
        assert trajectory.qpos.shape == (result.steps + 1, env.simulation.model.nq)
        assert trajectory.position[0] == 0
        assert not trajectory.is_complete[0]
    first = results[0].trajectory
    # Complete from the step on which it was, until the window is over.
    assert np.flatnonzero(np.diff(first.is_complete.astype(int)) == 1).tolist() == [9, 99, 189, 279]
    assert np.flatnonzero(np.diff(first.is_complete.astype(int)) == -1).tolist() == [80, 160, 240]
    assert np.flatnonzero(np.diff(first.position)).tolist() == [80, 160, 240]


def test_chains_of_one_task_are_independent_episodes():
    chains = [Chain(i, (task,), configuration) for i, task in enumerate(TASKS) for configuration in (1, 3)]
    results, _ = run(3, chains=chains)
    # SCRIPT goes by task: of configuration 1 the second fails, of 3 the last.
    assert [r.length for r in results] == [1, 1, 0, 1, 1, 1, 1, 0]
    assert [r.steps for r in results] == [10, 1, 80, 1, 1, 1, 1, 80]


def test_results_are_reported_as_they_come_in():
    came = []
    env = ConfigurationEnv(5, SCRIPT)
    ChainRunner(env, Actor()).run(CHAINS, no_noise, lambda result: came.append(result.chain.configuration))
    assert came == [2, 1, 0, 3, 4]
