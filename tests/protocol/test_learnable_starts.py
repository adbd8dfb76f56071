"""Scene resets that go where the policy neither always succeeds nor always fails."""

import numpy as np
import pytest
from dummies import DummyEnv
from test_critic import Opinionated
from test_critic import run as run_by_value
from test_rf_mtrl import FastEnv, protocol, run

from cronos_lerobot.protocol.config import CriticConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.learnable_starts import LearnableStarts
from cronos_lerobot.protocol.loop_state import SegmentEnd
from cronos_lerobot.protocol.resets import NoReset, make_resets
from cronos_lerobot.protocol.task_orders import CriticOrder, TaskSet
from cronos_lerobot.protocol.task_values import RunContext
from cronos_lerobot.training.seeding import NamedGenerators

TASKS = DummyEnv(1).scene.tasks


class Everyone(NoReset):
    """A scene reset of every stream at every task switch."""

    kind = Intervention.SCENE_RESET

    def due(self, env, loop):
        return np.arange(loop.num_streams)


class Placed(FastEnv):
    """Remembers where streams were put; `chance` (configurations, tasks) says how often a task succeeds there."""

    def __init__(self, num_envs, chance=None):
        super().__init__(num_envs)
        self.chance = np.ones((4, len(TASKS))) if chance is None else chance
        self.rng = np.random.default_rng(7)
        self.configuration = np.zeros(num_envs, int)
        self.started = []

    def scene_reset(self, ids, configurations, split="train"):
        self.configuration[ids] = configurations

    def set_task(self, streams, tasks):
        super().set_task(streams, tasks)
        self.started += [(int(c), TASKS.index(task)) for c, task in zip(self.configuration, tasks)]

    def step(self, actions):
        observation, reward, terminated, truncated, info = super().step(actions)
        tasks = [TASKS.index(task) for task in self.tasks]
        success = self.rng.random(self.num_envs) < self.chance[self.configuration, tasks]
        return observation, reward, terminated, truncated, info | {"is_success": success}


def starts(num_configurations=4):
    return LearnableStarts(Everyone(), np.random.default_rng(3), num_configurations)


def put(strategy, loop, *places):
    """Have the streams stand at these starts, (configuration, task) each, whatever was drawn."""
    strategy._awaited[:], loop.first_task[:] = zip(*places)


def reset(strategy, env, loop):
    """One task switch: what came of the last starts is noted, and new ones are drawn."""
    strategy.apply_if_due(env, loop)


def finish(loop, success, task=None):
    loop.switch_task(np.zeros(loop.num_streams) if task is None else task)
    loop.succeeded = np.array(success)
    return loop.end_segment()


def test_weights_by_hand():
    """After 3 successes and 1 failure, each at a start of its own, r = 4/6, and the prior is Beta(4/3, 2/3)."""
    strategy, env, loop = starts(), Placed(4), TaskSet(TASKS).new_loop(4)
    reset(strategy, env, loop)
    put(strategy, loop, (0, 0), (1, 1), (2, 2), (3, 3))
    finish(loop, [True, True, True, False])
    strategy.due(env, loop)
    # Of Beta(7/3, 2/3), Beta(4/3, 5/3) and Beta(4/3, 2/3) E[p (1 - p)] is a b / ((a + b) (a + b + 1)).
    expected = np.full((4, 4), (4 / 3 * 2 / 3) / (2 * 3))
    expected[[0, 1, 2], [0, 1, 2]] = (7 / 3 * 2 / 3) / (3 * 4)
    expected[3, 3] = (4 / 3 * 5 / 3) / (3 * 4)
    np.testing.assert_allclose(strategy.weigh(), expected**2)


def test_an_outcome_takes_a_fifth_of_what_earlier_ones_count_for():
    strategy, env, loop = starts(), Placed(1), TaskSet(TASKS).new_loop(1)
    for success in (True, False, False):
        reset(strategy, env, loop)
        put(strategy, loop, (2, 1))
        finish(loop, [success])
    strategy.due(env, loop)
    # Failures: (0 * .8 + 1) * .8 + 1; successes: 1 * .8 * .8.
    np.testing.assert_allclose(strategy._outcomes[2, 1], [1.8, 0.64])
    assert strategy._outcomes.sum() == pytest.approx(2.44)


def test_a_reset_says_which_task_comes_first_and_no_later_one():
    strategy, env, loop = starts(), Placed(8), TaskSet(TASKS).new_loop(8)
    reset(strategy, env, loop)
    wanted = loop.first_task.copy()
    np.testing.assert_array_equal(env.configuration, strategy._awaited)
    order = np.arange(8) % 4
    assert not np.array_equal(wanted, order)
    np.testing.assert_array_equal(finish(loop, [True] * 8, order).task, wanted)
    np.testing.assert_array_equal(finish(loop, [True] * 8, order).task, order)


def test_what_says_nothing_of_the_policy_at_the_start_is_left_out():
    """Of four streams one is taken over, one breaks down, one is not reset: one outcome is left."""
    strategy, env, loop = starts(), Placed(4), TaskSet(TASKS).new_loop(4)
    strategy.inner.due = lambda env, loop: np.array([0, 1, 3])
    reset(strategy, env, loop)
    strategy.inner.due = lambda env, loop: np.empty(0, int)
    loop.switch_task(np.zeros(4))
    loop.taken_over[0] = True
    loop.count_intervention(np.array([1]), Intervention.DIVERGENCE)
    loop.succeeded[:] = True
    loop.end_segment()
    strategy.due(env, loop)
    assert strategy._outcomes.sum() == 1
    # The second segment after a reset is nobody's outcome.
    finish(loop, [False] * 4)
    strategy.due(env, loop)
    assert strategy._outcomes.sum() == 1


def test_resets_go_where_success_is_a_matter_of_luck():
    """One start of sixteen succeeds half of the time, one never, the others always."""
    chance = np.ones((4, 4))
    chance[1, 2], chance[3, 0] = 0.3, 0.0  # a segment has two steps: 1 - .7 ** 2 = .51
    shares = {}
    for kind in ("random", "learnable"):
        config = protocol(scene_reset_interval=2, num_configurations=4, reset_starts=kind)
        env = Placed(4, chance)
        run(config, 8000, env=env, num_streams=4)
        shares[kind] = {start: env.started.count(start) / len(env.started) for start in set(env.started)}
    for start in ((1, 2), (3, 0), (0, 0)):
        assert shares["random"][start] == pytest.approx(1 / 16, abs=0.02)
    # What always succeeds ends at Beta(2 r + 5, 2 (1 - r)) with r = 14.5 / 16, about .024; what never does at .17,
    # what does every second time at .20: squared, the shares are .008 each of the fourteen, .36 and .53.
    assert shares["learnable"][1, 2] == pytest.approx(0.53, abs=0.1)
    assert shares["learnable"][3, 0] == pytest.approx(0.36, abs=0.1)
    assert len(shares["learnable"]) == 16


def test_they_change_neither_when_nor_how_many():
    ends = {}
    for kind in ("random", "learnable"):
        config = protocol(reset_starts=kind, scene_reset_interval=8, reset_phase="staggered")
        _, _, loop, events = run(config, 400, num_streams=4, env=Placed(4, np.ones((64, 4))))
        ends[kind] = [e.segments_since_reset.tolist() for e in events if isinstance(e, SegmentEnd)]
        assert loop.interventions[:, Intervention.SCENE_RESET].sum() == 12 + 12 + 13 + 13
    assert ends["random"] == ends["learnable"]


def test_they_draw_from_a_generator_of_their_own():
    generators = NamedGenerators(0)
    make_resets(protocol(), generators.for_numpy)
    assert "resets/starts" not in generators.state_dict()["numpy"]
    make_resets(protocol(reset_starts="learnable"), generators.for_numpy)
    assert "resets/starts" in generators.state_dict()["numpy"]


@pytest.mark.parametrize("now", [2, 8])
def test_a_resumed_run_may_draw_from_more_or_fewer_configurations(now):
    before, env, loop = starts(4), Placed(3), TaskSet(TASKS).new_loop(3)
    reset(before, env, loop)
    put(before, loop, (0, 1), (3, 2), (1, 0))
    finish(loop, [True, False, True])
    reset(before, env, loop)
    put(before, loop, (0, 1), (3, 2), (1, 0))
    after = starts(now)
    after.load_state_dict(before.state_dict())
    assert after.weigh().shape == (now, 4)
    assert after._outcomes.sum() == (2 if now == 2 else 3)
    finish(loop, [False, False, False])
    after.due(env, loop)
    assert after._outcomes[0, 1].tolist() == [1, 0.8]
    if now == 8:
        assert after._outcomes[3, 2].tolist() == [1.8, 0]
    drawn = set()
    for _ in range(60):
        reset(after, env, loop)
        drawn |= set(env.configuration.tolist())
    assert drawn == set(range(now))


def test_resets_that_the_critic_asks_for_go_there_too_and_are_counted_as_asked():
    config = protocol(
        scene_reset="critic", reset_budget=6, reset_starts="learnable", critic=CriticConfig(failures=1)
    )
    _, loop, _ = run_by_value(config, steps=200, values=[0.1, 0.2, 0.3, 0.4])
    assert loop.asked_resets.sum() == loop.interventions[:, Intervention.SCENE_RESET].sum() == 5
    # The sixth would come after the last segment. The heuristic order gives each stream its tasks in turn.
    told = loop.recent_task[0][loop.recent_task[0] >= 0]
    assert not np.array_equal(told, (np.arange(len(told)) + told[0]) % 4)


def test_the_critics_order_tells_the_value_of_the_task_that_is_given():
    loop = TaskSet(TASKS).new_loop(2)

    class Seen(FastEnv):
        def observe_under(self, tasks):
            return [{} for _ in tasks]

        def find_complete(self, tasks):
            return np.zeros((self.num_envs, len(tasks)), bool)

    env, order = Seen(2), CriticOrder(np.random.default_rng(0))
    config = protocol(task_order="critic", critic=CriticConfig())
    order.bind(RunContext(env, Opinionated(2, [], [0.1, 0.2, 0.3, 0.4]), TASKS, config, 100))
    loop.first_task[:] = [3, 2]
    loop.switch_task(order.draw(loop))
    np.testing.assert_array_equal(loop.task, [3, 2])
    np.testing.assert_allclose(loop.task_value, [0.4, 0.3], rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reset_starts": "hard"}, r"reset_starts must be one of \('random', 'learnable'\), got 'hard'"),
        ({"reset_starts": "learnable", "learned_reset": True}, "learned_reset=true it may be .*: choose one"),
        ({"reset_starts": "learnable", "scene_reset_interval": None}, "null there are none of them: leave one"),
        (
            {"reset_starts": "learnable", "scene_reset_interval": 2, "task_order": "random"},
            "=random would say nothing",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        protocol(**options)
