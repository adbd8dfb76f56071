"""Success by segment in streams: counted right for an agent whose outcomes are known."""

import numpy as np
from lerobot_env_cronos import CronosVectorEnv
from tiny_checkpoints import TINY_ACT, TOLD, save_policy

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.report.stream_video import ExpertSpectator, Spectator, make_spectator
from cronos_lerobot.studies.stream_evaluation import (
    Start,
    StreamOutcomes,
    classify_starts,
    draw_stuck,
    rows_by_segment,
    rows_by_start,
    run_streams,
)

PROTOCOL = ProtocolConfig(scene_reset_interval=None, end_effector_reset=True)


class Idle(Spectator):
    """Holds still with an open gripper."""

    def choose(self, o_t, tau):
        return np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(tau), 1))


class ExpertEverySecondSegment(ExpertSpectator):
    """Works in segments 0, 2, ... and holds still in the others."""

    segment = -1

    def begin_segment(self):
        super().begin_segment()
        self.segment += 1

    def choose(self, o_t, tau):
        return super().choose(o_t, tau) if self.segment % 2 == 0 else Idle().choose(o_t, tau)


def make_env() -> CronosVectorEnv:
    return CronosVectorEnv(4, obs_type="environment_state_agent_pos")


def test_outcomes_are_those_of_each_segment_and_stream():
    outcomes = run_streams(make_env(), Idle(), PROTOCOL, 2)
    assert outcomes.success.shape == (2, 4)
    assert not outcomes.success.any()
    assert (outcomes.start == Start.FREE).all()


def test_the_experts_segments_succeed_and_the_idle_ones_do_not():
    env = make_env()
    outcomes = run_streams(env, ExpertEverySecondSegment(env), PROTOCOL, 4)
    # Two tasks lie between two working segments, none of them done in passing.
    assert outcomes.success.all(axis=1).tolist() == [True, False, True, False]
    assert not outcomes.success[[1, 3]].any()
    assert (outcomes.start != Start.COMPLETE).all()
    # The expert picks up what it puts down.
    assert not outcomes.never_grasped.any()


def test_a_task_left_complete_is_found_so_when_its_turn_comes_again():
    class Once(ExpertEverySecondSegment):
        def choose(self, o_t, tau):
            return ExpertSpectator.choose(self, o_t, tau) if self.segment == 0 else Idle().choose(o_t, tau)

    env = make_env()
    outcomes = run_streams(env, Once(env), PROTOCOL, 5)
    assert outcomes.success.all(axis=1).tolist() == [True, False, False, False, True]
    # Tasks: (bottle, plate), (bottle, cloth), (shovel, plate), (shovel, cloth); stream i begins with task i.
    other, occupied, free = Start.ON_OTHER_RECEPTACLE, Start.RECEPTACLE_OCCUPIED, Start.FREE
    assert outcomes.start[1].tolist() == [other, free, other, free]
    assert outcomes.start[2].tolist() == [occupied, occupied, occupied, occupied]
    assert outcomes.start[3].tolist() == [free, other, free, other]
    assert (outcomes.start[4] == Start.COMPLETE).all()
    assert [row[:3] for row in rows_by_segment(outcomes)] == [
        ("0", 4, 4), ("1", 0, 4), ("2", 0, 4), ("3", 0, 4), ("4", 4, 4), ("all", 8, 20),
    ]  # fmt: skip
    assert [row[:3] for row in rows_by_start(outcomes)] == [
        ("complete", 4, 4), ("on_other_receptacle", 0, 4), ("receptacle_occupied", 0, 4), ("free", 4, 8),
    ]  # fmt: skip


def test_bodies_out_of_reach_are_lost():
    env = make_env()
    env.simulation.move_body(np.array([1]), "ketchup bottle", np.array([[0.8, 0.5, -0.74, 1, 0, 0, 0]]))
    env.simulation.move_body(np.array([2]), "cloth", np.array([[0.8, 0.5, -0.74, 1, 0, 0, 0]]))
    # All are told to put the bottle on the plate: the cloth does not matter.
    assert classify_starts(env).tolist() == [Start.FREE, Start.LOST, Start.FREE, Start.FREE]


def test_streams_in_which_the_policy_did_nothing_are_stuck_and_drawn():
    success = np.array([[1, 1, 0], [1, 0, 0], [1, 0, 1], [1, 0, 0]], bool)
    start = np.full((4, 3), Start.FREE)
    start[2:, :2] = Start.COMPLETE
    env = make_env()
    positions = np.repeat(env.positions(np.arange(3))[None], 4, axis=0)
    outcomes = StreamOutcomes(success, start, positions, [["put it there"] * 3] * 4, np.zeros_like(success))
    assert outcomes.stuck(2).tolist() == [0, 1]
    status = outcomes.describe(2, 1)
    assert (status.succeeded, status.outcomes, status.message) == (False, [True, False, False], "begins complete")
    # Three streams are fewer than the rows there could be.
    assert draw_stuck(env, outcomes).size == (4 * 326 + 6, 3 * 246 + 6)


def test_a_policy_with_chunks_that_is_told_the_task_in_its_state(tmp_path):
    env_config, agent = make_spectator(str(save_policy(tmp_path, "act", TOLD, **TINY_ACT)))
    env = CronosVectorEnv(2, env_config.scene, **env_config.gym_kwargs)
    protocol = ProtocolConfig(task_switch_interval=6, update_interval=6, scene_reset_interval=None)
    outcomes = run_streams(env, agent, protocol, 2)
    assert outcomes.success.shape == (2, 2)
    # It is told different tasks, and so acts differently in streams that see the same otherwise.
    observation = env.observe()
    state = observation["agent_pos"]
    state[1, :13], observation["environment_state"][1] = state[0, :13], observation["environment_state"][0]
    agent.begin_segment()
    first, second = agent.choose(observation, env.instructions)
    assert (state[0] != state[1]).any()
    assert np.abs(first - second).max() > 1e-6


def test_positions_are_those_at_the_end_of_each_segment():
    env = make_env()
    protocol = ProtocolConfig(scene_reset_interval=None, end_effector_reset=False)
    outcomes = run_streams(env, ExpertEverySecondSegment(env), protocol, 2)
    np.testing.assert_array_equal(outcomes.positions[1], env.positions(np.arange(4)))
    # The second segment only holds the arm where the first one moved it.
    assert np.abs(outcomes.positions[1] - outcomes.positions[0]).max() < 0.2
    first, second = outcomes.instructions
    assert all(a != b for a, b in zip(first, second))


def test_successes_without_a_grasp_have_a_column():
    success = np.array([[1, 1, 0], [1, 1, 1]], bool)
    start = np.full((2, 3), Start.FREE)
    start[1, 2] = Start.COMPLETE
    never_grasped = np.array([[0, 1, 0], [1, 1, 0]], bool)
    outcomes = StreamOutcomes(success, start, np.zeros((2, 3, 1)), [[""] * 3] * 2, never_grasped)
    counts = [(name, k, n, complete, never) for name, k, n, _, _, complete, never in rows_by_segment(outcomes)]
    assert counts == [("0", 2, 3, 0, 1), ("1", 3, 3, 1, 2), ("all", 5, 6, 1, 3)]
    assert [(row[0], row[-1]) for row in rows_by_start(outcomes)] == [("complete", 0), ("free", 3)]
