"""What is remembered of streams, and that batches of it are those of a LeRobotDataset of the same frames."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from tiny_datasets import write_dataset

from cronos_lerobot.agents.imitation.batches import Demonstrations, join_batches, segment_batch
from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.agents.imitation.memory import OpenSegments, Segment, SegmentMemory

TAPE = {
    # One character for each step: S the task is complete after it, D the simulation diverged in it.
    "first success and one more": ("..SS..", [0, 1, 2, 3]),
    "success at the end": (".....S", [0, 1, 2, 3, 4, 5]),
    "found complete": ("SS....", []),
    "none": ("......", []),
    "success after a divergence": (".D..S.", [2, 3, 4, 5]),
    "success before a divergence": (".S.D..", []),
    "divergence at the end": ("..S..D", []),
}


def test_the_memory_keeps_successes_up_to_a_step_after_the_first():
    streams = len(TAPE)
    segments = OpenSegments(streams)
    for _ in range(2):  # The second segment knows nothing of the first one.
        for step in range(6):
            marks = np.array([tape[step] for tape, _ in TAPE.values()])
            state = np.array([[10 * stream + step] for stream in range(streams)], np.float32)
            segments.add(
                {"observation.state": state},
                [f"task {stream}" for stream in range(streams)],
                -state,
                np.full(streams, step, np.float32),
                marks == "D",
            )
            state[:] = -1  # The environment may write into its own arrays.
            segments.note(marks == "S")
        found = [tape[0] == "S" for tape, _ in TAPE.values()]
        kept = segments.close(np.array(found), tail_steps=1)
    assert [segment.instruction for segment in kept] == ["task 0", "task 1", "task 4"]
    for segment, stream in zip(kept, (0, 1, 4), strict=True):
        steps = list(TAPE.values())[stream][1]
        assert segment.columns["observation.state"].tolist() == [[10 * stream + step] for step in steps]
        assert segment.columns["action"].tolist() == [[-10 * stream - step] for step in steps]
        assert segment.columns["next.reward"].tolist() == steps


def test_only_the_last_steps_before_a_success_are_kept():
    marks = ["....S.", "S.....", ".S...."]
    segments = OpenSegments(3)
    for step in range(6):
        state = np.full((3, 1), step, np.float32)
        segments.add({"observation.state": state}, ["go"] * 3, state, state[:, 0], np.zeros(3, bool))
        segments.note(np.array([mark[step] == "S" for mark in marks]))
    kept = segments.close(np.array([False, True, False]), tail_steps=1, lead_steps=3)
    assert [s.columns["observation.state"][:, 0].tolist() for s in kept] == [[2, 3, 4, 5], [0, 1, 2]]


def test_failed_segments_are_kept_whole_where_they_are_asked_for():
    segments = OpenSegments(len(TAPE))
    for step in range(6):
        marks = np.array([tape[step] for tape, _ in TAPE.values()])
        state = np.full((len(TAPE), 1), step, np.float32)
        segments.add({"observation.state": state}, ["go"] * len(TAPE), state, state[:, 0], marks == "D")
        segments.note(marks == "S")
    found = np.array([tape[0] == "S" for tape, _ in TAPE.values()])
    kept = segments.close(found, tail_steps=1, with_failed=True)
    # Of a divergence what follows is left; after one in the last step there is nothing.
    expected = {True: [[0, 1, 2, 3], [0, 1, 2, 3, 4, 5], [2, 3, 4, 5]], False: [[0, 1, 2, 3, 4, 5], [4, 5]]}
    for success, steps in expected.items():
        own = [s.columns["observation.state"][:, 0].tolist() for s in kept if s.success == success]
        assert own == steps


def make_segment(length, number):
    column = np.full((length, 2), number, np.float32)  # 8 bytes a frame
    return Segment(f"task {number}", {"action": column})


def test_the_newest_stay_and_frames_are_drawn_uniformly():
    memory = SegmentMemory(max_bytes=8 * 10, drop_last=1)
    for number, length in enumerate((5, 1, 4, 3)):
        memory.add(make_segment(length, number))
    # 5 + 4 + 3 frames are two too many; of the segment of one frame none could be drawn.
    assert [segment.instruction for segment in memory.segments] == ["task 2", "task 3"]
    assert memory.num_frames == 3 + 2
    drawn = [(s.instruction, frame) for s, frame in memory.draw(5000, np.random.default_rng(0))]
    frames = [("task 2", 0), ("task 2", 1), ("task 2", 2), ("task 3", 0), ("task 3", 1)]
    assert set(drawn) == set(frames)
    assert [drawn.count(frame) for frame in frames] == pytest.approx([1000] * 5, abs=120)
    other = SegmentMemory(max_bytes=8 * 10, drop_last=1)
    other.load_state_dict(memory.state_dict())
    other.add(make_segment(4, 4))
    assert [segment.instruction for segment in other.segments] == ["task 3", "task 4"]


LENGTHS = (5, 3)
DELTAS = {
    "act": {"observation": None, "action": [0, 1, 2, 3], "reward": None},
    "diffusion": {"observation": [-1, 0], "action": [-1, 0, 1, 2, 3], "reward": None},
    "tdmpc": {"observation": [0, 1, 2], "action": [0, 1], "reward": [0, 1]},
    "one step": {"observation": None, "action": None, "reward": None},
}


def policy_config(name):
    deltas = {f"{column}_delta_indices": indices for column, indices in DELTAS[name].items()}
    inputs = {"observation.state": None, "observation.images.front": None}
    return SimpleNamespace(**deltas, input_features=inputs)


@pytest.fixture(scope="module")
def episodes():
    rng = np.random.default_rng(0)
    return [
        Segment(
            f"task {number}",
            {
                "observation.state": rng.normal(size=(length, 4)).astype(np.float32),
                "observation.images.front": rng.integers(0, 256, (length, 8, 6, 3), dtype=np.uint8),
                "action": rng.normal(size=(length, 7)).astype(np.float32),
                "next.reward": rng.normal(size=length).astype(np.float32),
            },
        )
        for number, length in enumerate(LENGTHS)
    ]


@pytest.fixture(scope="module")
def dataset_root(episodes, tmp_path_factory):
    tasks = [(episode.instruction, episode.columns) for episode in episodes]
    return write_dataset(tmp_path_factory.mktemp("demos") / "dataset", tasks)


@pytest.mark.parametrize("name", DELTAS)
def test_a_batch_is_that_of_a_dataset_of_the_same_frames(name, episodes, dataset_root):
    config = policy_config(name)
    dataset = LeRobotDataset("me/demos", root=dataset_root)
    deltas = resolve_delta_timestamps(config, dataset.meta)
    dataset = LeRobotDataset("me/demos", root=dataset_root, delta_timestamps=deltas)
    draws = [(episode, i) for episode in episodes for i in range(len(episode))]
    batch = segment_batch(draws, config)
    expected = [dataset[i] for i in range(len(draws))]
    assert batch["task"] == [item["task"] for item in expected]
    own = {key for key in expected[0] if key.startswith(("observation", "action"))}
    own |= {key for key in expected[0] if key.startswith("next.reward") and config.reward_delta_indices}
    assert batch.keys() == own | {"task"}
    for key in own:
        theirs = torch.stack([item[key] for item in expected])
        assert batch[key].dtype == theirs.dtype, key
        assert torch.equal(batch[key], theirs), key
    # Both joined are a batch of the policy's columns.
    demos = Demonstrations(DemosConfig("me/demos", dataset_root), config).batch(2, np.random.default_rng(0))
    joined = join_batches(batch, demos)
    assert joined.keys() == batch.keys()
    assert {len(column) for column in joined.values()} == {len(draws) + 2}


@pytest.mark.parametrize("drop_last", [0, 2])
@pytest.mark.parametrize("name", DELTAS)
def test_vectors_are_drawn_from_memory_as_a_dataset_gives_them(name, drop_last, dataset_root, monkeypatch):
    """The same draws, once by LeRobotDataset and PyTorch's collation, once from the columns in memory."""
    config = policy_config(name)
    config.drop_n_last_frames = drop_last
    options = DemosConfig("me/demos", dataset_root)
    theirs = Demonstrations(options, config).batch(20, np.random.default_rng(7))
    del config.input_features["observation.images.front"]
    demos = Demonstrations(options, config)
    monkeypatch.delattr(LeRobotDataset, "__getitem__")
    own = demos.batch(20, np.random.default_rng(7))
    assert own.pop("task") == theirs["task"]
    assert {"observation.state", "action"} <= own.keys()
    assert ("next.reward" in own) == (name == "tdmpc")
    assert len({tuple(row.flatten().tolist()) for row in own["action"]}) > 2
    for key, column in own.items():
        assert column.dtype == theirs[key].dtype, key
        assert torch.equal(column, theirs[key]), key


def test_a_dataset_of_another_shape_is_refused(dataset_root):
    """As where the demonstrations were not told their task, and the policy is."""
    config = policy_config("act")
    config.input_features["observation.state"] = PolicyFeature(FeatureType.STATE, (9,))
    # Images are scaled.
    config.input_features["observation.images.front"] = PolicyFeature(FeatureType.VISUAL, (3, 64, 64))
    message = r"observation\.state of shape \(4,\), the policy takes \(9,\): .*--env\.task_observation"
    with pytest.raises(ValueError, match=message):
        Demonstrations(DemosConfig("me/demos", dataset_root), config)
    config.input_features["observation.state"] = PolicyFeature(FeatureType.STATE, (4,))
    Demonstrations(DemosConfig("me/demos", dataset_root), config)
