"""Who is taken over and when, what it costs, and who acts then."""

import json

import numpy as np
import pytest
from dummies import TASKS, DummyEnv
from guiding_expert import Guide
from test_rf_mtrl import DummyAgent, FastEnv, protocol

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.protocol.experts import check_expert, register_expert
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import LoopState, SegmentEnd, Step
from cronos_lerobot.protocol.resets import NoReset, Resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.takeovers import AssistedAgent, Takeover
from cronos_lerobot.protocol.task_orders import TaskSet, make_task_order

K = 2


class Idle(Guide):
    """For worlds in which nothing moves."""

    def act(self, o_t, tau):
        return np.zeros((len(self.ids), 7))


def run(segments, num_streams=2, env=None, agent=None, loop=None, capacity=None, total=None, **options):
    """So many segments of a run without resets; `total` segments if it is to be longer."""
    config = protocol(takeover_after=2, scene_reset_interval=None, end_effector_reset=False, **options)
    env = env or FastEnv(num_streams)
    loop = loop or TaskSet.of(env.scene, config).new_loop(num_streams)
    expert = Idle(env) if isinstance(env, FastEnv) else Guide(env)
    agent = agent or DummyAgent(num_streams, [])
    takeover = Takeover(config, num_streams * K * (total or segments), capacity)
    resets = Resets(NoReset(), NoReset(), NoReset(), NoReset(), (), NoReset(), takeover)
    order = make_task_order("heuristic", np.random.default_rng(0))
    assisted = AssistedAgent(agent, expert, loop)
    steps = num_streams * K * segments
    return loop, expert, list(rf_mtrl(env, TASKS, assisted, order, resets, config, loop, steps))


def taken(events):
    """Streams that are taken over in each segment."""
    return [np.flatnonzero(event.taken_over).tolist() for event in events if isinstance(event, SegmentEnd)]


def test_the_third_try_is_the_experts_and_so_is_the_third_after_it():
    """Four tasks in a cycle, nothing ever succeeds: segments 0 to 3 and 4 to 7 are failures at each of them."""
    loop, expert, events = run(24, takeover_price=3)
    both, none = [[0, 1]] * 4, [[]] * 4
    assert taken(events) == none + none + both + none + none + both
    assert expert.played == both + both
    assert loop.interventions_by_kind()["takeover"] == 16
    assert loop.takeover_cost.tolist() == [24, 24]
    assert loop.b == 48
    # The expert's are no tries of the policy.
    assert loop.attempts.tolist() == [[4] * 4] * 2
    assert loop.recent_task[0, -4:].tolist() == [0, 1, 2, 3]


def test_a_frame_still_says_what_happened_to_the_scene_and_the_count_what_it_cost():
    _, _, events = run(9)
    steps = [event for event in events if isinstance(event, Step)]
    assert {int(step.preceded_by[0]) for step in steps} == {Intervention.NONE, Intervention.TASK_SWITCH}
    assert [int(step.interventions[0]) for step in steps[-4:]] == [0, 0, 1, 1]
    assert [step.taken_over.tolist() for step in steps[-3:]] == [[False, False], [True, True], [True, True]]


def test_what_is_found_complete_is_no_try_and_a_success_begins_anew():
    loop = LoopState(5, 1)
    loop.failures[:, 0] = 1
    loop.switch_task(np.zeros(5, np.int64))
    loop.begin_takeover(np.array([3, 4]), price=1)
    loop.found_complete = np.array([False, True, False, False, False])
    loop.succeeded = np.array([True, True, False, True, False])
    end = loop.end_segment()
    assert loop.failures[:, 0].tolist() == [0, 1, 2, 0, 0]
    assert loop.attempts[:, 0].tolist() == [1, 1, 1, 0, 0]
    assert loop.successes[:, 0].tolist() == [1, 1, 0, 0, 0]
    assert loop.recent_success[:, -1].tolist() == [1, 1, 0, 1, 0]
    assert end.taken_over.tolist() == [False] * 3 + [True] * 2
    loop.switch_task(np.zeros(5, np.int64))
    assert not loop.taken_over.any()


def test_the_budget_is_paced_over_the_run():
    """16 segments, a budget of 8: half a takeover for each. Nothing is due before segment 8."""
    loop, _, events = run(16, takeover_budget=8)
    # With segment s (s + 1) // 2 may be spent: 4 with 8, 5 with 9 and 10, 6 with 11, 7 with 14, 8 with 15.
    # Segments 8 and 9 take both streams, 10 and 11 one each; stream 1 comes to the same tasks again in 14 and 15.
    assert taken(events)[8:] == [[0, 1], [0, 1], [0], [0], [], [], [1], [1]]
    assert loop.b == 8


@pytest.mark.parametrize(
    ("options", "counts"),
    [
        ({"takeover_price": 3, "takeover_budget": 7}, 2),
        ({"takeover_price": 2, "reset_budget": 5}, 2),
        ({"takeover_budget": 3}, 3),
    ],
)
def test_no_budget_is_ever_exceeded(options, counts):
    loop, _, _ = run(40, **options)
    assert loop.interventions_by_kind()["takeover"] == counts


def test_takeovers_leave_the_critics_budget_for_the_rest_of_the_run():
    """One try each, 8 interventions in 40 segments: one for five, and none of them ends the run."""
    values = {"scene_reset": "critic", "reset_budget": 8, "scene_reset_interval": None}
    strategy = Takeover(protocol(takeover_after=1, **values), total_steps=40 * 2 * K)
    loop = LoopState(2, 1)
    loop.failures[:] = 1
    spent = []
    for segment in range(40):
        loop.t = segment * K
        loop.taken_over[:] = False
        strategy.apply_if_due(None, loop)
        spent.append(loop.b)
    assert spent == [(segment + 1) * 8 // 40 for segment in range(40)]
    assert spent[-2:] == [7, 8]


def test_of_several_those_that_failed_most_come_first_then_the_first_streams():
    loop = LoopState(5, 2)
    loop.switch_task(np.array([0, 0, 1, 0, 0]))
    loop.failures[:, 0] = [2, 3, 9, 1, 2]
    config = protocol(takeover_after=2)
    due = [Takeover(config, 100, capacity).due(None, loop).tolist() for capacity in (None, 3, 2, 1)]
    assert due == [[0, 1, 4], [0, 1, 4], [0, 1], [1]]


class LeftAgent(DummyAgent):
    """Goes left."""

    def act(self, o_t, tau):
        action = np.zeros((2, 7), np.float32)
        action[:, 0] = -1
        return ActionSample(action, np.full(2, -3, np.float32), np.zeros(2, np.float32))

    def store(self, o_t, tau, a_t, r_t, o_tp1, cut_t, diverged_t):
        self.stored.append(a_t)


def test_the_expert_acts_in_its_streams_alone_and_the_agent_is_told():
    env = DummyEnv(2)
    env.x[:] = [0.4, -3.0]
    loop = TaskSet.of(env.scene, protocol()).new_loop(2)
    # Only stream 0 has failed at its first task, the goal 1.0.
    loop.failures[0, 0] = 2
    agent = LeftAgent(2, [])
    _, expert, events = run(2, env=env, agent=agent, loop=loop)
    assert expert.played == [[0]]
    first, _, third, _ = agent.stored
    assert first.expert.tolist() == [True, False]
    np.testing.assert_allclose(first.action[:, 0], [1.0, -1.0])
    assert first.log_prob.tolist() == [0, -3]
    assert third.expert is None
    assert third.action[:, 0].tolist() == [-1, -1]
    ends = [event for event in events if isinstance(event, SegmentEnd)]
    # From 0.4 it takes two steps of 0.2 to come within 0.3 of 1.
    assert ends[0].success.tolist() == [True, False]
    assert not ends[0].found_complete.any()
    assert loop.failures[:, 0].tolist() == [0, 0]
    assert loop.successes.sum() == 0


def test_actions_of_a_wrong_shape_are_refused():
    class Clumsy(Guide):
        def act(self, o_t, tau):
            return np.zeros((3, 7))

    loop = LoopState(2, 1)
    loop.switch_task(np.zeros(2, np.int64))
    loop.begin_takeover(np.array([1]), 1)
    agent = AssistedAgent(DummyAgent(2, []), Clumsy(None), loop)
    with pytest.raises(ValueError, match=r"Clumsy returned \(3, 7\), not \(1, 7\)"):
        agent.act({}, ["go to 1.0"] * 2)


@pytest.mark.parametrize(("mine", "expert"), [(slice(0, 1), [False]), (slice(1, 2), [True])])
def test_every_process_says_who_played_where_any_stream_is_taken_over(mine, expert):
    """A recording collects the field from all of them: one without it would leave the others waiting."""
    loop = LoopState(2, 1)
    loop.switch_task(np.zeros(2, np.int64))
    loop.begin_takeover(np.array([1]), 1)
    agent = AssistedAgent(DummyAgent(1, []), Idle(None), loop, mine)
    assert agent.act({}, ["go to 1.0"] * 2).expert.tolist() == expert


def test_the_state_survives_json_and_older_checkpoints_have_no_takeovers():
    loop, _, _ = run(10)
    state = json.loads(json.dumps(loop.state_dict()))
    assert LoopState.from_state_dict(state).state_dict() == loop.state_dict()
    for name in ("failures", "taken_over", "takeover_cost"):
        del state[name]
    state["interventions"] = [kinds[: Intervention.TAKEOVER] for kinds in state["interventions"]]
    old = LoopState.from_state_dict(state)
    assert old.b == 0
    assert old.interventions[:, Intervention.TASK_SWITCH].tolist() == [10, 10]
    assert old.interventions.shape == (2, 8)


@pytest.mark.parametrize("name", ["takeover_after", "takeover_budget", "takeover_price"])
def test_bad_settings_are_named(name):
    with pytest.raises(ValueError, match=f"protocol.{name} must be >= 1.*got 0"):
        protocol(**{name: 0})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"takeover_budget": 5}, "protocol.takeover_budget=5 is for takeovers, and there are none without"),
        ({"takeover_price": 3}, "protocol.takeover_price=3 is for takeovers"),
        ({"takeover_expert": "guide"}, "protocol.takeover_expert=guide is for takeovers"),
        (
            {"takeover_after": 1, "takeover_budget": 2, "takeover_price": 3},
            "takeover_budget=2 pays for no takeover at protocol.takeover_price=3",
        ),
    ],
)
def test_settings_that_nothing_reads_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        protocol(**options)
    protocol(takeover_after=1, takeover_budget=3, takeover_price=3)


def test_a_run_does_not_begin_with_a_budget_that_pays_for_no_takeover():
    """One that is resumed may have it."""
    with pytest.raises(ValueError, match=r"reset_budget=2 pays for no takeover at protocol\.takeover_price=3"):
        protocol(takeover_after=1, takeover_price=3, reset_budget=2).check_start()
    protocol(takeover_after=1, takeover_price=3, reset_budget=3).check_start()
    protocol(takeover_after=1, takeover_price=3).check_start()
    protocol(reset_budget=1).check_start()


def test_unknown_experts_and_taken_names_are_refused():
    with pytest.raises(ValueError, match=r"must be one of \['guide', 'scripted', 'single guide'\], got 'nobody'"):
        check_expert("nobody")
    with pytest.raises(ValueError, match="there is an expert 'guide' already"):
        register_expert("guide")(Guide)
