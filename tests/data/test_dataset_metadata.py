"""A folder that holds a dataset is never filled up from the Hub, and LeRobot can read what is recorded."""

import json
import shutil
from pathlib import Path

import pytest
from lerobot_policy_pocketvla import PocketVLAConfig
from packaging.version import Version
from synthetic_segments import FPS, features, observation_space, world
from synthetic_streams import record

from cronos_lerobot.agents.imitation.batches import Demonstrations
from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.dataset_metadata import DatasetFileError

FRONT = "observation.images.front"
OPEN = {
    "streams": lambda root: StreamDataset("me/stream", root),
    "streamed": lambda root: StreamDataset("me/stream", root, streaming=True),
    "resume": lambda root: SegmentWriter(
        "me/stream", root, stream_features(world(observation_space(None))), 5, resume=-1
    ),
    "demos": lambda root: Demonstrations(
        DemosConfig(repo_id="me/stream", root=root), PocketVLAConfig(device="cpu")
    ),
    "check": check_dataset,
}


def files(root: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("recorded") / "d"
    record(root, flush_at=())
    return root


@pytest.fixture
def root(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "d")


@pytest.mark.parametrize("opens", OPEN)
@pytest.mark.parametrize(
    "lost",
    [
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
        f"videos/{FRONT}/chunk-000/file-000.mp4",
    ],
)
def test_what_is_missing_of_a_folder_is_named_and_the_rest_stays(root, opens, lost):
    """LeRobot would download the Hub's dataset over it."""
    if opens in ("streamed", "resume") and not lost.startswith("meta/"):
        return
    (root / lost).unlink()
    before = files(root)
    with pytest.raises(DatasetFileError, match=lost.split("/chunk")[0]):
        OPEN[opens](root)
    assert files(root) == before


def test_what_lerobot_has_downloaded_into_a_folder_it_may_complete(root, monkeypatch):
    (lost,) = root.glob("data/*/*.parquet")
    content = lost.read_bytes()
    lost.unlink()
    (root / ".cache/huggingface/download").mkdir(parents=True)
    monkeypatch.setattr("lerobot.datasets.lerobot_dataset.get_safe_version", lambda *_: "v3.0")
    downloads = "lerobot.datasets.lerobot_dataset.snapshot_download"
    monkeypatch.setattr(downloads, lambda *_, **__: lost.write_bytes(content))
    assert len(StreamDataset("me/stream", root).dataset) == 96


@pytest.mark.parametrize("opens", ["streams", "demos", "check"])
def test_without_an_episode_nothing_is_downloaded(tmp_path, opens):
    SegmentWriter("me/stream", tmp_path / "d", features(), FPS).finalize()
    before = files(tmp_path / "d")
    with pytest.raises(ValueError, match=r"has no episode yet$"):
        OPEN[opens](tmp_path / "d")
    assert files(tmp_path / "d") == before
    SegmentWriter("me/stream", tmp_path / "d", features(), FPS, resume=-1).finalize()


@pytest.mark.parametrize("opens", OPEN)
@pytest.mark.parametrize("version", ["v2.1", "v1.6"])
def test_another_version_of_lerobots_format_is_told(root, opens, version):
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | {"codebase_version": version}))
    with pytest.raises(ValueError, match=r"another version of LeRobot's format than v3\.0"):
        OPEN[opens](root)


@pytest.mark.parametrize(("tags", "message"), [((), "no tag v3.0"), (("2.1",), "format"), (("4.0",), "format")])
def test_a_repository_without_this_version_is_told(tmp_path, monkeypatch, tags, message):
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.HF_LEROBOT_HOME", tmp_path)
    monkeypatch.setattr("lerobot.datasets.utils.get_repo_versions", lambda _: [Version(tag) for tag in tags])
    with pytest.raises(ValueError, match=message):
        StreamDataset("me/stream", streaming=True)


def test_unusual_names_are_read(tmp_path):
    root = tmp_path / "{a} k=v, b" / "d]"
    record(root, steps=4)
    assert len(StreamDataset("me/stream", root).dataset) == 12


@pytest.mark.parametrize("name", ["run[1]", "a*", "a?", "a::b"])
def test_nothing_is_recorded_where_lerobot_cannot_read(tmp_path, recorded, name):
    root = shutil.copytree(recorded, tmp_path / name)
    for opens in OPEN.values():
        with pytest.raises(ValueError, match="choose a path without"):
            opens(root)
    with pytest.raises(ValueError, match="choose a path without"):
        SegmentWriter("me/stream", tmp_path / "new" / name, {}, 5)
    assert not (tmp_path / "new").exists()
