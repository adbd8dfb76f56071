"""`cronos-streams weights`, against numbers worked out by hand and LeRobot's own reader."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.rewards.sarm.rabc import RABCWeights
from synthetic_streams import ORIGIN, record
from weighted_streams import CHUNK, DIFFERENCES, GAMMA, PROGRESS, WEIGHTS, record_weighted

from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.stream_statistics import statistics
from cronos_lerobot.data.stream_weights import COLUMN, reward_levels, write_progress
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.scripts import streams as script

FLAT = np.concatenate(PROGRESS)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "streams"
    record_weighted(folder)
    StreamDataset("me/stream", folder, streaming=True).check()
    return folder


def write(root: Path, output: Path, **options) -> pd.DataFrame:
    write_progress(StreamDataset("me/stream", root, streaming=True), output, **options)
    return pd.read_parquet(output)


def test_what_was_found_complete_and_taken_away_has_levels():
    # Complete when the segment began, lifted by its first action (0.1), dropped by the fourth, or never.
    lifted = np.array([-0.9, 0, 0, 0])
    never = np.zeros(4, bool)
    assert reward_levels(lifted, never, "difference").tolist() == [1, 0.1, 0.1, 0.1, 0.1]
    assert reward_levels(lifted - [0, 0, 0, 0.1], never, "difference").tolist() == [1, 0.1, 0.1, 0.1, 0]
    # A grasp that it began with and lost.
    assert reward_levels(np.array([0, -0.1]), never[:2], "difference").tolist() == [0.1, 0.1, 0]
    assert reward_levels(np.array([-0.5, 0]), never[:2], "difference") is None


def test_progress_of_every_frame(root, tmp_path):
    rows = write(root, tmp_path / "new/progress.parquet", gamma=GAMMA)
    np.testing.assert_array_equal(rows["index"], np.arange(26))
    np.testing.assert_array_equal(rows["episode_index"], np.repeat(np.arange(6), [6, 6, 6, 3, 3, 2]))
    np.testing.assert_array_equal(rows["frame_index"][21:], [0, 1, 2, 0, 1])
    np.testing.assert_allclose(rows[COLUMN], FLAT, atol=1e-7)
    made_with = json.loads(pq.read_metadata(tmp_path / "new/progress.parquet").metadata[b"cronos"])
    assert made_with == {"dataset": "me/stream", "gamma": GAMMA}
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["progress.parquet"]


def test_lerobot_weighs_frames_as_by_hand(root, tmp_path):
    write(root, tmp_path / "p", gamma=GAMMA)
    weighter = RABCWeights(tmp_path / "p", chunk_size=CHUNK, device=torch.device("cpu"))
    by_hand = torch.tensor(np.concatenate(WEIGHTS), dtype=torch.float32)
    # Backwards, and without the last frame: by their index, whatever the batch is.
    weights, stats = weighter.compute_batch_weights({"index": torch.arange(25).flip(0)})
    expected = by_hand[:25].flip(0)
    torch.testing.assert_close(weights, expected * 25 / expected.sum(), atol=1e-4, rtol=0)
    assert (stats["num_full_weight"], stats["num_zero_weight"]) == (9, 3)
    assert weighter.get_stats()["delta_mean"] == pytest.approx(np.concatenate(DIFFERENCES).mean(), abs=1e-6)


def test_where_the_level_is_paid_at_every_step(tmp_path):
    origin = replace(ORIGIN, flags={"protocol.reward": "level"})
    record_weighted(tmp_path / "d", reward="level", origin=origin)
    rows = write(tmp_path / "d", tmp_path / "p", gamma=GAMMA)
    # The grasp that the last segment began with was paid before it, and is not recorded.
    np.testing.assert_allclose(rows[COLUMN], [*FLAT[:-2], 0, 0], atol=1e-7)


def test_levels_of_segments_that_cannot_be_told_from_sums_alone():
    def levels(rewards, successes):
        found = reward_levels(np.array(rewards), np.array(successes), "difference")
        return None if found is None else found.tolist()

    # Undone, and done again; the object was in the hand from the start.
    assert levels([0.9, -1, 0.1, 0.9], [1, 0, 0, 1]) == [1, 1, 0, 0.1, 1]
    assert levels([0, 0.9], [0, 1]) == [0.1, 0.1, 1]
    # Complete until it was undone.
    assert levels([0, -1], [1, 0]) == [1, 1, 0]
    # Two grasps at once, a success that was not paid, and one that was paid and is none.
    assert levels([0.1, 0.1], [0, 0]) is None
    assert levels([0, 0, 0], [0, 1, 1]) is None
    assert levels([1, 0], [0, 0]) is None


def test_a_filtered_dataset_has_weights_of_its_own(root, tmp_path):
    source = StreamDataset("me/stream", root, streaming=True)
    filter_streams(
        source,
        SegmentFilter(found_complete=False),
        "me/stream",
        tmp_path / "d",
        frames_after_success=0,
        schema="streams",
    )
    rows = write(tmp_path / "d", tmp_path / "p", gamma=GAMMA)
    # The first segment ends with its success, in the fourth frame.
    np.testing.assert_allclose(rows[COLUMN][:4], [0.0625, 0.125, 0.25, 1], atol=1e-7)
    np.testing.assert_allclose(rows[COLUMN][4:10], PROGRESS[1], atol=1e-7)
    assert len(rows) == 26 - 2 - 6


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ((), "--output"),
        (("--output=.",), "--output"),
        (("--output=p", "--gamma=1.5"), "--gamma"),
    ],
)
def test_wrong_flags(root, tmp_path, monkeypatch, flags, named):
    monkeypatch.chdir(tmp_path)
    dataset = ["--dataset.repo_id=me/stream", f"--dataset.root={root}"]
    monkeypatch.setattr(sys, "argv", ["cronos-streams", "weights", *dataset, *flags])
    with pytest.raises(SystemExit, match=f"^error: {named}"):
        script.main()
    assert not list(tmp_path.iterdir())


def test_the_command(root, tmp_path, monkeypatch, capsys):
    dataset = ["--dataset.repo_id=me/stream", f"--dataset.root={root}", f"--output={tmp_path / 'p'}"]
    monkeypatch.setattr(sys, "argv", ["cronos-streams", "weights", *dataset, "--gamma=0.5"])
    script.main()
    assert "26 frames of 6 segments\n" in capsys.readouterr().out
    np.testing.assert_allclose(pd.read_parquet(tmp_path / "p")[COLUMN], FLAT, atol=1e-7)


def test_what_cannot_be_weighed_is_refused(tmp_path):
    record(tmp_path / "d", repo_id="me/stream")
    with pytest.raises(ValueError, match=r"stream 0, step 0: the rewards are not those of --protocol.reward"):
        write(tmp_path / "d", tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_progress_and_statistics_need_no_critic(root, tmp_path):
    record_weighted(tmp_path / "d", describes=())
    streams = StreamDataset("me/stream", tmp_path / "d", streaming=True)
    streams.check()
    assert "cronos.value" not in streams.meta.features
    assert statistics(streams) == statistics(StreamDataset("me/stream", root, streaming=True))
    rows = write(tmp_path / "d", tmp_path / "p", gamma=GAMMA)
    np.testing.assert_allclose(rows[COLUMN], FLAT, atol=1e-7)
