"""The tape of Algorithm 1: who is asked what, in which order, and what is counted."""

import numpy as np
import pytest
from dummies import TASKS, DummyEnv

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import LoopState, SegmentEnd, Step, Update
from cronos_lerobot.protocol.resets import make_resets
from cronos_lerobot.protocol.rf_mtrl import rf_mtrl
from cronos_lerobot.protocol.task_orders import TaskSet, make_task_order
from cronos_lerobot.training.seeding import NamedGenerators


class DummyAgent:
    def __init__(self, num_streams, calls):
        self.num_streams, self.calls, self.stored, self.samples = num_streams, calls, [], []

    def act(self, o_t, tau):
        self.calls.append("act")
        zeros = np.zeros((self.num_streams, 7), np.float32)
        return ActionSample(zeros, zeros[:, 0], zeros[:, 0])

    def store(self, o_t, tau, a_t, r_t, o_tp1, cut_t, diverged_t):
        self.calls.append("store")
        self.stored.append((o_t, list(tau), o_tp1, cut_t.copy()))
        self.samples.append(a_t)

    def update(self):
        self.calls.append("update")
        return {}


class FastEnv(DummyEnv):
    """Nothing moves; for counting over whole runs."""

    def step(self, actions):
        never = np.zeros(self.num_envs, bool)
        return (
            {},
            never.astype(np.float32),
            never,
            never,
            {"is_success": never, "diverged": never},
        )

    def observe(self):
        return {}


def run(protocol, steps, num_streams=2, env=None, loop=None, seed=0):
    env = env or DummyEnv(num_streams)
    task_set = TaskSet.of(env, protocol)
    loop = loop or task_set.new_loop(num_streams)
    agent = DummyAgent(num_streams, env.calls)
    rng = NamedGenerators(seed).for_numpy
    order = make_task_order(protocol.task_order, rng("task_order"), task_set)
    events = list(rf_mtrl(env, task_set.all, agent, order, make_resets(protocol, rng), protocol, loop, steps))
    return env, agent, loop, events


def protocol(**options):
    defaults = {"task_switch_interval": 2, "update_interval": 4, "scene_reset_interval": 4}
    return ProtocolConfig(**(defaults | options))


def test_tape_of_two_segments():
    env, *_ = run(protocol(), steps=8)
    both = [0, 1]
    step = ["act", "step", "store"]
    assert env.calls == [
        ("scene_reset", both),  # the first placement
        "set_task",
        "observe",
        *step,
        *step,
        ("end_effector_reset", both),  # t = 2: a task switch
        "set_task",
        "observe",
        *step,
        *step,
        "update",  # t = 4: update, then resets
        ("end_effector_reset", both),
        ("scene_reset", both),
    ]


def test_diverged_stream_is_reset_at_once_and_alone():
    env, agent, loop, _ = run(protocol(end_effector_reset=False), 8, env=DummyEnv(2, {(0, 1)}))
    after_first_store = env.calls.index("store") + 1
    assert env.calls[after_first_store : after_first_store + 3] == [("scene_reset", [1]), "observe", "act"]
    assert agent.stored[0][3].tolist() == [False, True]
    assert loop.interventions[:, Intervention.DIVERGENCE].tolist() == [0, 1]
    assert loop.piece.tolist() == [2, 3]
    assert loop.b == 3


def test_a_stream_that_diverges_in_its_last_step_begins_the_next_segment_in_a_fresh_scene():
    env, _, loop, events = run(protocol(end_effector_reset=False), 8, env=DummyEnv(2, {(1, 1)}))
    second_store = [i for i, call in enumerate(env.calls) if call == "store"][1]
    tape = env.calls[second_store + 1 : second_store + 5]
    assert tape == [("scene_reset", [1]), "set_task", "observe", "act"]
    assert [end.segments_since_reset.tolist() for end in events if isinstance(end, SegmentEnd)] == [[0, 0], [1, 0]]
    assert loop.interventions[:, Intervention.DIVERGENCE].tolist() == [0, 1]
    assert [int(event.preceded_by[1]) for event in events if isinstance(event, Step)][2] == Intervention.DIVERGENCE


def test_events_and_what_preceded_each_frame():
    _, _, _, events = run(protocol(), steps=16)
    kinds = [type(event) for event in events]
    assert kinds == [Step, Step, SegmentEnd, Step, Step, Update, SegmentEnd] * 2
    steps = [event for event in events if isinstance(event, Step)]
    assert [int(step.preceded_by[0]) for step in steps] == [
        Intervention.INITIAL,
        Intervention.NONE,
        Intervention.END_EFFECTOR_RESET,
        Intervention.NONE,
        Intervention.SCENE_RESET,
        Intervention.NONE,
        Intervention.END_EFFECTOR_RESET,
        Intervention.NONE,
    ]
    assert [step.policy_version for step in steps] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert [int(step.piece[0]) for step in steps] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert [int(step.interventions[0]) for step in steps] == [0, 0, 0, 0, 1, 1, 1, 1]
    assert [event.segments_since_reset.tolist() for event in events if isinstance(event, SegmentEnd)] == [
        [0, 0],
        [1, 1],
    ] * 2


def test_last_transition_of_a_segment_is_seen_under_the_old_task_before_the_reset():
    env = DummyEnv(1)
    env.x[:] = 0
    _, agent, _, _ = run(protocol(), steps=8, num_streams=1, env=env)
    o_t, tau, o_tp1, cut = agent.stored[3]
    assert cut.all()
    assert tau == [TASKS[1].instruction]
    # The actions are zero, so the stream stands still until the scene reset that follows at t = 4.
    np.testing.assert_array_equal(o_t["agent_pos"], o_tp1["agent_pos"])
    assert not np.array_equal(agent.stored[4][0]["agent_pos"], o_tp1["agent_pos"])


def test_heuristic_order_offsets_the_streams():
    _, _, _, events = run(protocol(), steps=6 * 4, num_streams=3)
    steps = [event for event in events if isinstance(event, Step)][::2]
    cycle = [task.instruction for task in TASKS]
    assert [step.instructions for step in steps] == [[cycle[(i + k) % 4] for i in range(3)] for k in range(4)]


def test_random_order_is_uniform_and_seeded():
    def tasks(seed):
        _, _, _, events = run(protocol(task_order="random"), 4000, env=FastEnv(8), num_streams=8, seed=seed)
        return np.array([event.task for event in events if isinstance(event, SegmentEnd)])

    first = tasks(0)
    counts = np.bincount(first.ravel(), minlength=4)
    assert (np.abs(counts / counts.sum() - 0.25) < 0.04).all()
    assert np.array_equal(first, tasks(0))
    assert not np.array_equal(first, tasks(1))


@pytest.mark.parametrize(("interval", "expected"), [(80, 16_250), (320, 4_062), (1280, 1_015)])
def test_interventions_of_the_papers_run(interval, expected):
    """1.3 M interaction steps of 64 streams; the paper counts steps / T, up to one whole reset per stream."""
    config = ProtocolConfig(80, scene_reset_interval=interval)
    _, _, loop, _ = run(config, 1_300_000, num_streams=64, env=FastEnv(64))
    assert 1_300_000 <= loop.n <= 1_300_000 + 64 * 80
    assert loop.b % 64 == 0
    assert abs(loop.b - expected) < 64
    assert loop.interventions[:, Intervention.END_EFFECTOR_RESET].sum() == loop.n / 80


def test_curriculum_spends_its_resets_early():
    """T = 320 up to 0.65 M steps (10,156 of each stream: 31 resets), then T = 1280 (8 resets)."""
    config = ProtocolConfig(80, scene_reset_interval=1280, curriculum=[(650_000, 320)])
    _, _, loop, _ = run(config, 1_300_000, num_streams=64, env=FastEnv(64))
    early = 650_000 // 64 // 320
    late = sum(1 for t in range(80, loop.t + 1, 80) if t * 64 > 650_000 and t % 1280 == 0)
    assert (early, late) == (31, 8)
    assert loop.b == 64 * (early + late)


@pytest.mark.parametrize(
    ("interval", "curriculum", "resets"),
    [
        (4, [(16, None)], [12, 16, 20]),  # two streams: n = 16 is t = 8
        (None, [(16, 4)], [4, 8]),
        (4, [(8, 4), (24, None)], [4, 16, 20]),
    ],
)
def test_a_curriculum_may_reset_never_for_a_while(interval, curriculum, resets):
    config = protocol(scene_reset_interval=interval, curriculum=curriculum)
    _, _, loop, events = run(config, 40)
    begins = [e.t for e in events if isinstance(e, Step) and (e.preceded_by == Intervention.SCENE_RESET).all()]
    # The one after the last segment has no step that follows.
    assert begins + [20] * (20 in resets) == resets
    assert loop.interventions[:, Intervention.SCENE_RESET].tolist() == [len(resets)] * 2


def test_budget_stops_the_run():
    _, _, loop, _ = run(protocol(reset_budget=3), steps=1000)
    assert loop.b == 4  # two streams are reset together
    assert loop.t == 8


def test_without_periodic_resets_no_intervention_is_counted():
    _, _, loop, _ = run(protocol(scene_reset_interval=None), steps=80)
    assert loop.b == 0
    assert loop.interventions_by_kind()["initial"] == 2


def test_successes_are_told_apart_by_what_was_done_for_them():
    """Streams: grasped and put down; complete from the start; complete without a grasp; grasped in vain."""
    success = np.array([[0, 1, 0, 0], [0, 1, 1, 0], [1, 1, 1, 0]], bool)
    grasped = np.array([[1, 0, 0, 1], [1, 0, 0, 1], [0, 0, 0, 0]], bool)

    class Scripted(DummyEnv):
        def step(self, actions):
            observation, reward, terminated, truncated, info = super().step(actions)
            now = (self.t - 1) % 3
            info = info | {"is_success": success[now], "is_grasped": grasped[now]}
            return observation, reward, terminated, truncated, info

    config = protocol(task_switch_interval=3, update_interval=3, scene_reset_interval=3)
    _, _, _, events = run(config, 24, env=Scripted(4), num_streams=4)
    for end in (event for event in events if isinstance(event, SegmentEnd)):
        assert end.success.tolist() == [True, True, True, False]
        assert end.found_complete.tolist() == [False, True, False, False]
        assert end.never_grasped.tolist() == [False, False, True, False]


def test_what_was_grasped_is_unknown_where_the_environment_does_not_say_it():
    ends = [event for event in run(protocol(), steps=16)[-1] if isinstance(event, SegmentEnd)]
    assert [end.never_grasped for end in ends] == [None] * 4


def test_history_is_of_segments_by_stream_and_task():
    env = DummyEnv(2)
    config = protocol(scene_reset_interval=None)
    loop = LoopState(2, len(TASKS))
    env.x[:] = [1.0, 0.0]
    env.scene_reset = lambda ids, configurations: None
    run(config, 16, env=env, loop=loop)
    assert loop.attempts.tolist() == [[1, 1, 1, 1], [1, 1, 1, 1]]
    assert loop.successes.tolist() == [[1, 0, 0, 0], [0, 0, 0, 0]]
    assert loop.recent_task[:, -5:].tolist() == [[-1, 0, 1, 2, 3], [-1, 1, 2, 3, 0]]
    assert loop.recent_success[:, -5:].tolist() == [[-1, 1, 0, 0, 0], [-1, 0, 0, 0, 0]]


def test_loop_state_survives_json():
    import json

    _, _, loop, _ = run(protocol(), steps=24)
    copy = LoopState.from_state_dict(json.loads(json.dumps(loop.state_dict())))
    assert copy.state_dict() == loop.state_dict()
    assert copy.preceded_by.dtype == loop.preceded_by.dtype


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("task_switch_interval", 0),
        ("update_interval", 3),
        ("scene_reset_interval", 5),
        ("curriculum", [(100, 3)]),
        ("curriculum", [(100, 4), (50, 8)]),
        ("curriculum", [(None, 4)]),
        ("reset_budget", 0),
        ("reset_phase", "late"),
        ("reward", "dense"),
        ("num_configurations", 0),
    ],
)
def test_bad_protocols_are_named(flag, value):
    with pytest.raises(ValueError, match=f"--protocol.{flag}"):
        protocol(**{flag: value})


def test_a_divergence_in_a_segment_is_not_its_first_step():
    """What is complete after one was not found so, unless the segment's own first step found it."""
    loop, never = LoopState(2, 1), np.zeros(2, bool)

    def step(*complete, diverged=(False, False)):
        info = {"is_success": np.array(complete), "is_grasped": never, "diverged": np.array(diverged)}
        loop.count_step(info, never)

    loop.switch_task(np.zeros(2, np.int64))
    step(True, False, diverged=(False, True))
    loop.count_intervention(np.array([0, 1]), Intervention.DIVERGENCE)
    step(False, True)
    end = loop.end_segment()
    assert end.success.tolist() == [True, True]
    assert end.found_complete.tolist() == [True, False]
    # One in a segment's last step is followed by the next one's first.
    step(False, False, diverged=(False, True))
    loop.count_intervention(np.array([1]), Intervention.DIVERGENCE)
    loop.switch_task(np.zeros(2, np.int64))
    step(False, True)
    assert loop.end_segment().found_complete.tolist() == [False, True]


class Helped(DummyEnv):
    """A person holds stream 1 in steps 1 to 4 (K = 2: through a task switch) and 6; actions are clipped."""

    def step(self, actions):
        helped = np.array([False, self.t in (1, 2, 3, 4, 6)])
        executed = np.where(helped[:, None], np.float32(0.5), actions.clip(-0.25, 0.25))
        observation, reward, terminated, truncated, info = super().step(executed)
        info |= {"executed_action": executed, "intervened": helped}
        return observation, reward, terminated, truncated, info


def test_help_is_marked_frame_by_frame_and_counted_where_it_begins():
    _, agent, loop, events = run(protocol(scene_reset_interval=None), 16, env=Helped(2))
    steps = [event for event in events if isinstance(event, Step)]
    assert [step.intervened.tolist()[1] for step in steps] == [False, True, True, True, True, False, True, False]
    assert not any(step.intervened[0] for step in steps)
    assert [step.action.action[1, 0] for step in steps] == [0, 0.5, 0.5, 0.5, 0.5, 0, 0.5, 0]
    assert [sample.action[1, 0] for sample in agent.samples] == [0, 0.5, 0.5, 0.5, 0.5, 0, 0.5, 0]
    # Two beginnings, counted from the frame on that they are.
    assert [step.interventions.tolist() for step in steps] == [[0, n] for n in (0, 1, 1, 1, 1, 1, 2, 2)]
    assert loop.interventions[:, Intervention.HELP].tolist() == [0, 2]
    assert loop.b == 2
    # All four segments of stream 1 had help: they say nothing of the policy.
    assert [event.helped.tolist() for event in events if isinstance(event, SegmentEnd)] == [[False, True]] * 4
    assert loop.attempts.sum(axis=1).tolist() == [4, 0]


def test_help_spends_the_budget():
    _, _, loop, _ = run(protocol(scene_reset_interval=None, reset_budget=1), 1000, env=Helped(2))
    assert (loop.b, loop.t) == (1, 2)


def test_an_environment_that_does_not_say_what_it_executed_did_what_was_asked():
    _, agent, _, events = run(protocol(), 8)
    steps = [event for event in events if isinstance(event, Step)]
    assert all(not step.intervened.any() for step in steps)
    assert all(sample.intervened is None for sample in agent.samples)
