"""Datasets of strangers: nothing outside their folder is written or deleted, and no file fills the memory."""

import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_segments import FPS, features, observation_space, world
from synthetic_streams import record

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.dataset_metadata import DatasetFileError


@pytest.fixture
def root(tmp_path):
    record(tmp_path / "d/e/f/dataset", steps=4)
    return tmp_path / "d/e/f/dataset"


def change_info(root, **changes):
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | changes))


def resume(root):
    columns = stream_features(world(observation_space(environment_state=None)))
    return SegmentWriter("me/stream", root, columns, FPS, resume=0)


def test_a_feature_that_leads_out_of_the_dataset_deletes_nothing(root):
    victim = root.parents[1] / "victim/chunk-000/file-000.mp4"
    victim.parent.mkdir(parents=True)
    victim.write_bytes(b"precious")
    video = {"dtype": "video", "shape": [64, 64, 3], "names": None}
    stored = json.loads((root / "meta/info.json").read_text())["features"]
    change_info(root, features=stored | {"../../../victim": video})
    for read in (resume, check_dataset, lambda root: StreamDataset("me/stream", root, streaming=True)):
        with pytest.raises(DatasetFileError, match="victim"):
            read(root)
    assert victim.read_bytes() == b"precious"


def test_links_that_lead_out_of_the_dataset_delete_nothing(root):
    outside = root.parent / "outside"
    os.rename(root / "data", outside)
    (root / "data").symlink_to(outside)
    with pytest.raises(ValueError, match="data is a symbolic link"):
        resume(root)
    assert (outside / "chunk-000/file-000.parquet").is_file()


def test_only_a_datasets_own_columns_are_resumed(root):
    """A stream's columns are not those of demonstrations."""
    with pytest.raises(ValueError, match="cannot be resumed: its column"):
        SegmentWriter("me/stream", root, features(), FPS, resume=0)
    assert len(StreamDataset("me/stream", root).segments) == 3


def test_files_with_other_names_are_left_alone(tmp_path):
    columns = {key: feature for key, feature in features().items() if feature["dtype"] == "float32"}
    SegmentWriter("me/test", tmp_path / "d", columns, FPS).finalize()
    notes = tmp_path / "d/data/chunk-000/notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("mine")
    SegmentWriter("me/test", tmp_path / "d", columns, FPS, resume=-1).finalize()
    assert notes.read_text() == "mine"


@pytest.mark.parametrize("in_one_row", [False, True])
def test_a_small_file_of_very_many_numbers_is_not_read(root, in_one_row):
    """Ten million equal numbers take a few kB, in as many rows or in the list of one."""
    path = root / "data/chunk-000/file-000.parquet"
    zeros = pa.array(np.zeros(10_000_000))
    column = pa.ListArray.from_arrays([0, len(zeros)], zeros) if in_one_row else zeros
    pq.write_table(pa.table({"index": column}), path)
    assert path.stat().st_size < 100_000
    for read in (check_dataset, lambda root: StreamDataset("me/stream", root, streaming=True).check()):
        with pytest.raises(DatasetFileError, match=r"file-000\.parquet has \d+ rows, \d+ values"):
            read(root)


def test_files_elsewhere_are_not_read(root):
    change_info(root, data_path="../../{chunk_index}/{file_index}.parquet")
    with pytest.raises(DatasetFileError, match="keeps files at"):
        check_dataset(root)
