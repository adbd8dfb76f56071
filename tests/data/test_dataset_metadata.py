"""A folder that holds a dataset is never filled up from the Hub; what another LeRobot wrote is said to be that."""

import json
import shutil
from pathlib import Path

import pytest
from lerobot_policy_pocketvla import PocketVLAConfig
from packaging.version import Version
from synthetic_segments import FPS, features
from synthetic_streams import record

from cronos_lerobot.agents.imitation.batches import Demonstrations
from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.dataset_metadata import DatasetFileError, versions_explained

FRONT = "observation.images.front"
OPEN = {
    "streams": lambda root: StreamDataset("me/stream", root, streaming=True),
    "resume": lambda root: SegmentWriter.resume("me/stream", root),
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
@pytest.mark.parametrize("lost", ["meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"])
def test_what_is_missing_of_a_folder_is_named_and_the_rest_stays(root, opens, lost):
    (root / lost).unlink()
    before = files(root)
    with pytest.raises(DatasetFileError, match=rf"^{root}/{lost.split('/chunk')[0]} is missing$"):
        OPEN[opens](root)
    assert files(root) == before


LOADED = OPEN | {"streams": lambda root: StreamDataset("me/stream", root)}


@pytest.mark.parametrize("opens", ["streams", "demos"])
@pytest.mark.parametrize("lost", ["data/chunk-000/file-000.parquet", f"videos/{FRONT}/chunk-000/file-000.mp4"])
def test_a_missing_data_or_video_file_is_named_and_the_rest_stays(root, opens, lost):
    """LeRobot would download the Hub's dataset over it."""
    (root / lost).unlink()
    before = files(root)
    with pytest.raises(DatasetFileError, match=rf"^{root / lost} is missing$"):
        LOADED[opens](root)
    assert files(root) == before


def test_what_lerobot_has_downloaded_into_a_folder_it_may_complete(root, monkeypatch):
    (lost,) = root.glob("data/*/*.parquet")
    content = lost.read_bytes()
    lost.unlink()
    (root / ".cache/huggingface/download").mkdir(parents=True)
    monkeypatch.setattr("lerobot.datasets.lerobot_dataset.get_safe_version", lambda *_: "v3.0")
    downloads = "lerobot.datasets.lerobot_dataset.snapshot_download"
    monkeypatch.setattr(downloads, lambda *_, **__: lost.write_bytes(content))
    assert len(LOADED["streams"](root).dataset) == 96


@pytest.mark.parametrize("opens", ["streams", "demos"])
def test_without_an_episode_nothing_is_downloaded(tmp_path, opens):
    SegmentWriter("me/stream", tmp_path / "d", features(), FPS).finalize()
    before = files(tmp_path / "d")
    with pytest.raises(ValueError, match=r"has no episode yet$"):
        LOADED[opens](tmp_path / "d")
    assert files(tmp_path / "d") == before


@pytest.mark.parametrize("opens", OPEN)
@pytest.mark.parametrize("version", ["v2.1", "v1.6"])
def test_another_version_of_lerobots_format_is_told(root, opens, version):
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | {"codebase_version": version}))
    with pytest.raises(ValueError, match=r" has another version of LeRobot's format than this LeRobot's, v3\.0; "):
        OPEN[opens](root)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ((), r"me/stream on the Hub has no tag of a version, as v3\.0: name a revision"),
        (("2.1",), "me/stream has another version of LeRobot's format"),
        (("4.0",), "me/stream has another version of LeRobot's format"),
    ],
)
def test_a_repository_without_this_version_is_told(tmp_path, monkeypatch, tags, message):
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.HF_LEROBOT_HOME", tmp_path)
    monkeypatch.setattr("lerobot.datasets.utils.get_repo_versions", lambda _: [Version(tag) for tag in tags])
    with pytest.raises(ValueError, match=message):
        StreamDataset("me/stream", streaming=True)
    with pytest.raises(RuntimeError, match="another"), versions_explained("me/stream"):
        raise RuntimeError("another")


def test_a_dataset_without_an_episode_is_whole_enough_to_go_on_with(tmp_path):
    SegmentWriter("me/stream", tmp_path / "d", features(), FPS).finalize()
    SegmentWriter.resume("me/stream", tmp_path / "d").finalize()
    with pytest.raises(DatasetFileError, match="has no episode yet"):
        check_dataset(tmp_path / "d")


def test_a_revision_is_followed_or_refused(root, monkeypatch):
    with pytest.raises(
        ValueError, match=rf"^revision=v2 is of the Hub, and root={root} a folder: give one of them$"
    ):
        StreamDataset("me/stream", root, "v2")
    monkeypatch.setattr("lerobot.datasets.dataset_metadata.HF_LEROBOT_HOME", root.parent)
    with pytest.raises(ValueError, match=rf"^revision=v2 is of the Hub, and d is in {root}: leave revision out"):
        StreamDataset("d", revision="v2", streaming=True)
