"""The second task under four conditions: what is put back is, what is left is not."""

import numpy as np
import pytest
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.scene.robot import HOME_QPOS
from lerobot_env_cronos.simulation.simulation import NUM_ARM_JOINTS

from cronos_lerobot.report.stream_video import ExpertSpectator
from cronos_lerobot.studies.start_bias import CONDITIONS, SecondTask, pool, rows, run_second_tasks


class Watchful(ExpertSpectator):
    """The expert, which takes down the scene that each task begins with and the one that it ends with."""

    def __init__(self, env):
        super().__init__(env)
        self.env, self.starts, self.forgotten = env, [], []

    def begin_segment(self):
        super().begin_segment()
        simulation = self.env.simulation
        self.starts.append((simulation.qpos[:, :NUM_ARM_JOINTS].copy(), simulation.body_poses()[..., :3].copy()))
        self.tasks = list(self.env.tasks)

    def forget(self, ids):
        if len(ids):
            self.forgotten.append((len(self.starts), ids.tolist()))

    def choose(self, o_t, tau):
        action = super().choose(o_t, tau)
        simulation = self.env.simulation
        self.last = simulation.qpos[:, :NUM_ARM_JOINTS].copy(), simulation.body_poses()[..., :3].copy()
        if len(self.starts) == 1:
            self.end_of_first = self.last
        return action


class SaysDiverged(CronosVectorEnv):
    """Says once that stream 2 has diverged, in the middle of the second task."""

    steps = 0

    def step(self, actions):
        *rest, info = super().step(actions)
        self.steps += 1
        info["diverged"][2] = self.steps == 80 + 7
        return *rest, info


@pytest.fixture(scope="module")
def watched():
    env = SaysDiverged(4, obs_type="environment_state_agent_pos")
    agent = Watchful(env)
    outcomes = run_second_tasks(env, agent, "held_out")
    return env, agent, outcomes


def test_each_condition_puts_back_what_it_says_and_nothing_else(watched):
    env, agent, _ = watched
    placed = env.benchmark.configurations["held_out"][:, :, :3]
    arm_after, bodies_after = agent.end_of_first
    for (bodies, arm), (arm_start, bodies_start) in zip(CONDITIONS, agent.starts[1:], strict=True):
        if arm == "home":
            np.testing.assert_allclose(arm_start, np.tile(HOME_QPOS, (4, 1)), atol=0.02)
        else:
            # One control step lies between the last look and the end of the task.
            np.testing.assert_allclose(arm_start, arm_after, atol=0.15)
            assert np.abs(arm_start - HOME_QPOS).max(1).min() > 0.2
        expected = placed[1:5] if bodies == "new" else bodies_after
        np.testing.assert_allclose(bodies_start, expected, atol=0.01)


def test_the_next_task_of_the_cycle_is_given_and_the_expert_does_it(watched):
    env, agent, outcomes = watched
    assert agent.tasks == [env.scene.tasks[1]] * 4  # four configurations of the first task
    assert [(o.bodies, o.arm) for o in outcomes] == list(CONDITIONS)
    for (*_, k, n, _low, _high, complete, never), outcome in zip(rows(outcomes), outcomes, strict=True):
        assert (k, n, complete, never) == (4, 4, 0, 0), outcome


def test_the_plan_of_a_stream_that_diverges_is_forgotten(watched):
    _, agent, _ = watched
    assert agent.forgotten == [(2, [2])]


def test_seeds_are_counted_together_but_not_conditions():
    def outcome(bodies, success, complete, grasped=(True, True)):
        return SecondTask(bodies, "home", np.array(success), np.array(complete), np.array(grasped))

    first = [
        outcome("new", [True, False], [False, False]),
        outcome("left", [True, True], [True, False], (False, False)),
    ]
    second = [outcome("new", [True, True], [False, False]), outcome("left", [False, False], [False, False])]
    table = [(bodies, k, n, *apart) for bodies, _, k, n, _, _, *apart in rows(pool([first, second]))]
    # A task that was complete when it was given does not count.
    assert table == [("new", 3, 4, 0, 0), ("left", 1, 3, 1, 1)]
