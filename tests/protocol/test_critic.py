"""The agent's values choose tasks and resets; resets at each stream's own time."""

import math

import numpy as np
import pytest
from dummies import DummyEnv
from test_rf_mtrl import DummyAgent, FastEnv, protocol

from cronos_lerobot.protocol.config import CriticConfig, ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import SegmentEnd
from cronos_lerobot.protocol.resets import SceneReset, make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.task_orders import CriticOrder, TaskSet, bind_task_order, make_task_order
from cronos_lerobot.protocol.task_values import RunContext, TaskValues
from cronos_lerobot.training.seeding import NamedGenerators

TASKS = DummyEnv(1).scene.tasks


class Opinionated(DummyAgent):
    """Values of the tasks (tasks,), or of each stream's (N, tasks)."""

    def __init__(self, num_streams, calls, values):
        super().__init__(num_streams, calls)
        self.values = np.broadcast_to(np.asarray(values, np.float32), (num_streams, len(TASKS)))

    def predict_values(self, o_t, tau):
        self.calls.append("values")
        indices = [[task.instruction for task in TASKS].index(text) for text in tau]
        return self.values[np.arange(self.num_streams), indices]


class Still(FastEnv):
    """Nothing moves; `complete` (N, tasks) says what lies complete, and so which segments succeed."""

    def __init__(self, num_envs, complete=None):
        super().__init__(num_envs)
        none = np.zeros((num_envs, len(TASKS)), bool)
        self.complete = none if complete is None else np.broadcast_to(np.array(complete, bool), none.shape)

    def observe_under(self, tasks):
        return [{} for _ in tasks]

    def find_complete(self, tasks):
        return self.complete[:, [TASKS.index(task) for task in tasks]].copy()

    def step(self, actions):
        observation, reward, terminated, truncated, info = super().step(actions)
        mine = [TASKS.index(task) if task in TASKS else 0 for task in self.tasks]
        success = self.complete[np.arange(self.num_envs), mine]
        return observation, reward, terminated, truncated, info | {"is_success": success}

    def scene_reset(self, ids, configurations, split="train"):
        self.calls.append(("scene_reset", list(ids)))


def run(config, steps, values, num_streams=2, env=None, seed=0, loop=None):
    env = env or Still(num_streams)
    task_set = TaskSet.of(env.scene, config)
    loop = loop or task_set.new_loop(num_streams)
    agent = Opinionated(num_streams, env.calls, values)
    rng = NamedGenerators(seed).for_numpy
    order = make_task_order(config.task_order, rng("task_order"), task_set)
    resets = make_resets(config, rng)
    context = RunContext(env, agent, task_set.tasks, config, steps)
    bind_task_order(order, context)
    resets.bind(context)
    return env, loop, list(rf_mtrl(env, task_set.all, agent, order, resets, config, loop, steps))


def tasks_given(events):
    return np.array([event.task for event in events if isinstance(event, SegmentEnd)])


# Which task -------------------------------------------------------------------------------------------------


def bound_order(values=(0, 0, 0, 0), env=None, **options):
    config = protocol(task_order="critic", critic=CriticConfig(**options))
    env = env or Still(1)
    order = make_task_order("critic", np.random.default_rng(0))
    assert isinstance(order, CriticOrder)
    order.bind(RunContext(env, Opinionated(env.num_envs, [], values), TASKS, config, 100))
    return order


def test_weights_prefer_what_is_neither_hopeless_nor_certain():
    order = bound_order()
    nothing = np.zeros((2, 4), bool)
    # p = 0, 0.5, 1 and 1: (0.02)^2, (0.25 + 0.02)^2 and the floor twice more; below 0 is 0.
    values = np.array([[0.0, 0.4, 0.8, 1.3], [-0.2, 0.2, 0.6, 0.4]])
    expected = [[0.0004, 0.0729, 0.0004, 0.0004], [0.0004, 0.2075**2, 0.2075**2, 0.0729]]
    np.testing.assert_allclose(order.weigh(values, nothing), expected)
    complete = np.array([[True, True, False, False], [True] * 4])
    # All complete is as good as none.
    expected[0][:2] = [0, 0]
    np.testing.assert_allclose(order.weigh(values, complete), expected)
    linear = bound_order(certain_value=1.6, floor=0.1, sharpness=1.0)
    np.testing.assert_allclose(linear.weigh(values, nothing)[0], [0.1, 0.2875, 0.35, 0.25234375])


def test_tasks_are_drawn_in_proportion_and_the_same_ones_again():
    config = protocol(task_order="critic", scene_reset_interval=None)
    given = [run(config, 8000, [0.0, 0.4, 0.8, 0.2], num_streams=8, seed=seed)[2] for seed in (0, 0, 1)]
    tasks = [tasks_given(events) for events in given]
    assert np.array_equal(tasks[0], tasks[1])
    assert not np.array_equal(tasks[0], tasks[2])
    weights = np.array([0.0004, 0.0729, 0.0004, 0.2075**2])
    shares = np.bincount(tasks[0].ravel(), minlength=4) / tasks[0].size
    # 4,000 draws: four standard errors of a half are 0.032.
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=0.032)


def test_one_forward_pass_for_each_task_and_switch_and_the_value_that_was_chosen():
    values = np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]], np.float32)
    env, loop, events = run(protocol(task_order="critic", scene_reset_interval=None), 24, values)
    assert env.calls.count("values") == 4 * 6
    last = tasks_given(events)[-1]
    assert loop.task_value.tolist() == values[[0, 1], last].tolist()


@pytest.mark.parametrize(("knows_complete", "allowed"), [(True, {3}), (False, {1, 2, 3})])
def test_what_is_complete_is_left_out_as_far_as_it_is_known(knows_complete, allowed):
    """Tasks 0, 1 and 2 lie complete; told no more than of the task just tried, only that one is left out."""
    env = Still(4, [True, True, True, False])
    order = bound_order([0.4] * 4, env, knows_complete=knows_complete)
    loop = TaskSet(TASKS).new_loop(4)
    loop.switch_task(np.zeros(4, np.int64))
    drawn = np.concatenate([order.draw(loop) for _ in range(50)])
    assert set(drawn.tolist()) == allowed


def test_before_the_first_task_nothing_has_been_tried():
    order = bound_order([0.4] * 4, Still(4, [True, False, False, False]), knows_complete=False)
    loop = TaskSet(TASKS).new_loop(4)
    assert 0 in np.concatenate([order.draw(loop) for _ in range(20)])


def test_learned_resets_follow_the_tasks_that_values_chose():
    config = protocol(task_order="critic", learned_reset=True, scene_reset_interval=None)
    env, _, events = run(config, 400, [0.0, 0.4, 0.0, 0.4], num_streams=4)
    tasks = tasks_given(events)
    assert set(tasks[0::2].ravel()) <= {0, 1, 2, 3}
    assert (tasks[1::2] == 4 + tasks[0::2] // 2).all()
    assert env.calls.count("values") == 4 * len(tasks[0::2])


def test_an_agent_without_values_is_refused():
    env = Still(2)
    context = RunContext(env, DummyAgent(2, []), TASKS, protocol(), 100)
    with pytest.raises(ValueError, match="task_order=critic goes by the agent's values, and DummyAgent has none"):
        bind_task_order(make_task_order("critic", np.random.default_rng(0)), context)
    config = protocol(scene_reset="critic", reset_budget=5)
    with pytest.raises(ValueError, match="scene_reset=critic goes by"):
        make_resets(config, NamedGenerators(0).for_numpy).bind(context)
    with pytest.raises(ValueError, match="works in cronos-train"):
        make_task_order("critic", np.random.default_rng(0)).draw(TaskSet(TASKS).new_loop(2))


def test_an_own_order_may_ask_for_the_run():
    class Told:
        def __init__(self, rng):
            pass

        def bind(self, run):
            self.values = TaskValues(run, "mine")

        def draw(self, loop):
            return self.values.ask().argmax(axis=1)

    env = Still(2)
    order = Told(None)
    bind_task_order(order, RunContext(env, Opinionated(2, [], [0, 3, 2, 1]), TASKS, protocol(), 100))
    assert order.draw(TaskSet(TASKS).new_loop(2)).tolist() == [1, 1]
    # One that does not want to know is left alone.
    bind_task_order(make_task_order("random", np.random.default_rng(0)), None)


# When -------------------------------------------------------------------------------------------------------


def scene_resets(env):
    """Streams that were reset at each call, the first placement left out."""
    return [call[1] for call in env.calls if call[0] == "scene_reset"][1:]


def test_staggered_resets_by_hand():
    """T is four segments of K = 2; five streams have the phases 0, 0, 1, 2 and 3."""
    config = protocol(scene_reset_interval=8, reset_phase="staggered")
    env, loop, events = run(config, 5 * 16, [0] * 4, num_streams=5)
    assert scene_resets(env) == [[4], [3], [2], [0, 1]] * 2
    ages = [event.segments_since_reset.tolist() for event in events if isinstance(event, SegmentEnd)]
    assert ages[4:] == [[0, 0, 1, 2, 3], [1, 1, 2, 3, 0], [2, 2, 3, 0, 1], [3, 3, 0, 1, 2]]
    assert loop.b == 10


@pytest.mark.parametrize("phase", ["together", "staggered"])
@pytest.mark.parametrize(("curriculum", "resets"), [([], 2), ([(48, 4)], 5)])
def test_both_phases_come_to_the_same_number_in_whole_periods(phase, curriculum, resets):
    """Six streams, 16 steps each: twice T = 8; or T = 4 twice in 8 steps (n <= 48), then T = 8 once: 2 + 1."""
    config = protocol(scene_reset_interval=8, reset_phase=phase, curriculum=curriculum)
    if curriculum:
        resets = 2 + 1
    _, loop, _ = run(config, 6 * 16, [0] * 4, num_streams=6)
    assert loop.interventions[:, Intervention.SCENE_RESET].tolist() == [resets] * 6


def test_staggered_curriculum_by_hand():
    """Four streams; T = 4 (two segments, phases 0, 0, 1, 1) up to n = 32, then T = 8 (phases 0, 1, 2, 3)."""
    config = protocol(scene_reset_interval=8, reset_phase="staggered", curriculum=[(32, 4)])
    env, _, _ = run(config, 4 * 16, [0] * 4, num_streams=4)
    assert scene_resets(env) == [[2, 3], [0, 1], [2, 3], [0, 1], [3], [2], [1], [0]]


def test_streams_that_are_reset_at_one_moment_go_on_with_all_tasks():
    """64 streams, T = 1280: four are reset at each task switch, and the heuristic order gives them four tasks."""
    config = ProtocolConfig(reset_phase="staggered")
    _, loop, events = run(config, 64 * 80 * 32, [0] * 4, num_streams=64)
    firsts = [event.task[event.segments_since_reset == 0] for event in events if isinstance(event, SegmentEnd)]
    assert all(sorted(first.tolist()) == [0, 1, 2, 3] for first in firsts[1:])
    assert len(firsts) == 32
    assert loop.b == 64 * 2


# Who --------------------------------------------------------------------------------------------------------


def critic_resets(steps, budget, values, num_streams=4, env=None, failures=2, **options):
    config = protocol(scene_reset="critic", reset_budget=budget, critic=CriticConfig(failures=failures), **options)
    return run(config, steps, values, num_streams, env)


def test_the_critics_resets_by_hand():
    """Four streams, segments of 8 interaction steps, 10 of them; the budget is 5: one more every 16 steps.

    Nobody may be reset before three failures. By then, n = 24, one reset may be spent: of the streams, whose best
    values are 0.5, 0.1, 0.3 and 0.2, stream 1 gets it. n = 32, two in all: stream 3. n = 48, three: stream 1 has
    failed three times more. n = 64, four: it has not again, so 3 does. At n = 80 the run is over, and a fifth
    would be of no use.
    """
    values = np.full((4, 4), -1.0)
    values[:, 2] = [0.5, 0.1, 0.3, 0.2]
    env, loop, events = critic_resets(80, 5, values, failures=3)
    assert scene_resets(env) == [[1], [3], [1], [3]]
    ages = [int(event.segments_since_reset[1]) for event in events if isinstance(event, SegmentEnd)]
    assert ages == [0, 1, 2, 0, 1, 2, 0, 1, 2, 3]
    assert loop.reset_value.tolist() == pytest.approx([0, 0.1, 0, 0.2])
    assert loop.b == 4
    assert loop.n == 80


def test_equal_values_send_the_reset_to_who_has_waited_longest():
    """As at the start, when a critic says 0 of all: the budget is one reset for two segments of 8 steps."""
    env, loop, _ = critic_resets(80, 5, np.zeros((4, 4)), failures=1)
    # After segments 2, 4, 6 and 8: whoever has gone longest without one, of equals the first.
    assert scene_resets(env) == [[0], [1], [2], [3]]
    assert loop.asked_resets.tolist() == [1, 1, 1, 1]


def test_streams_that_succeed_or_have_just_been_reset_are_left_alone():
    """Only streams 0 and 1 fail; a reset one has to fail three times again, however low its value."""
    env = Still(4)
    env.complete = np.array([[False] * 4, [False] * 4, [True] * 4, [True] * 4])
    values = np.array([[0.1] * 4, [0.5] * 4, [-9] * 4, [-9] * 4])
    env, loop, _ = critic_resets(8 * 13, 1000, values, env=env, failures=3)
    # After segments 3, 6, 9 and 12: the budget would be enough for all of them at every switch.
    assert scene_resets(env) == [[0, 1]] * 4
    assert loop.interventions[:, Intervention.SCENE_RESET].tolist() == [4, 4, 0, 0]


def test_unspent_budget_is_kept_for_later_and_never_exceeded():
    """All succeed in the first ten of twenty segments and none later; the budget is 10, one for two segments.

    Six may be spent after twelve segments, when all four streams have failed twice; seven after fourteen, so
    three of them are reset again; the fourth, which has waited longest, after sixteen, and one after eighteen. The
    last one is never spent.
    """

    class Breaks(Still):
        def step(self, actions):
            self.t += 1
            self.complete = np.full((4, 4), self.t <= 20)
            return super().step(actions)

    env, loop, events = critic_resets(160, 10, np.zeros(4), env=Breaks(4))
    assert scene_resets(env) == [[0, 1, 2, 3], [0, 1, 2], [3], [0]]
    ages = [event.segments_since_reset.tolist() for event in events if isinstance(event, SegmentEnd)]
    assert [number for number, age in enumerate(ages) if age[0] == 0] == [0, 12, 14, 18]
    assert loop.b == 9


def test_other_interventions_are_paid_from_the_same_budget():
    """HSR costs stream 0 one at every switch, which is all that may be spent by then; the run is not cut short."""

    class Clumsy(Still):
        def unsuitable_bodies(self):
            return np.array([[i == 0, False, False] for i in range(4)])

    env, loop, _ = critic_resets(80, 11, np.zeros(4), env=Clumsy(4), heuristic_reset=True)
    # After s of ten segments 1.1 s may be spent, s are by HSR: there is one for a reset after none of them but
    # the tenth, which ends the run.
    assert scene_resets(env) == []
    assert loop.b == 10
    env, loop, _ = critic_resets(80, 20, np.zeros(4), env=Clumsy(4), heuristic_reset=True)
    assert loop.interventions[:, Intervention.HEURISTIC_RESET].tolist() == [10, 0, 0, 0]
    assert 0 < loop.interventions[:, Intervention.SCENE_RESET].sum() <= 10
    assert loop.n == 80


def test_learned_reset_tasks_say_nothing_about_being_stuck():
    config = protocol(scene_reset="critic", reset_budget=1000, learned_reset=True, critic=CriticConfig(failures=2))

    class Tidy(Still):
        def step(self, actions):
            observation, reward, terminated, truncated, info = super().step(actions)
            info["is_success"] = np.array([task not in TASKS for task in self.tasks])
            return observation, reward, terminated, truncated, info

    _, _, events = run(config, 2 * 2 * 12, np.zeros(4), env=Tidy(2))
    ages = [int(event.segments_since_reset[0]) for event in events if isinstance(event, SegmentEnd)]
    # Task, reset task, task, reset task: two tasks have failed, all since the reset.
    assert ages == [0, 1, 2, 3] * 3


def test_nothing_is_reset_before_a_learned_reset_task():
    """One more reset for three segments of twelve: what falls due after the third and the ninth waits for one."""
    env, loop, events = critic_resets(48, 4, np.zeros(4), num_streams=2, failures=1, learned_reset=True)
    assert scene_resets(env) == [[0], [1], [0]]
    ends = [event for event in events if isinstance(event, SegmentEnd)]
    assert [int(end.segments_since_reset[0]) for end in ends] == [0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 0, 1]
    assert [int(end.segments_since_reset[1]) for end in ends] == [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4, 5]
    assert all(end.task[i] < len(TASKS) for end in ends for i in (0, 1) if end.segments_since_reset[i] == 0)
    assert loop.b == 3


def test_best_value_leaves_out_what_is_complete():
    env = Still(2, [[True, True, False, False], [True] * 4])
    loop = TaskSet(TASKS).new_loop(2)
    loop.switch_task(np.zeros(2, np.int64))
    values = [0.9, 0.8, -0.3, -0.2]
    for knows, expected in ((True, [0.0, 0.0]), (False, [0.8, 0.8])):
        config = protocol(task_order="critic", critic=CriticConfig(knows_complete=knows))
        asked = TaskValues(RunContext(env, Opinionated(2, [], values), TASKS, config, 100), "a test")
        assert asked.best(loop).tolist() == pytest.approx(expected)


def test_the_papers_budget_is_spent_in_the_whole_run():
    """1.3 M steps, all streams failing: one less than B at the last switch, or what 2 failures each allow."""
    config = ProtocolConfig(scene_reset="critic", reset_budget=1016)
    _, loop, _ = run(config, 1_300_480, np.zeros(4), num_streams=64)
    last_switch = 1_300_480 - 64 * 80
    assert loop.b == math.floor(1016 * last_switch / 1_300_480) == 1012
    assert loop.n == 1_300_480
    assert isinstance(make_resets(config, NamedGenerators(0).for_numpy).scene, SceneReset)
