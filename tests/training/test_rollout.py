"""What is logged of the streams between two updates."""

import json

import numpy as np

from cronos_lerobot.protocol.loop_state import SegmentEnd
from cronos_lerobot.training.logging import _jsonable, _scalars
from cronos_lerobot.training.rollout import RolloutStatistics

TASKS = ["a", "b", "put a back"]


def end(task, since_reset, success, found, ungrasped):
    flags = [None if flag is None else np.array(flag, bool) for flag in (success, found, ungrasped)]
    return SegmentEnd(np.array(task), np.array(since_reset), *flags, np.zeros(len(task), bool))


def statistics():
    rollout = RolloutStatistics(TASKS, num_tasks=2)
    rollout.on_event(end([0, 1, 1], [0, 0, 10], [1, 1, 0], [0, 1, 0], [1, 0, 0]))
    # A learned reset's successes are no task's.
    rollout.on_event(end([2, 0, 1], [1, 1, 2], [1, 0, 1], [1, 0, 0], [0, 0, 0]))
    return rollout


def test_successes_found_complete_and_never_grasped_are_counted_apart():
    record = json.loads(json.dumps(_jsonable(statistics().pop())))
    assert (record["success"], record["segments"]) == (3 / 5, 5)
    assert (record["found_complete"], record["never_grasped"]) == ([1, 5], [1, 5])
    assert list(record["success_by_segment"]) == ["0", "1", "2", "10"]
    assert record["success_by_segment"] == {"0": [2, 2], "1": [0, 1], "2": [1, 1], "10": [0, 1]}
    assert record["found_complete_by_segment"] == {"0": [1, 2], "1": [0, 1], "2": [0, 1], "10": [0, 1]}
    assert record["never_grasped_by_segment"] == {"0": [1, 2], "1": [0, 1], "2": [0, 1], "10": [0, 1]}
    assert record["success_by_task"] == {"a": [1, 2], "b": [2, 3], "put a back": [1, 1]}


def test_what_was_grasped_may_be_unknown():
    rollout = RolloutStatistics(TASKS)
    rollout.on_event(end([0, 1], [0, 0], [1, 1], [0, 1], None))
    record = rollout.pop()
    assert record["found_complete"] == (1, 2)
    assert not [name for name in record if name.startswith("never_grasped")]


def test_counts_are_rates_on_tensorboard_whatever_they_are_called():
    scalars = _scalars({"rollout": statistics().pop(), "interventions_by_stream": [3, 4], "unknown": None})
    assert scalars["rollout/never_grasped"] == 1 / 5
    assert scalars["rollout/success_by_segment/0"] == 1.0
    assert "interventions_by_stream" not in scalars


def test_statistics_go_on_from_a_checkpoint():
    first, second = statistics(), RolloutStatistics(TASKS, num_tasks=2)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert first.pop() == second.pop()
    assert second.pop()["segments"] == 0
