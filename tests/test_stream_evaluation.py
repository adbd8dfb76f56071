"""Success by segment in streams: counted right for an agent whose outcomes are known."""

import numpy as np
from lerobot_env_cronos import CronosVectorEnv

from cronos_lerobot.protocol import ProtocolConfig
from cronos_lerobot.report.stream_video import ExpertSpectator, Spectator
from cronos_lerobot.stream_evaluation import success_by_segment

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
    outcomes, found = success_by_segment(make_env(), Idle(), PROTOCOL, 2)
    assert outcomes.shape == (2, 4)
    assert not outcomes.any()
    assert not found.any()


def test_the_experts_segments_succeed_and_the_idle_ones_do_not():
    env = make_env()
    outcomes, found = success_by_segment(env, ExpertEverySecondSegment(env), PROTOCOL, 4)
    # Two tasks lie between two working segments, none of them done in passing.
    assert outcomes.all(axis=1).tolist() == [True, False, True, False]
    assert not outcomes[[1, 3]].any()
    assert not found.any()


def test_a_task_left_complete_is_found_so_when_its_turn_comes_again():
    class Once(ExpertEverySecondSegment):
        def choose(self, o_t, tau):
            return ExpertSpectator.choose(self, o_t, tau) if self.segment == 0 else Idle().choose(o_t, tau)

    env = make_env()
    outcomes, found = success_by_segment(env, Once(env), PROTOCOL, 5)
    assert outcomes.all(axis=1).tolist() == [True, False, False, False, True]
    assert found.all(axis=1).tolist() == [False, False, False, False, True]
