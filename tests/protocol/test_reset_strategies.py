"""The reset strategies of Table 1: each combination's tape, what is counted, and users' own strategies."""

import numpy as np
import pytest
from dummies import BODIES, RESET_TASKS, TASKS, DummyEnv
from test_rf_mtrl import FastEnv, protocol, run

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import SegmentEnd, Step
from cronos_lerobot.protocol.resets import (
    EXTRA_RESETS,
    ResetStrategy,
    register_reset,
)
from cronos_lerobot.protocol.task_orders import TASK_ORDERS, register_task_order

BOTH = [0, 1]
SEGMENT = ["set_task", "observe", "act", "step", "store", "act", "step", "store"]
EER, SCENE = ("end_effector_reset", BOTH), ("scene_reset", BOTH)
PUT_BACK = ("put_back", 1, "ketchup bottle")

# K = 2, U = 4, two streams, six segments of 4 interaction steps; T stands for the paper's, in segments:
# T = 80 is 1 segment, 320 is 2 and 1280 is 4. The curriculum's first half is 12 of 24 steps.
EPISODIC, LONG, CURRICULUM = 2, 8, [(12, 4)]
TABLE_1 = {
    "T = 80": ({"scene_reset_interval": EPISODIC, "end_effector_reset": False}, [[SCENE]] * 6),
    "T = 1280": (
        {"scene_reset_interval": LONG, "end_effector_reset": False},
        [[], [], [], [SCENE], [], []],
    ),
    "+ EER": ({"scene_reset_interval": LONG}, [[EER], [EER], [EER], [EER, SCENE], [EER], [EER]]),
    "+ EER + CL": (
        {"scene_reset_interval": LONG, "curriculum": CURRICULUM},
        [[EER], [EER, SCENE], [EER], [EER, SCENE], [EER], [EER]],
    ),
    "+ EER + CL + LSR": (
        {"scene_reset_interval": LONG, "curriculum": CURRICULUM, "learned_reset": True},
        [[EER], [EER, SCENE], [EER], [EER, SCENE], [EER], [EER]],
    ),
    "+ EER + CL + HSR": (
        {"scene_reset_interval": LONG, "curriculum": CURRICULUM, "heuristic_reset": True},
        [[EER, PUT_BACK], [EER, SCENE], [EER], [EER, SCENE], [EER], [EER]],
    ),
    "+ EER + CL + LSR + HSR": (
        {
            "scene_reset_interval": LONG,
            "curriculum": CURRICULUM,
            "learned_reset": True,
            "heuristic_reset": True,
        },
        [[EER, PUT_BACK], [EER, SCENE], [EER], [EER, SCENE], [EER], [EER]],
    ),
}


@pytest.mark.parametrize("row", TABLE_1)
def test_tape_of_every_row_of_table_1(row):
    options, after_segment = TABLE_1[row]
    env = DummyEnv(2)
    env.lost = {(1, 1)}  # the bottle of stream 1 is out of the workspace from the start
    env, _, loop, _ = run(protocol(**options), steps=24, env=env)
    expected = [SCENE]  # the first placement
    for number, resets in enumerate(after_segment, start=1):
        expected += SEGMENT
        if number % 2 == 0:  # U = 2 K: before the resets of the switch
            expected.append("update")
        expected += resets
    assert env.calls == expected
    put_back = sum(PUT_BACK in resets for resets in after_segment)
    scene = 2 * sum(SCENE in resets for resets in after_segment)
    assert loop.interventions[:, Intervention.HEURISTIC_RESET].tolist() == [0, put_back]
    assert loop.interventions[:, Intervention.SCENE_RESET].sum() == scene
    assert loop.interventions[:, Intervention.END_EFFECTOR_RESET].sum() == 12 * (EER in after_segment[0])
    assert loop.b == put_back + scene


def test_a_heuristic_reset_comes_before_the_scene_reset_of_the_same_switch():
    class Clumsy(DummyEnv):
        def step(self, actions):
            if self.t == 3:  # the last step before the first scene reset
                self.lost.add((1, 1))
            return super().step(actions)

    config = protocol(scene_reset_interval=4, heuristic_reset=True)
    env, _, loop, _ = run(config, steps=16, env=Clumsy(2))
    at_switches = [call for call in env.calls if call in (EER, PUT_BACK, SCENE)]
    assert at_switches == [SCENE, EER, EER, PUT_BACK, SCENE, EER, EER, SCENE]
    assert loop.interventions[:, Intervention.HEURISTIC_RESET].tolist() == [0, 1]
    assert loop.b == 1 + 4


def test_learned_resets_follow_the_object_of_the_task():
    config = protocol(learned_reset=True, scene_reset_interval=None)
    _, _, loop, events = run(config, steps=6 * 4)
    ends = [event for event in events if isinstance(event, SegmentEnd)]
    # Stream 0: task 0 (a), a back, task 1 (a), a back, task 2 (b), b back. Stream 1 is one task ahead.
    assert [end.task.tolist() for end in ends] == [[0, 1], [4, 4], [1, 2], [4, 5], [2, 3], [5, 5]]
    seen = [event.instructions[0] for event in events if isinstance(event, Step)][::2]
    assert seen == [task.instruction for task in (TASKS[0], RESET_TASKS[0], TASKS[1], RESET_TASKS[0], TASKS[2],
                                                  RESET_TASKS[1])]  # fmt: skip
    assert loop.attempts.sum(axis=0).tolist() == [1, 2, 2, 1, 3, 3]
    assert loop.round == 3


def test_random_order_with_learned_resets_draws_tasks_only():
    config = protocol(learned_reset=True, task_order="random", scene_reset_interval=None)
    _, _, _, events = run(config, 4000, env=FastEnv(8), num_streams=8)
    tasks = np.array([event.task for event in events if isinstance(event, SegmentEnd)])
    assert set(tasks[0::2].ravel()) == {0, 1, 2, 3}
    assert set(tasks[1::2].ravel()) == {4, 5}
    assert (tasks[1::2] == 4 + tasks[0:-1:2] // 2).all()


def test_one_heuristic_reset_for_a_stream_however_many_bodies():
    env = DummyEnv(2)
    env.lost = {(0, 0), (0, 1), (0, 2)}
    env, _, loop, events = run(protocol(heuristic_reset=True, scene_reset_interval=None), steps=8, env=env)
    assert [call for call in env.calls if call[0] == "put_back"] == [("put_back", 0, body) for body in BODIES]
    assert loop.stream_interventions.tolist() == [1, 0]
    third = [event for event in events if isinstance(event, Step)][2]
    assert third.preceded_by.tolist() == [Intervention.HEURISTIC_RESET, Intervention.END_EFFECTOR_RESET]


def test_another_strategys_draws_leave_the_scene_resets_as_they_are():
    """Two runs at one seed; in one of them a body is lost, and a simulation breaks down."""
    drawn = {}
    for name, clumsy in (("calm", False), ("clumsy", True)):
        placed = drawn[name] = []

        class Watched(DummyEnv):
            def put_back(self, stream, body, rng):
                rng.uniform(size=5)
                super().put_back(stream, body, rng)

            def scene_reset(self, ids, configurations, split="train"):
                self.placed.append(np.asarray(configurations).tolist())
                super().scene_reset(ids, configurations, split)

        env = Watched(2, diverge_at={(2, 1)} if clumsy else None)
        env.placed = placed
        env.lost = {(1, 1)} if clumsy else set()
        _, _, loop, _ = run(protocol(heuristic_reset=True), 24, env=env)
        assert loop.interventions[:, Intervention.HEURISTIC_RESET].sum() == clumsy
    broken = [configurations for configurations in drawn["clumsy"] if len(configurations) == 1]
    assert len(broken) == 1
    assert [configurations for configurations in drawn["clumsy"] if len(configurations) == 2] == drawn["calm"]


def test_heuristic_resets_spend_the_budget():
    class Clumsy(DummyEnv):
        def step(self, actions):
            self.lost.add((0, 0))
            return super().step(actions)

    config = protocol(heuristic_reset=True, scene_reset_interval=None, reset_budget=3)
    _, _, loop, _ = run(config, 1000, env=Clumsy(2))
    assert loop.b == 3
    assert loop.t == 6


def test_scene_resets_draw_from_the_first_configurations_only():
    drawn = []

    class Watched(FastEnv):
        def scene_reset(self, ids, configurations, split="train"):
            drawn.extend(configurations)

    run(protocol(num_configurations=3, scene_reset_interval=2), 400, env=Watched(2))
    assert set(drawn) == {0, 1, 2}
    drawn.clear()
    run(protocol(num_configurations=1, scene_reset_interval=2), 40, env=Watched(2))
    assert set(drawn) == {0}


def test_papers_row_with_hsr_counts_scene_resets_like_the_curriculum():
    """1.3 M steps, nothing lost: 64 streams x (31 resets at T = 320 + 8 at T = 1280), about the paper's 2,000."""
    config = ProtocolConfig(80, curriculum=[(650_000, 320)], heuristic_reset=True, learned_reset=True)
    _, _, loop, _ = run(config, 1_300_000, num_streams=64, env=FastEnv(64))
    assert loop.b == 64 * (31 + 8) == 2496


def test_a_stream_that_was_put_back_after_a_divergence_gets_its_periodic_reset():
    """At T = 8; stream 1 diverges in the last step before it, and is put back there, which counts by itself."""
    config = protocol(scene_reset_interval=8, end_effector_reset=False)
    _, _, loop, _ = run(config, 24, env=DummyEnv(2, diverge_at={(7, 1)}))
    assert loop.interventions[:, Intervention.DIVERGENCE].tolist() == [0, 1]
    assert loop.interventions[:, Intervention.SCENE_RESET].tolist() == [1, 1]


def test_own_strategy_and_own_order_by_name():
    @register_reset("stuck")
    class ResetStuck(ResetStrategy):
        kind = Intervention.SCENE_RESET

        def __init__(self, rng, protocol):
            self.rng = rng

        def due(self, env, loop):
            return np.flatnonzero(
                (loop.recent_success[:, -2:] == 0).all(axis=1) & (loop.segments_since_reset >= 2)
            )

        def apply(self, env, ids):
            env.scene_reset(ids, self.rng.integers(64, size=len(ids)))

    @register_task_order("last")
    class Last:
        def __init__(self, rng):
            pass

        def draw(self, loop):
            return np.full(loop.num_streams, loop.num_tasks - 1)

    try:
        config = protocol(scene_reset_interval=None, extra_resets=["stuck"], task_order="last")
        env, _, loop, events = run(config, steps=16)
        assert [call for call in env.calls if call[0] == "scene_reset"] == [SCENE, SCENE, SCENE]
        assert loop.b == 4  # after segments 2 and 4 the last two since the reset had failed
        assert all((event.task == 3).all() for event in events if isinstance(event, SegmentEnd))
        with pytest.raises(ValueError, match="stuck"):
            register_reset("stuck")(ResetStuck)
        with pytest.raises(ValueError, match="last"):
            register_task_order("last")(Last)
    finally:
        del EXTRA_RESETS["stuck"], TASK_ORDERS["last"]
    for options, flag in (({"extra_resets": ["stuck"]}, "extra_resets"), ({"task_order": "last"}, "task_order")):
        with pytest.raises(ValueError, match=f"--protocol.{flag}"):
            run(protocol(**options), steps=8)


def test_a_stream_that_an_own_strategy_has_reset_is_not_reset_and_counted_again(monkeypatch):
    class First(ResetStrategy):
        kind = Intervention.SCENE_RESET

        def due(self, env, loop):
            return np.array([0])

        def apply(self, env, ids):
            env.scene_reset(ids, np.zeros(len(ids), np.int64))

    monkeypatch.setitem(EXTRA_RESETS, "first", lambda rng, config: First())
    # K = 2, two streams, T of two segments, six segments: the first stream is reset at every switch by its
    # strategy, the second at every second one by T.
    _, _, loop, _ = run(protocol(scene_reset_interval=4, extra_resets=["first"]), steps=24)
    assert loop.interventions[:, Intervention.SCENE_RESET].tolist() == [6, 3]


class Own(ResetStrategy):
    """Of a kind, due at streams, and never applied."""

    def __init__(self, kind=Intervention.SCENE_RESET, due=()):
        self.kind, self.streams = kind, due

    def due(self, env, loop):
        return self.streams

    def apply(self, env, ids):
        raise AssertionError(ids)


class OwnOrder:
    def __init__(self, drawn):
        self.drawn = drawn

    def draw(self, loop):
        return self.drawn


WRONG = [
    *(
        (EXTRA_RESETS, Own(kind=kind), "extra_resets=own")
        for kind in (None, Intervention.NONE, Intervention.INITIAL, Intervention.HELP)
    ),
    *(
        (EXTRA_RESETS, Own(due=due), r"Own\.due")
        for due in ([1, 0], [1, 1], [2], [-1], [0.0], [[0]], np.array([True, False]))
    ),
    *(
        (TASK_ORDERS, OwnOrder(drawn), "task_order")
        for drawn in ([0, -1], [0, 6], [0.0, 1.0], [True, False], [0], 0, None)
    ),
]


@pytest.mark.parametrize(("registry", "own", "named"), WRONG)
def test_what_an_own_strategy_or_order_cannot_mean_is_told(registry, own, named, monkeypatch):
    """What a strategy counts as, the streams at which it is due, and a task for every stream."""
    monkeypatch.setitem(registry, "own", lambda *_: own)
    flags = {"extra_resets": ["own"]} if registry is EXTRA_RESETS else {"task_order": "own", "learned_reset": True}
    with pytest.raises(ValueError, match=named):
        run(protocol(**flags), steps=8)
