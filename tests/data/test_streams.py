import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from datasets import load_dataset
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.utils.feature_utils import dataset_to_policy_features
from synthetic_segments import FPS, features, observation_space, segment, world
from synthetic_streams import ORIGIN, PICTURES, STEPS, STREAMS, TASKS, UPDATE, K, record

from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.stream_check import StreamError
from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.stream_statistics import make_tables, statistics
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.scripts.streams import main

FRONT = "observation.images.front"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "streams"
    record(folder, flush_at=(9, 20))
    return folder


@pytest.fixture(scope="module", params=[False, True], ids=["loaded", "streamed"])
def streams(root, request) -> StreamDataset:
    return StreamDataset("me/stream", root, streaming=request.param)


def test_segments_come_in_the_order_of_their_stream(streams):
    found = [(s.stream, s.index, s.step, s.length, s.task) for s in streams.segments]
    expected = [(i, k, k * K, K, TASKS[(i + k) % 2]) for i in range(STREAMS) for k in range(8)]
    assert found == expected
    assert streams.streams == [0, 1, 2]
    first = streams.segments_of(1)
    assert [s.position for s in first] == [0, 1, 2, 3, 0, 1, 2, 3]
    kinds = ["INITIAL", *["END_EFFECTOR_RESET"] * 3, "SCENE_RESET", *["END_EFFECTOR_RESET"] * 3]
    assert [s.event.name for s in first] == kinds
    assert [s.policy_version for s in first] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert [s.success_frame for s in first] == [None, 2] * 4
    assert [s.found_complete for s in streams.segments_of(2)] == [True, False] * 4


def test_a_stream_is_whole(streams):
    names = ["cronos.step", "action", "observation.state", "next.truncated"]
    parts = [streams.columns(segment, names) for segment in streams.segments_of(2)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in names}
    t = np.arange(STEPS)
    np.testing.assert_array_equal(columns["cronos.step"], t)
    np.testing.assert_array_equal(columns["action"], np.repeat((2000 + t)[:, None] / 2, 7, axis=1))
    np.testing.assert_array_equal(columns["observation.state"][:, 4], 2000 + t)
    np.testing.assert_array_equal(columns["next.truncated"], t % K == K - 1)
    streams.check()


def test_pixels_of_a_segment(streams):
    segment = streams.segments_of(1)[6]
    pictures = streams.pixels(segment, FRONT).astype(int)
    assert np.abs(pictures - PICTURES[(1 + segment.step + np.arange(K)) % 7]).mean() < 2.5
    np.testing.assert_array_equal(streams.pixels(segment, FRONT, slice(1, 3)), pictures[1:3])
    with pytest.raises(ValueError, match="left"):
        streams.pixels(segment, "left")
    with pytest.raises(ValueError, match="nothing"):
        streams.columns(segment, ["nothing"])


def test_statistics(streams):
    result = statistics(streams)
    assert (result["streams"], result["segments"], result["frames"]) == (3, 24, 96)
    # Segment k of stream i succeeds if i + k is even: in stream 2, from the start.
    assert result["success"] == [12, 4, 24]
    assert result["helped"] == [0, 0, 0]
    assert result["success_by_position"] == {0: [4, 2, 6], 1: [2, 0, 6], 2: [4, 2, 6], 3: [2, 0, 6]}
    assert result["success_by_task"] == {TASKS[1]: [0, 0, 12], TASKS[0]: [12, 4, 12]}
    assert result["success_by_policy_version"] == {v: [3, 1, 6] for v in range(STEPS // UPDATE)}
    assert result["success_by_stream"] == {0: [4, 0, 8], 1: [4, 0, 8], 2: [4, 4, 8]}
    assert result["began_after"] == {"end_effector_reset": 18, "scene_reset": 3, "initial": 3}
    # Tenths of 32 steps, rounded up, are 4 steps: one segment of each stream.
    assert result["began_after_over_time"][0] == {"initial": 3}
    assert result["began_after_over_time"][16] == {"scene_reset": 3}
    assert len(make_tables(result)) == 4


def test_datasets_loads_a_recorded_folder(root):
    """Without the README's `configs` it takes the files of meta/ for data, and fails."""
    rows = load_dataset(str(root), split="train")
    assert len(rows) == 96
    assert rows[5]["cronos.step"] == 1


@pytest.mark.parametrize(
    ("skip", "message"),
    [
        ([(1, 3)], "stream 1: steps 12 to 15"),
        ([(0, 0)], "stream 0: steps 0 to 3"),
        ([(0, k) for k in range(8)], "stream 0 is missing"),
    ],
)
def test_what_is_missing_is_named(tmp_path, skip, message):
    record(tmp_path / "d", skip=skip)
    with pytest.raises(StreamError, match=message):
        StreamDataset("me/stream", tmp_path / "d", streaming=True).check()


def test_a_recording_that_broke_off_is_not_whole(tmp_path):
    """Killed after a flush that had two segments of stream 2 and all eight of the others."""
    record(tmp_path / "d", skip=[(2, k) for k in range(2, 8)])
    streams = StreamDataset("me/stream", tmp_path / "d", streaming=True)
    with pytest.raises(StreamError, match=r"^stream 2 ends after 8 steps, stream 0 after 32"):
        streams.check()
    streams.check(is_finished=False)


@pytest.mark.parametrize(
    ("column", "row", "value", "place"),
    [
        ("cronos.step", 13, 0, "stream 0, step 0"),
        ("cronos.event", 1, 2, "stream 0, step 1"),
        ("cronos.event", 48, 0, "stream 0, step 16"),
        ("cronos.event", 0, 4, "stream 0, step 0"),
        ("cronos.segment_index", 5, 9, "stream 1, step 1"),
        ("cronos.stream_interventions", 48, 0, "stream 0, step 17"),
        ("cronos.stream_interventions", 13, 1, "stream 0, step 5"),
        ("next.done", 9, True, "stream 2, step 1"),
        ("next.truncated", 10, True, "stream 2, step 2"),
        ("next.truncated", 11, False, "stream 2, step 3"),
        ("cronos.segments_since_reset", 48, 4, "stream 0, step 17"),
        ("cronos.segments_since_reset", 12, 0, "stream 0, step 5"),
        ("index", 7, 8, "stream 1, step 3"),
    ],
)
def test_wrong_annotations_are_named(tmp_path, column, row, value, place):
    record(tmp_path / "d")
    change(tmp_path / "d", column, {row: value})
    with pytest.raises(StreamError, match=rf"^{place}: {column} "):
        StreamDataset("me/stream", tmp_path / "d", streaming=True).check()


def change(root: Path, column: str, changed: dict[int, object]) -> None:
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    values = [changed.get(row, value) for row, value in enumerate(table[column].to_pylist())]
    place, field = table.schema.get_field_index(column), table.schema.field(column)
    pq.write_table(table.set_column(place, field, pa.array(values, field.type)), path)


def test_help_counts_where_it_begins_and_only_there(tmp_path):
    """Of stream 0, the last two frames of its second segment, and the first one of its third."""
    record(tmp_path / "d")
    rows = [14, 15, 24]
    change(tmp_path / "d", "intervention", dict.fromkeys(rows, True))
    streams = StreamDataset("me/stream", tmp_path / "d", streaming=True)
    with pytest.raises(StreamError, match=r"^stream 0, step 6: cronos.stream_interventions"):
        streams.check()
    (path,) = (tmp_path / "d").glob("data/*/*.parquet")
    frames = pq.read_table(path).to_pandas()
    for name in ("cronos.stream_interventions", "cronos.total_interventions"):
        after = (frames["cronos.step"] >= 6) & ((frames["cronos.stream_id"] == 0) | ("total" in name))
        counts = frames[name] + after
        change(tmp_path / "d", name, dict(enumerate(counts.tolist())))
    streams.check()


def test_survives_lerobots_own_tools(root, tmp_path):
    """They drop our columns from the episodes' rows, and leave nulls in what is merged; the frames still tell."""
    original = StreamDataset("me/stream", root)
    kept = delete_episodes(LeRobotDataset("me/stream", root=root), [0, 1], tmp_path / "d", "me/edited")
    whole = LeRobotDataset("me/stream", root=root)
    merge_datasets([whole, kept], output_repo_id="me/both", output_dir=tmp_path / "both")
    edited, both = StreamDataset("me/edited", tmp_path / "d"), StreamDataset("me/both", tmp_path / "both")
    assert edited.segments_of(2) != original.segments_of(2), "other episodes"
    told = [
        [(s.step, s.task, s.event, s.position, s.success_frame, s.policy_version) for s in found.segments_of(2)]
        for found in (original, edited, both)
    ]
    assert told[0] == told[1] == told[2][::2] == told[2][1::2]
    assert statistics(both)["success"] == [23, 8, 46]
    assert filter_streams(both, SegmentFilter(success=True), "me/won", tmp_path / "won") == 23
    with pytest.raises(StreamError, match="stream 0: steps 0 to 3"):
        edited.check()


def test_other_datasets_are_refused(tmp_path):
    with SegmentWriter("me/demos", tmp_path / "d", features(), FPS) as writer:
        writer.add_segment(segment(5), "task")
    with pytest.raises(ValueError, match="me/demos has no recorded streams"):
        StreamDataset("me/demos", tmp_path / "d", streaming=True)


@pytest.mark.parametrize("command", ["check", "statistics"])
def test_errors_are_one_line(root, tmp_path, monkeypatch, command):
    damaged = shutil.copytree(root, tmp_path / "d") / "meta/episodes/chunk-000/file-001.parquet"
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    writer = SegmentWriter(
        "me/stream", tmp_path / "e", stream_features(world(observation_space(None))), FPS, origin=ORIGIN
    )
    for name, line in (("d", "file-001.parquet is damaged"), ("e", "no episode yet")):
        flags = ["--dataset.repo_id=me/stream", f"--dataset.root={tmp_path / name}"]
        monkeypatch.setattr(sys, "argv", ["cronos-streams", command, *flags])
        with pytest.raises(SystemExit, match=rf"^error: [^\n]*{line}"):
            main()
    writer.finalize()


def test_annotations_are_no_policy_features():
    policy_features = dataset_to_policy_features(stream_features(world()))
    assert {key: feature.type for key, feature in policy_features.items()} == {
        "observation.images.front": FeatureType.VISUAL,
        "observation.state": FeatureType.STATE,
        "observation.environment_state": FeatureType.ENV,
        "action": FeatureType.ACTION,
    }
    assert policy_features["observation.images.front"].shape == (3, 64, 64)
