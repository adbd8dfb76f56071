"""Chains in streams: the order of work, refilling, what actors are told, and that batches do not matter."""

import numpy as np
import pytest
from lerobot_env_cronos import get_scene

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.evaluation.chains import Chain, ChainRunner, Rules

TASKS = get_scene("kitchen_2x2").tasks
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


class ScriptedStreams:
    """Only what an evaluation needs: task j of configuration c is complete after `SCRIPT[c][j]` steps."""

    def __init__(self, num_envs, diverge_at=()):
        self.num_envs, self.diverge_at = num_envs, diverge_at
        self.configuration, self.position, self.elapsed = (np.zeros(num_envs, int) for _ in range(3))
        self.homed, self.clock = [], 0

    def scene_reset(self, ids, configurations, split):
        assert split == "train"
        self.configuration[ids] = configurations

    def set_task(self, ids, tasks):
        self.position[ids] = [TASKS.index(task) for task in tasks]
        self.elapsed[ids] = 0

    def end_effector_reset(self, ids):
        self.homed.append((self.clock, ids.tolist()))

    def observe(self, ids=None):
        numbers = np.stack([self.configuration, self.position, self.elapsed], axis=1)
        return {"agent_pos": numbers if ids is None else numbers[ids]}

    def step(self, actions):
        assert actions.shape == (self.num_envs, 7)
        self.clock += 1
        self.elapsed += 1
        due = [SCRIPT[c][j] for c, j in zip(self.configuration, self.position, strict=True)]
        diverged = np.array([(self.clock, i) in self.diverge_at for i in range(self.num_envs)])
        # Held for this one step only: that is enough.
        info = {"is_success": self.elapsed == due, "diverged": diverged}
        return self.observe(), np.zeros(self.num_envs), None, None, info


class Idle:
    """Does nothing, and keeps what it was told."""

    temperature = None

    def __init__(self, is_per_stream=True):
        self.is_per_stream, self.begun, self.seeds, self.asked = is_per_stream, [], [], []

    def begin(self, ids, seeds=None):
        self.begun.append((len(self.asked), ids.tolist()))
        self.seeds += list(seeds or [])

    def act(self, observation, instructions, ids):
        self.asked.append(ids.tolist())
        seen = observation["agent_pos"]
        if self.is_per_stream:
            # Fresh and of the task at hand, also in the first step after a switch or a start.
            assert [TASKS[j].instruction for j in seen[:, 1]] == instructions
            assert (seen[:, 2] < 80).all()
        return ActionSample(np.zeros((len(ids), 7), np.float32))


def run(num_envs, actor=None, chains=CHAINS, diverge_at=(), **rules):
    env = ScriptedStreams(num_envs, diverge_at)
    return ChainRunner(env, actor or Idle(), Rules(**rules)).run(chains, "train", (7, 1, 0)), env


@pytest.mark.parametrize("advance", ["window", "on_success"])
@pytest.mark.parametrize("is_per_stream", [True, False])
@pytest.mark.parametrize("num_envs", [1, 3, 7])
def test_lengths_and_steps_by_hand_whatever_the_batch(num_envs, is_per_stream, advance):
    results, _ = run(num_envs, Idle(is_per_stream), advance=advance)
    assert [r.chain for r in results] == CHAINS
    assert [r.length for r in results] == LENGTHS
    assert [r.steps for r in results] == STEPS[advance]


def test_a_stream_goes_on_after_failures_for_as_many_windows_as_tasks():
    results, env = run(2, stops=False, end_effector_reset=True, chains=CHAINS[:4])
    assert [r.steps for r in results] == [320] * 4
    assert [list(r.success) for r in results] == [[when < NEVER for when in SCRIPT[c]] for c in range(4)]
    # At every switch, and not where a chain starts.
    assert env.homed == [(clock, [0, 1]) for clock in (80, 160, 240, 400, 480, 560)]


def test_a_failed_chain_makes_room_at_once():
    actor = Idle()
    run(2, actor, advance="on_success")
    # Stream 0: chains 0 (100 steps), 3 (83) to 183. Stream 1: chains 1 (90), 2 (80) to 170, then 4 (320) to 490.
    assert actor.asked == [[0, 1]] * 183 + [[1]] * (490 - 183)
    assert [step for step, ids in actor.begun if 0 in ids] == [0, 10, 30, 60, 100, 101, 102, 103]
    assert [step for step, ids in actor.begun if 1 in ids] == [0, 10, 90, 170, 250, 330, 410]


def test_a_policy_with_one_memory_is_started_for_all_at_once_and_always_asked_for_all():
    actor = Idle(is_per_stream=False)
    run(2, actor)
    # Batches of chains (0, 1), (2, 3) and (4): as long as the longest of each.
    assert actor.asked == [[0, 1]] * (280 + 320 + 320)
    starts = [step for step, ids in actor.begun if len(ids) == 2 or step >= 600]
    assert starts[0] == 0
    assert {280, 600} <= {step for step, _ in actor.begun}


def test_a_chain_has_its_own_seed_in_whatever_stream_it_runs():
    for num_envs in (1, 5):
        actor = Idle()
        run(num_envs, actor)
        assert sorted(actor.seeds) == [(7, 1, 0, 0, configuration) for configuration in SCRIPT]


def test_a_broken_simulation_ends_a_chain_as_a_failure_and_a_stream_not():
    # Task 0 of configuration 0 would be complete in step 10.
    (chain,), _ = run(1, chains=CHAINS[:1], diverge_at={(10, 0)})
    assert (chain.length, chain.steps) == (0, 10)
    (stream,), _ = run(1, chains=CHAINS[:1], diverge_at={(10, 0)}, stops=False)
    assert (stream.success, stream.steps) == ([False, True, True, True], 320)


def test_found_and_ungrasped_successes_and_trajectories():
    class Known(ScriptedStreams):
        """Task 1 is complete when it is given, task 2's object is grasped in step 5 of its window."""

        is_success = property(lambda self: self.position == 1)
        is_grasped = property(lambda self: np.zeros(self.num_envs, bool))

        def step(self, actions):
            observation, reward, _, _, info = super().step(actions)
            return (
                observation,
                reward,
                None,
                None,
                info | {"is_grasped": (self.position == 2) & (self.elapsed == 5)},
            )

        def positions(self, ids):
            return np.stack([self.position, self.elapsed], axis=1)[ids].astype(float)

    env = Known(1)
    (result,) = ChainRunner(env, Idle(), states=env.positions).run(CHAINS[:1], "train", (0,))
    assert (result.found_complete, result.never_grasped) == ([1], [0, 3])
    trajectory = result.trajectory
    assert trajectory.states.shape == (result.steps + 1, 2)
    # Where the world does not say what is grasped, nobody knows.
    assert run(1, chains=CHAINS[:1])[0][0].never_grasped is None
    # Complete from the step on which it was, until the window is over.
    assert np.flatnonzero(np.diff(trajectory.is_complete.astype(int)) == 1).tolist() == [9, 99, 189, 279]
    assert np.flatnonzero(np.diff(trajectory.position)).tolist() == [80, 160, 240]
