import json
import os
import time
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from synthetic_segments import FPS, assert_same_pictures, features, segment, world

from cronos_lerobot.data import storage
from cronos_lerobot.data.schema import demonstration_features
from cronos_lerobot.data.video import fast_encoder
from cronos_lerobot.data.writer import RecordingError, SegmentWriter

LENGTHS = [12, 1, 25, 7, 18]
CAMERA = "observation.images.front"


@pytest.fixture(scope="module", params=[True, False], ids=["video", "images"])
def video(request) -> bool:
    """Pixels in mp4 files, or as PNG in the data files."""
    return request.param


@pytest.fixture(scope="module")
def segments():
    return [(segment(length, seed), f"task {seed % 3}") for seed, length in enumerate(LENGTHS)]


def resume(root: Path, num_episodes=-1, video=True) -> SegmentWriter:
    return SegmentWriter("me/test", root, features(video), FPS, resume=num_episodes)


def write(root: Path, segments, flush_after=(), video=True) -> SegmentWriter:
    writer = SegmentWriter("me/test", root, features(video), FPS, robot_type="widowx")
    for i, (frames, task) in enumerate(segments):
        writer.add_segment(frames, task, episode_metadata={"number": i})
        if i in flush_after:
            writer.flush()
    return writer


def assert_holds(root: Path, segments) -> LeRobotDataset:
    """The dataset, in a fresh LeRobotDataset, is exactly the segments in order."""
    dataset = LeRobotDataset("me/test", root=root)
    assert dataset.num_episodes == len(segments)
    assert len(dataset) == len(dataset.hf_dataset) == sum(len(frames["action"]) for frames, _ in segments)
    index = 0
    for episode, (frames, task) in enumerate(segments):
        for t in range(len(frames["action"])):
            item = dataset[index]
            assert (item["episode_index"], item["frame_index"], item["index"]) == (episode, t, index)
            assert item["timestamp"] == pytest.approx(t / FPS)
            assert item["task"] == task
            for key in set(frames) - {CAMERA}:
                np.testing.assert_array_equal(item[key].numpy(), frames[key][t], err_msg=key)
            assert_stored(dataset, item[CAMERA], frames[CAMERA][t])
            index += 1
    return dataset


def assert_stored(dataset: LeRobotDataset, decoded, written: np.ndarray) -> None:
    """Images bit for bit, videos up to the codec."""
    if CAMERA in dataset.meta.image_keys:
        pixels = np.moveaxis(written, -1, -3).astype(np.float32) / np.float32(255)
        np.testing.assert_array_equal(np.asarray(decoded), pixels)
    else:
        assert_same_pictures(decoded, written)


def test_round_trip(tmp_path, segments, video):
    write(tmp_path / "d", segments, video=video).finalize()
    dataset = assert_holds(tmp_path / "d", segments)
    assert dataset.meta.fps == FPS
    assert dataset.meta.info.robot_type == "widowx"
    assert list(dataset.meta.tasks.index) == ["task 0", "task 1", "task 2"]
    assert dataset.meta.episodes["number"] == [0, 1, 2, 3, 4]
    assert dataset.meta.episodes["tasks"] == [[task] for _, task in segments]
    assert not (tmp_path / "d" / storage.INCOMPLETE).exists()


def test_images_are_in_the_data_files_and_nowhere_else(tmp_path, segments):
    write(tmp_path / "d", segments, video=False).finalize()
    moved = (tmp_path / "d").rename(tmp_path / "elsewhere")
    dataset = assert_holds(moved, segments)
    assert (dataset.meta.image_keys, dataset.meta.video_keys, dataset.meta.video_path) == ([CAMERA], [], None)
    info = json.loads((moved / "meta/info.json").read_text())
    assert info["features"][CAMERA] == features(video=False)[CAMERA] | {"shape": [64, 64, 3]}
    assert {path.suffix for path in moved.rglob("*") if path.is_file()} == {".json", ".parquet"}
    # One episode can be read without the others.
    assert pq.ParquetFile(moved / "data/chunk-000/file-000.parquet").num_row_groups == len(LENGTHS)


def test_a_data_file_of_images_that_grew_too_big_is_followed_by_another(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (60, 64, 64, 3), dtype=np.uint8)  # 0.7 MB
    segments = [(segment(60, seed) | {CAMERA: noise}, "task") for seed in range(3)]
    writer = SegmentWriter("me/test", tmp_path / "d", features(video=False), FPS)
    writer._meta.info.data_files_size_in_mb = 1
    for frames, task in segments:
        writer.add_segment(frames, task)
    writer.finalize()
    assert assert_holds(tmp_path / "d", segments).meta.episodes["data/file_index"] == [0, 0, 1]


def test_same_dataset_as_lerobots_own_writer(tmp_path, segments, video):
    write(tmp_path / "ours", segments, flush_after=[1, 3], video=video).finalize()
    theirs = LeRobotDataset.create(
        "me/test", FPS, features(video), root=tmp_path / "theirs", use_videos=video, rgb_encoder=fast_encoder()
    )
    for frames, task in segments:
        for t in range(len(frames["action"])):
            row = {key: np.atleast_1d(array[t]) for key, array in frames.items()}
            theirs.add_frame(row | {"task": task})
        theirs.save_episode()
    theirs.finalize()
    ours, theirs = (LeRobotDataset("me/test", root=tmp_path / name) for name in ("ours", "theirs"))
    assert ours.num_frames == theirs.num_frames
    assert list(ours.meta.tasks.index) == list(theirs.meta.tasks.index)
    assert ours.hf_dataset.features == theirs.hf_dataset.features
    assert set(ours.meta.stats) == set(theirs.meta.stats)
    for key, stats in theirs.meta.stats.items():
        # Quantiles of numbers are those of all frames, see test_stats.py.
        kept = {name: stats[name] for name in stats if key == CAMERA or not name.startswith("q")}
        for name, value in kept.items():
            atol = 2e-3 * max(1.0, float(np.ptp(np.concatenate([stats["max"], stats["min"]]))))
            np.testing.assert_allclose(ours.meta.stats[key][name], value, atol=atol, err_msg=f"{key} {name}")
    schemas = [pq.read_schema(dataset.root / "data/chunk-000/file-000.parquet") for dataset in (ours, theirs)]
    assert schemas[0].equals(schemas[1])
    described = [json.loads(schema.metadata[b"huggingface"])["info"]["features"] for schema in schemas]
    assert described[0] == described[1]
    rows = [dataset.hf_dataset.with_format("numpy")[:] for dataset in (ours, theirs)]
    for key in ("action", "timestamp", "index", "episode_index", "task_index", "next.done"):
        np.testing.assert_array_equal(rows[0][key], rows[1][key], err_msg=key)


@pytest.mark.parametrize("flush_after", [(1,), (0, 1, 3)], ids=str)
def test_truncates_to_a_state_and_goes_on(tmp_path, segments, flush_after, video):
    straight = write(tmp_path / "straight", segments, video=video)
    straight.finalize()
    write(tmp_path / "d", segments, flush_after=flush_after, video=video).finalize()
    with resume(tmp_path / "d", 2, video) as writer:
        assert writer.num_frames == sum(LENGTHS[:2])
        assert_holds(tmp_path / "d", segments[:2])
        assert writer.episodes_before.total() == 2
        for i, (frames, task) in enumerate(segments[2:], start=2):
            writer.add_segment(frames, task, episode_metadata={"number": i})
    resumed = assert_holds(tmp_path / "d", segments)
    expected = LeRobotDataset("me/test", root=tmp_path / "straight")
    for key, stats in expected.meta.stats.items():
        for name, value in stats.items():
            np.testing.assert_allclose(resumed.meta.stats[key][name], value, atol=1e-9, err_msg=f"{key} {name}")


@pytest.mark.parametrize("relative", ["data/chunk-000/file-001.parquet", "meta/info.json", "meta/stats.json"])
def test_killed_while_publishing_it_still_loads_and_resumes(tmp_path, segments, monkeypatch, relative, video):
    """The process dies right before one of the files of the second flush is moved into place."""
    writer = write(tmp_path / "d", segments[:2], flush_after=[1], video=video)
    replace = os.replace

    def die(source, target):
        if str(target).endswith(relative):
            raise OSError("killed here")
        replace(source, target)

    monkeypatch.setattr(os, "replace", die)
    writer.add_segment(*segments[2], episode_metadata={"number": 2})
    with pytest.raises(RuntimeError, match="killed here"):
        writer.flush()
    monkeypatch.undo()
    # The operating system takes back what a process held.
    writer._lock.release()
    dataset = LeRobotDataset("me/test", root=tmp_path / "d")
    assert (dataset.num_episodes, len(dataset)) == (2, sum(LENGTHS[:2]))
    with resume(tmp_path / "d", video=video) as writer:
        for i, (frames, task) in enumerate(segments[2:], start=2):
            writer.add_segment(frames, task, episode_metadata={"number": i})
    assert_holds(tmp_path / "d", segments)


def test_blocks_instead_of_dropping(tmp_path):
    frames = [segment(10, seed) for seed in range(12)]
    size = sum(array.nbytes for array in frames[0].values())
    writer = SegmentWriter("me/test", tmp_path / "d", features(), FPS, max_pending_bytes=2 * size)
    pending = []
    for array in frames:
        writer.add_segment(array, "task")
        pending.append(writer._pending)
    writer.finalize()
    assert max(pending) <= 2 * size
    assert_holds(tmp_path / "d", [(array, "task") for array in frames])


def test_a_full_disk_leaves_nothing_of_the_flush_that_failed(tmp_path, segments, monkeypatch):
    writer = write(tmp_path / "d", segments[:2], flush_after=[0, 1])
    before = {path for path in (tmp_path / "d").rglob("*") if path.is_file()}

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage.pq, "write_table", full)
    writer.add_segment(*segments[2], episode_metadata={"number": 2})
    with pytest.raises(RecordingError, match="No space left"):
        writer.flush()
    # Also when the next flush is long due.
    writer._flush_interval_s = 0.0
    with pytest.raises(RecordingError, match="No space left"):
        writer.finalize()
    assert {path for path in (tmp_path / "d").rglob("*") if path.is_file()} == before
    monkeypatch.undo()
    assert_holds(tmp_path / "d", segments[:2])


@pytest.mark.parametrize(
    "change",
    [
        {"action": np.zeros((12, 7))},
        {"action": np.zeros((11, 7), np.float32)},
        {CAMERA: np.zeros((12, 32, 64, 3), np.uint8)},
        {"extra": np.zeros(12)},
    ],
    ids=["dtype", "length", "size", "unknown"],
)
def test_wrong_segments_are_refused(tmp_path, segments, change):
    with SegmentWriter("me/test", tmp_path / "d", features(), FPS) as writer:
        with pytest.raises(ValueError, match=next(iter(change))):
            writer.add_segment(segments[0][0] | change, "task")
        writer.add_segment(segments[0][0], "task")


def test_nothing_is_overwritten_or_resumed_by_mistake(tmp_path, segments):
    write(tmp_path / "d", segments[:1]).finalize()
    with pytest.raises(FileExistsError):
        SegmentWriter("me/test", tmp_path / "d", features(), FPS)
    with pytest.raises(ValueError, match="has only 1"):
        resume(tmp_path / "d", 2)
    write(tmp_path / "two", segments[:2]).finalize()
    with pytest.raises(ValueError, match="cannot keep 1"):
        resume(tmp_path / "two", 1)
    assert_holds(tmp_path / "two", segments[:2])
    with pytest.raises(FileNotFoundError, match="no LeRobotDataset"):
        resume(tmp_path / "nothing")


def test_frames_at_the_end_of_the_longest_file_are_found(tmp_path):
    """LeRobot matches timestamps in float32 to 1e-4 s, which fails in longer files."""
    space = gymnasium.spaces.Dict(
        {"pixels": gymnasium.spaces.Dict({"front": gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8)})}
    )
    length, count = 200, 26
    shades = np.broadcast_to(np.arange(length, dtype=np.uint8)[:, None, None, None], (length, 16, 16, 3))
    frames = {key: array for key, array in segment(length).items() if not key.startswith("observation")}
    frames["observation.images.front"] = shades
    with SegmentWriter("me/test", tmp_path / "d", demonstration_features(world(space)), FPS) as writer:
        for _ in range(count):
            writer.add_segment(frames, "task")
    dataset = LeRobotDataset("me/test", root=tmp_path / "d")
    assert dataset.meta.episodes["data/file_index"] == [0] * 25 + [1]
    for index in [*range(4800, 5000, 7), 4999, 5000, 5199]:
        shade = dataset[index]["observation.images.front"].numpy() * 255
        assert abs(shade.mean() - index % length) < 3


def wait_for_episodes(writer: SegmentWriter, count: int) -> None:
    end = time.monotonic() + 30
    while writer.num_episodes < count:
        assert time.monotonic() < end, f"{writer.num_episodes} of {count} episodes on disk"
        time.sleep(0.02)


def test_flushes_by_itself_what_has_waited(tmp_path, segments):
    """Whether or not more segments come."""
    writer = SegmentWriter("me/test", tmp_path / "d", features(), FPS, flush_interval_s=0.2)
    writer.add_segment(*segments[0])
    wait_for_episodes(writer, 1)
    assert_holds(tmp_path / "d", segments[:1])
    count, end = 1, time.monotonic() + 30
    while writer.num_episodes < 2:
        assert time.monotonic() < end, "nothing is flushed as long as segments keep coming"
        writer.add_segment(*segments[1])
        count += 1
        time.sleep(0.05)
    wait_for_episodes(writer, count)
    writer.finalize()
    dataset = LeRobotDataset("me/test", root=tmp_path / "d")
    assert len(set(dataset.meta.episodes["data/file_index"])) > 1


def test_a_writer_that_lags_still_puts_segments_together(tmp_path, segments):
    """Half of forty segments wait longer than the interval."""
    with SegmentWriter("me/test", tmp_path / "d", features(video=False), FPS, flush_interval_s=1) as writer:
        for _ in range(40):
            writer.add_segment(*segments[0], written=lambda: time.sleep(0.05))
    assert len(list((tmp_path / "d").glob("data/*/*.parquet"))) < 20
