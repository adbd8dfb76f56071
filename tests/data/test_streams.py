import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import synthetic_streams
from forked_commands import run_forked
from lerobot.datasets import LeRobotDataset, StreamingLeRobotDataset
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from synthetic_segments import FPS, features, observation_space, segment
from synthetic_streams import ORIGIN, PICTURES, STEPS, STREAMS, TASKS, UPDATE, K, record

from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.stream_check import StreamError
from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.stream_statistics import make_tables, statistics
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.protocol.interventions import Intervention
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
    assert [s.intervention.name for s in first] == kinds
    assert [s.policy_version for s in first] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert [s.success_frame for s in first] == [None, 2] * 4
    assert [s.found_complete for s in streams.segments_of(2)] == [True, False] * 4


def test_a_stream_is_whole(streams):
    columns = streams.stream_columns(2, ["cronos.step", "action", "observation.state", "next.truncated"])
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
    with pytest.raises(ValueError, match=r"no pixels 'left'; it has \['observation.images.front'\]"):
        streams.pixels(segment, "left")
    with pytest.raises(ValueError, match=r"no columns \['nothing'\]"):
        streams.columns(segment, ["nothing"])


def test_transitions_across_a_switch(streams):
    switches = list(streams.switches(0))
    assert [s.after.step for s in switches] == [4, 8, 12, 16, 20, 24, 28]
    assert switches[3].intervention == Intervention.SCENE_RESET
    assert len(list(streams.switches())) == 7 * STREAMS
    last, first = streams.switch_frames(switches[3])
    assert (last["cronos.step"], first["cronos.step"]) == (15, 16)
    assert (last["action"][0], first["action"][0]) == (7.5, 8)
    assert np.abs(first[FRONT].astype(int) - PICTURES[16 % 7]).mean() < 2.5
    assert np.abs(last[FRONT].astype(int) - PICTURES[15 % 7]).mean() < 2.5


def test_episodes_between_scene_resets(streams):
    episodes = list(streams.reset_free_episodes())
    assert [(e[0].stream, e[0].step, len(e)) for e in episodes] == [(i, t, 4) for i in range(3) for t in (0, 16)]
    assert list(streams.reset_free_episodes(1)) == episodes[2:4]


def test_what_was_filtered_out_ends_an_episode_and_joins_nothing(streams, tmp_path):
    """Stream 1 succeeds in its odd segments; the first ones after a scene reset are 0 and 4."""
    wanted = SegmentFilter(success=True, streams=[1])
    filter_streams(streams, wanted, "me/some", tmp_path / "d")
    some = StreamDataset("me/some", tmp_path / "d")
    episodes = [[segment.index for segment in episode] for episode in some.reset_free_episodes()]
    assert episodes == [[1, 3], [5, 7]]
    assert list(some.switches()) == []


def test_statistics(streams):
    result = statistics(streams)
    assert (result["streams"], result["segments"], result["frames"]) == (3, 24, 96)
    # Segment k of stream i succeeds if i + k is even: in stream 2, from the start.
    assert result["success"] == [12, 4, 24]
    assert result["success_by_position"] == {0: [4, 2, 6], 1: [2, 0, 6], 2: [4, 2, 6], 3: [2, 0, 6]}
    assert result["success_by_task"] == {TASKS[1]: [0, 0, 12], TASKS[0]: [12, 4, 12]}
    assert result["success_by_policy_version"] == {v: [3, 1, 6] for v in range(STEPS // UPDATE)}
    assert result["success_by_stream"] == {0: [4, 0, 8], 1: [4, 0, 8], 2: [4, 4, 8]}
    assert result["began_after"] == {"end_effector_reset": 18, "scene_reset": 3, "initial": 3}
    # Tenths of 32 steps, rounded up, are 4 steps: one segment of each stream.
    assert result["began_after_over_time"][0] == {"initial": 3}
    assert result["began_after_over_time"][16] == {"scene_reset": 3}
    assert len(make_tables(result)) == 4


def test_streamed_has_no_loaded_view(root):
    streams = StreamDataset("me/stream", root, streaming=True)
    with pytest.raises(ValueError, match="streaming=False"):
        _ = streams.dataset
    assert StreamDataset("me/stream", root).dataset[5]["index"] == 5
    with pytest.raises(ValueError, match=r"stream 7 is not in me/stream; it has \[0, 1, 2\]"):
        streams.segments_of(7)


def test_lerobot_streams_the_numbers_of_a_recording_in_order(tmp_path):
    """LeRobot's own streaming takes `index / fps` for the time inside a video file: right for one file only."""
    record(tmp_path / "d", steps=K)
    dataset = StreamingLeRobotDataset("me/stream", tmp_path / "d", shuffle=False, buffer_size=1, max_num_shards=1)
    dataset.meta.info.features.pop(FRONT)  # its decoder needs torchcodec
    found = [(int(item["cronos.stream_id"]), int(item["cronos.step"]), item["task"]) for item in dataset]
    assert found == [(i, t, TASKS[i % 2]) for i in range(STREAMS) for t in range(K)]


@pytest.mark.parametrize(
    ("skip", "message"),
    [
        ([(1, 3)], "stream 1: step 12 to 15 is missing"),
        ([(0, 0)], "stream 0: step 0 to 3 is missing"),
        ([(0, k) for k in range(8)], r"the streams \[0\] are missing; recorded are the first ones up to 2"),
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
    with pytest.raises(StreamError, match=r"^stream 2 ends after 8 steps, stream 0 after 32: the recording"):
        streams.check()
    streams.check(is_finished=False)


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("cronos.step", 13, 0, "stream 0, step 0: it does not follow the frame before it in episode 3"),
        ("cronos.intervention", 1, 2, "stream 0, step 1: intervention 2 on frame 1"),
        ("cronos.intervention", 48, 0, "stream 0, step 16: intervention 0 on frame 0"),
        ("cronos.intervention", 12, 6, "stream 0, step 4: intervention 6"),
        ("cronos.segment_index", 5, 9, "stream 1, step 1: segment 9 begins inside episode 1"),
        ("cronos.stream_interventions", 48, 0, "stream 0, step 16: cronos.stream_interventions is 0, not what"),
        ("intervention", 13, True, "stream 0, step 5: intervention is True"),
        ("next.done", 9, True, "stream 2, step 1: next.done is True, a stream never ends"),
        ("next.truncated", 10, True, "stream 2, step 2: next.truncated is True"),
        ("next.truncated", 11, False, "stream 2, step 3: next.truncated is False"),
        ("cronos.position", 48, 4, "stream 0, step 16: cronos.position is 4"),
        ("cronos.position", 12, 0, "stream 0, step 4: cronos.position is 0"),
        ("index", 7, 8, "stream 1, step 3: its index is not its row, 8"),
    ],
)
def test_wrong_annotations_are_named(tmp_path, column, row, value, message):
    record(tmp_path / "d")
    (path,) = (tmp_path / "d").glob("data/*/*.parquet")
    table = pq.read_table(path)
    values = table[column].to_pylist()
    values[row] = value
    place, field = table.schema.get_field_index(column), table.schema.field(column)
    pq.write_table(table.set_column(place, field, pa.array(values, field.type)), path)
    with pytest.raises(StreamError, match=message):
        StreamDataset("me/stream", tmp_path / "d", streaming=True).check()


def test_a_takeover_that_was_not_counted_is_named(tmp_path):
    record(tmp_path / "d")
    (path,) = (tmp_path / "d").glob("data/*/*.parquet")
    table = pq.read_table(path)
    # All of the second segment of stream 0, episode 3.
    values = pa.array([12 <= row < 16 for row in range(len(table))])
    pq.write_table(table.set_column(table.schema.get_field_index("intervention"), "intervention", values), path)
    with pytest.raises(StreamError, match=r"stream 0, step 4: cronos.stream_interventions is 0, not what"):
        StreamDataset("me/stream", tmp_path / "d", streaming=True).check()


def test_streams_from_before_there_were_takeovers_are_whole(tmp_path, monkeypatch):
    columns = synthetic_streams.stream_features

    def without(space):
        return {name: feature for name, feature in columns(space).items() if name != "intervention"}

    monkeypatch.setattr(synthetic_streams, "stream_features", without)
    record(tmp_path / "d")
    old = StreamDataset("me/stream", tmp_path / "d")
    assert "intervention" not in old.meta.features
    old.check()
    assert not any(segment.taken_over for segment in old.segments)
    assert statistics(old)["takeovers"] == [0, 0, 0]


def test_a_segment_that_is_there_twice_is_named(root, tmp_path):
    """As if a resumed run had recorded a segment again without dropping the first."""
    shutil.copytree(root, tmp_path / "d")
    with SegmentWriter.resume("me/stream", tmp_path / "d") as writer:
        streams = StreamDataset("me/stream", root)
        again = streams.segments_of(2)[5]
        frames = {key: streams.columns(again, [key])[key] for key in writer.features if key != FRONT}
        scalars = {
            key: array.reshape(K) for key, array in frames.items() if array.shape[-1] == 1 or array.ndim == 1
        }
        pixels = {FRONT: streams.pixels(again, FRONT)}
        metadata = {"cronos.stream_id": 2, "cronos.segment_index": 5, "cronos.step": 20, "cronos.intervention": 2}
        metadata |= {
            "cronos.position": 1,
            "cronos.policy_version": 2,
            "next.success": False,
            "cronos.success_frame": -1,
        }
        writer.add_segment(frames | scalars | pixels, again.task, episode_metadata=metadata)
    with pytest.raises(StreamError, match="stream 2, step 20: it is there twice"):
        StreamDataset("me/stream", tmp_path / "d", streaming=True).check()


def test_recordings_of_two_runs_that_were_merged_have_no_order(root, tmp_path):
    runs = [LeRobotDataset("me/stream", root=root) for _ in range(2)]
    merge_datasets(runs, output_repo_id="me/both", output_dir=tmp_path / "d")
    streams = StreamDataset("me/both", tmp_path / "d")
    assert len(streams.segments) == 2 * len(StreamDataset("me/stream", root).segments)
    for read in (streams.switches, streams.reset_free_episodes, lambda: streams.stream_columns(2, ["action"])):
        with pytest.raises(ValueError, match=r"me/both has steps of a stream twice, .* read them one by one"):
            list(read())


def test_survives_lerobots_own_tools(root, tmp_path):
    """They drop our columns from the episodes' rows; the frames still tell."""
    kept = delete_episodes(LeRobotDataset("me/stream", root=root), [0, 1], tmp_path / "d", "me/edited")
    assert "cronos.step" not in kept.meta.episodes.column_names
    streams = StreamDataset("me/edited", tmp_path / "d")
    original = StreamDataset("me/stream", root)
    for mine, theirs in zip(streams.segments_of(2), original.segments_of(2), strict=True):
        assert (mine.step, mine.task, mine.intervention) == (theirs.step, theirs.task, theirs.intervention)
        assert (mine.success_frame, mine.policy_version) == (theirs.success_frame, theirs.policy_version)
    with pytest.raises(StreamError, match="stream 0: step 0 to 3 is missing"):
        streams.check()


def test_other_datasets_are_refused(tmp_path):
    with SegmentWriter("me/demos", tmp_path / "d", features(), FPS) as writer:
        writer.add_segment(segment(5), "task")
    with pytest.raises(ValueError, match="me/demos has no recorded streams: it lacks the columns"):
        StreamDataset("me/demos", tmp_path / "d", streaming=True)


@pytest.mark.parametrize("command", ["check", "statistics"])
def test_a_damaged_list_of_segments_is_said_in_one_line(root, tmp_path, monkeypatch, command):
    """Of the second flush: LeRobot reads all of these files as one dataset."""
    damaged = shutil.copytree(root, tmp_path / "d") / "meta/episodes/chunk-000/file-001.parquet"
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    flags = ["--dataset.repo_id=me/stream", f"--dataset.root={tmp_path / 'd'}"]
    monkeypatch.setattr(sys, "argv", ["cronos-streams", command, *flags])
    with pytest.raises(SystemExit, match=r"^error: meta/episodes/chunk-000/file-001.parquet is damaged: .*arquet"):
        main()


def test_streams_of_a_scene_of_ones_own_are_checked(root, tmp_path):
    """Its module is imported before anything of the recording is looked up."""
    shutil.copytree(root, tmp_path / "d")
    for there in (tmp_path / "d/meta").glob("*.json"):
        there.write_text(there.read_text().replace("kitchen_2x2", "kitchen_of_ones_own"))
    (tmp_path / "own_module.py").write_text(
        "from dataclasses import replace\n"
        "from lerobot_env_cronos import get_scene, register_scene\n"
        "register_scene(replace(get_scene('kitchen_2x2'), name='kitchen_of_ones_own'))\n"
    )
    command = ["cronos-streams", "check", "--dataset.repo_id=me/stream", f"--dataset.root={tmp_path / 'd'}"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = run_forked([*command, "--dataset.discover_packages_path=own_module"], env=environment)
    assert (done.returncode, done.stdout[:6]) == (0, "whole:"), done.stderr
    assert "unknown scene 'kitchen_of_ones_own'" in run_forked(command, env=environment).stderr


@pytest.mark.parametrize("command", ["check", "statistics"])
def test_a_recording_without_a_segment_is_said_in_one_line(tmp_path, monkeypatch, command):
    features = stream_features(observation_space(environment_state=None))
    writer = SegmentWriter("me/stream", tmp_path / "d", features, FPS, origin=ORIGIN)
    flags = ["--dataset.repo_id=me/stream", f"--dataset.root={tmp_path / 'd'}"]
    monkeypatch.setattr(sys, "argv", ["cronos-streams", command, *flags])
    with pytest.raises(SystemExit, match=rf"^error: me/stream in {tmp_path / 'd'} has no episode yet$"):
        main()
    writer.finalize()
