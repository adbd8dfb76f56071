"""When finished segments are written, by themselves and behind a writer that lags."""

import time

import pytest
from synthetic_segments import FPS, features, segment
from test_writer import LENGTHS, assert_holds

from cronos_lerobot.data.writer import SegmentWriter


@pytest.fixture(scope="module")
def segments():
    return [(segment(length, seed), f"task {seed % 3}") for seed, length in enumerate(LENGTHS)]


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
    for frames, task in segments[1:]:
        writer.add_segment(frames, task)
        time.sleep(0.12)
    # Segment 2 waits 0.2 s at most, though segments keep coming.
    assert writer.num_episodes >= 2
    wait_for_episodes(writer, len(segments))
    writer.finalize()
    dataset = assert_holds(tmp_path / "d", segments)
    assert len(set(dataset.meta.episodes["data/file_index"])) > 1


def test_a_writer_that_lags_still_puts_segments_together(tmp_path, segments):
    """Half of forty segments wait longer than the interval."""
    with SegmentWriter("me/test", tmp_path / "d", features(video=False), FPS, flush_interval_s=1) as writer:
        for _ in range(40):
            writer.add_segment(*segments[0], written=lambda: time.sleep(0.05))
    assert len(list((tmp_path / "d").glob("data/*/*.parquet"))) < 20


def test_waits_for_the_flush_interval(tmp_path, segments):
    writer = SegmentWriter("me/test", tmp_path / "d", features(), FPS, flush_interval_s=60)
    writer.add_segment(*segments[1])
    time.sleep(0.5)
    assert writer.num_episodes == 0
    writer.flush()
    assert writer.num_episodes == 1
    writer.finalize()
    with pytest.raises(ValueError, match="flush_interval_s must be more than 0 s, got 0"):
        SegmentWriter("me/test", tmp_path / "e", features(), FPS, flush_interval_s=0)
