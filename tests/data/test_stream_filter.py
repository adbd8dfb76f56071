import json
import sys

import av
import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from synthetic_streams import TASKS, K, record

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.stats import image_stats, vector_stats
from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.video import Clip, CopiedVideoFile, read_frames
from cronos_lerobot.scripts import streams as script

FRONT = "observation.images.front"


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> StreamDataset:
    folder = tmp_path_factory.mktemp("recorded") / "streams"
    record(folder, flush_at=(9, 20))
    return StreamDataset("me/stream", folder, streaming=True)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, {(i, k) for i in range(3) for k in range(8)}),
        ({"success": True}, {(i, k) for i in range(3) for k in range(8) if (i + k) % 2 == 0}),
        ({"success": False, "streams": [0]}, {(0, 1), (0, 3), (0, 5), (0, 7)}),
        (
            {"success": True, "found_complete": False},
            {(0, 0), (0, 2), (0, 4), (0, 6), (1, 1), (1, 3), (1, 5), (1, 7)},
        ),
        ({"found_complete": True}, {(2, 0), (2, 2), (2, 4), (2, 6)}),
        ({"helped": True}, set()),
        ({"events": ["scene_reset", "initial"]}, {(i, k) for i in range(3) for k in (0, 4)}),
        ({"min_policy_version": 2, "max_policy_version": 2}, {(i, k) for i in range(3) for k in (4, 5)}),
        ({"min_position": 2, "max_position": 2, "streams": [1]}, {(1, 2), (1, 6)}),
        ({"tasks": [TASKS[0]], "max_policy_version": 0}, {(0, 0), (1, 1), (2, 0)}),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else f"{len(value)} kept",
)
def test_what_is_kept(source, options, expected):
    wanted = SegmentFilter(**options)
    assert {(s.stream, s.index) for s in source.segments if wanted(s)} == expected


def test_success_as_reward_is_of_what_a_frame_shows(source, tmp_path):
    """`next.success` comes one frame later: it is of the moment after the action."""
    wanted, root = SegmentFilter(tasks=[TASKS[0]]), tmp_path / "d"
    filter_streams(source, wanted, "me/judge", root, success_as_reward=True, frames_after_success=1)
    dataset = LeRobotDataset("me/judge", root=root).hf_dataset
    rewards = np.split(np.array(dataset["next.reward"]), np.flatnonzero(np.array(dataset["frame_index"]) == 0)[1:])
    # Streams 0 and 1 succeed from their third frame on, stream 2 from its first.
    assert sorted(map(tuple, rewards)) == sorted([(0, 0, 0, 1)] * 8 + [(1, 1)] * 4)
    stats = json.loads((root / "meta/stats.json").read_text())["next.reward"]
    assert stats["mean"] == pytest.approx([np.concatenate(rewards).mean()])
    with pytest.raises(ValueError, match="--success_as_reward=true needs --schema=demonstrations"):
        filter_streams(source, wanted, "me/two", tmp_path / "two", success_as_reward=True, schema="streams")


def test_a_filtered_dataset_is_an_ordinary_one_with_the_columns_of_demonstrations(source, tmp_path):
    wanted = SegmentFilter(success=True, found_complete=False)
    assert filter_streams(source, wanted, "me/successes", tmp_path / "d") == 8
    dataset = LeRobotDataset("me/successes", root=tmp_path / "d", delta_timestamps={"action": [0, 0.2, 0.4, 0.6]})
    assert not any(name.startswith("cronos.") or name == "intervention" for name in dataset.meta.features)
    assert check_dataset(tmp_path / "d").kind == "segments"
    kept = sorted((s for s in source.segments if wanted(s)), key=lambda s: s.episode)
    assert (dataset.num_episodes, len(dataset)) == (8, 8 * K)
    assert list(dataset.meta.tasks.index) == [TASKS[0]]
    original = LeRobotDataset("me/stream", root=source.meta.root)
    for episode, segment in enumerate(kept):
        for t in range(K):
            mine, theirs = dataset[episode * K + t], original[segment.start + t]
            assert (mine["episode_index"], mine["frame_index"], mine["index"]) == (episode, t, episode * K + t)
            assert mine["task"] == segment.task
            # Copied, not encoded again: the same pixels bit for bit.
            for key in (FRONT, "observation.state", "next.reward", "next.truncated", "timestamp"):
                np.testing.assert_array_equal(mine[key], theirs[key], err_msg=key)
    item = dataset[1]
    assert item["action_is_pad"].tolist() == [False, False, False, True]
    first = 1000 * kept[0].stream + kept[0].step
    assert item["action"][:, 0].tolist() == [(first + t) / 2 for t in (1, 2, 3, 3)]
    stats = vector_stats(np.concatenate([source.columns(s, ["action"])["action"] for s in kept]))
    for name in stats:
        np.testing.assert_allclose(dataset.meta.stats["action"][name], stats[name], err_msg=name)
    assert not list((tmp_path / "d").rglob(".incomplete"))


def test_cut_after_the_success_with_all_columns_of_a_stream(source, tmp_path):
    wanted = SegmentFilter(streams=[0, 1], max_policy_version=0)
    options = {"schema": "streams", "frames_after_success": 0}
    assert filter_streams(source, wanted, "me/cut", tmp_path / "d", **options) == 4
    cut = StreamDataset("me/cut", tmp_path / "d")
    # Segments 0 and 1 of streams 0 and 1; (0, 0) and (1, 1) succeed in their third frame.
    assert [(s.stream, s.index, s.length, s.success_frame) for s in cut.segments] == [
        (0, 0, 3, 2), (0, 1, 4, None), (1, 0, 4, None), (1, 1, 3, 2),
    ]  # fmt: skip
    first = cut.segments_of(0)[0]
    np.testing.assert_array_equal(cut.columns(first)["next.truncated"], [False, False, True])
    assert not cut.columns(first)["next.done"].any()
    pixels = cut.pixels(first, FRONT)
    np.testing.assert_array_equal(pixels, source.pixels(source.segments_of(0)[0], FRONT, slice(0, 3)))
    assert cut.dataset.meta.stats["action"]["count"] == 14
    rows = np.concatenate([cut.pixels(s, FRONT) for s in sorted(cut.segments, key=lambda s: s.episode)])
    np.testing.assert_allclose(cut.dataset.meta.stats[FRONT]["mean"], image_stats(rows)["mean"], atol=0.01)


def test_every_filter_is_told(source, tmp_path):
    filter_streams(source, SegmentFilter(success=True), "me/won", tmp_path / "won", schema="streams")
    won = StreamDataset("me/won", tmp_path / "won", streaming=True)
    filter_streams(won, SegmentFilter(streams=[0]), "me/two", tmp_path / "two", frames_after_success=1)
    filters = check_dataset(tmp_path / "two").filters
    assert [(f["source"], f["source_segments"], f["segments"]) for f in filters] == [
        ("me/stream", 24, 12), ("me/won", 12, 4),
    ]  # fmt: skip
    assert (filters[0]["filter"]["success"], filters[1]["frames_after_success"]) == (True, 1)


def test_a_kept_segment_keeps_its_place_since_the_scene_reset(tmp_path):
    # Of stream 0 the segments 2, 3, 5 and 7; the scene was reset before segment 4.
    record(tmp_path / "some", skip=[(0, k) for k in (0, 1, 4, 6)])
    some = StreamDataset("me/some", tmp_path / "some")
    filter_streams(some, SegmentFilter(streams=[0]), "me/d", tmp_path / "d", schema="streams")
    kept = StreamDataset("me/d", tmp_path / "d").segments_of(0)
    assert [(s.index, s.position) for s in kept] == [(2, 2), (3, 3), (5, 1), (7, 3)]


def test_files_that_would_grow_too_long_are_split(source, tmp_path, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.data.storage.MAX_FILE_DURATION_S", 10 / 5)
    filter_streams(source, SegmentFilter(streams=[1]), "me/split", tmp_path / "d", schema="streams")
    split = StreamDataset("me/split", tmp_path / "d")
    assert split.meta.episodes["data/file_index"] == [0, 0, 1, 1, 2, 2, 3, 3]
    for mine, theirs in zip(split.segments, source.segments_of(1), strict=True):
        np.testing.assert_array_equal(split.pixels(mine, FRONT), source.pixels(theirs, FRONT))


def test_mistakes_leave_nothing_behind(source, tmp_path):
    for options, named in (
        ({"min_policy_version": 99}, "none of the 24 segments"),
        ({"streams": [0, 99]}, "--filter.streams"),
        ({"tasks": ["fly"]}, "--filter.tasks"),
    ):
        with pytest.raises(ValueError, match=named):
            filter_streams(source, SegmentFilter(**options), "me/none", tmp_path / "d")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match=r"--filter\.events"):
        SegmentFilter(events=["reset", "initial"])
    with pytest.raises(FileExistsError, match=r"--output\.root"):
        filter_streams(source, SegmentFilter(), "me/all", tmp_path)


def test_clips_that_begin_between_keyframes_are_refused(source, tmp_path):
    (path,) = sorted(source.meta.root.rglob("file-000.mp4"))
    with pytest.raises(ValueError, match="cannot be copied without decoding from frame 1 on"):
        CopiedVideoFile(tmp_path / "a.mp4", 5).append(Clip(path, 1, 2))
    with pytest.raises(ValueError, match="ends after"):
        CopiedVideoFile(tmp_path / "b.mp4", 5).append(Clip(path, 0, 1000))
    with pytest.raises(ValueError, match="ends after"):
        read_frames(path, 0, 1000, 5)


def test_copied_frames_last_as_long_as_encoded_ones(source, tmp_path):
    filter_streams(source, SegmentFilter(), "me/all", tmp_path / "d")
    (path,) = (tmp_path / "d").rglob("*.mp4")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.frames, float(stream.duration * stream.time_base)) == (96, 96 / 5)


def cronos_streams(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-streams", *map(str, arguments)])
    script.main()


def test_command(source, tmp_path, monkeypatch, capsys):
    dataset = ("--dataset.repo_id=me/stream", f"--dataset.root={source.meta.root}")
    cronos_streams(monkeypatch, "check", *dataset)
    assert capsys.readouterr().out == "whole: 3 streams, 24 segments, 96 frames\n"
    cronos_streams(monkeypatch, "statistics", *dataset, f"--output={tmp_path / 'new/statistics.json'}")
    assert "[0.31, 0.69]" in capsys.readouterr().out  # Wilson's interval of 12 of 24
    assert json.loads((tmp_path / "new/statistics.json").read_text())["success"] == [12, 4, 24]
    output = ("--output.repo_id=me/kept", f"--output.root={tmp_path / 'kept'}")
    cronos_streams(monkeypatch, "filter", *dataset, *output, "--filter.success=true", "--frames_after_success=1")
    assert capsys.readouterr().out == f"12 of 24 segments in {tmp_path / 'kept'}\n"
    assert LeRobotDataset("me/kept", root=tmp_path / "kept").num_episodes == 12


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check"], "--dataset.repo_id"),
        (["check", "--dataset.repo_id=me/s", "--dataset.root=nowhere"], "--dataset.root=nowhere"),
        (["filter", "--frames_after_success=-1"], "--frames_after_success"),
        (["filter", "--schema=state"], "--schema"),
        (["filter", "--dataset.repo_id=me/s"], "--output.repo_id"),
    ],
    ids=str,
)
def test_command_tells_mistakes(monkeypatch, arguments, message):
    with pytest.raises(SystemExit, match=f"^error: [^\n]*{message}"):
        cronos_streams(monkeypatch, *arguments)
