"""Folders in whose path LeRobot finds no data file are refused before anything is recorded into them."""

import shutil

import pytest
from lerobot_env_cronos import CronosEnvConfig
from synthetic_streams import record
from tiny_checkpoints import STATE

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos
from cronos_lerobot.training.record_config import RecordConfig


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("recorded") / "streams"
    record(root, steps=4)
    return root


def test_other_unusual_names_are_read(tmp_path):
    root = tmp_path / "{a} k=v, b" / "d]"
    record(root, steps=4)
    assert len(StreamDataset("me/stream", root).dataset) == 12


@pytest.mark.parametrize("name", ["run[1]", "a*", "a?", "a::b"])
def test_a_run_and_a_filter_do_not_begin(tmp_path, recorded, name):
    with pytest.raises(ValueError, match=r"/streams has (\[|\*|\?|::) in its path, with which LeRobot cannot"):
        RecordConfig("me/stream").check(tmp_path / name, 1, CronosEnvConfig(), 80, resume=False)
    with pytest.raises(ValueError, match=" in its path, with which LeRobot cannot read a dataset"):
        filter_streams(StreamDataset("me/stream", recorded), SegmentFilter(), "me/all", tmp_path / name / "all")
    assert not (tmp_path / name).exists()


def test_demonstrations_are_not_recorded_and_nothing_is_overwritten(tmp_path):
    root = tmp_path / "demos[2]"
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text("{}")
    dataset = DemoDatasetConfig("me/demos", root, 1, overwrite=True)
    with pytest.raises(ValueError, match=r"demos\[2\] has \[ in its path"):
        record_demos(RecordDemosConfig(env=CronosEnvConfig(**STATE, num_threads=1), dataset=dataset, num_envs=1))
    assert (root / "meta/info.json").read_text() == "{}"


def test_a_relative_folder_is_where_the_command_runs(tmp_path, monkeypatch):
    (tmp_path / "[x]").mkdir()
    monkeypatch.chdir(tmp_path / "[x]")
    with pytest.raises(ValueError, match=r"/\[x\]/d has \[ in its path"):
        SegmentWriter("me/stream", "d", {}, 5)


def test_what_was_recorded_there_is_told_in_words(tmp_path, recorded):
    root = tmp_path / "a[1]"
    shutil.copytree(recorded, root)
    for read in (
        lambda: StreamDataset("me/stream", root),
        lambda: StreamDataset("me/stream", root, streaming=True),
        lambda: SegmentWriter.resume("me/stream", root),
        lambda: check_dataset(root),
    ):
        with pytest.raises(ValueError, match=r"a\[1\] has \[ in its path"):
            read()
