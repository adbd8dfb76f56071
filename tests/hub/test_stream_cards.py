"""The card of a dataset, and which of its files are pushed."""

import json
import shutil

import pyarrow.parquet as pq
import pytest
from lerobot_env_cronos import CronosEnvConfig
from synthetic_streams import record

from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.hub.config import StreamConfig
from cronos_lerobot.hub.streams import not_being_recorded
from cronos_lerobot.locks import FolderInUseError, FolderLock
from cronos_lerobot.scripts.publish import publish_stream
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos
from policies import rows

SUCCESS = ["segment since the scene reset", "success, 95 % interval", "segments"]
CHOSEN = "were chosen by how they went"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """24 segments, of which every second one succeeds."""
    root = tmp_path_factory.mktemp("recorded") / "streams"
    record(root)
    return root


@pytest.fixture
def copy(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "copy")


def card_of(root, out):
    publish_stream(StreamConfig(repo_id="me/d", root=root, dry_run=True, output_dir=out))
    return (out / "README.md").read_text()


def tree(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_recording_is_pushed_as_it_is_with_its_success_and_columns(recorded, tmp_path):
    card = card_of(recorded, tmp_path / "out")
    assert tree(tmp_path / "out") == tree(recorded) | {"README.md": card.encode()}
    cells = rows(card)
    # Segment k of stream i succeeds if i + k is even: the first and the fifth of two streams of three.
    number, success, _ = cells[cells.index(SUCCESS) + 1]
    assert (number, success[:5]) == ("1", "0.67 ")
    assert "whole and in order" in card
    columns = {row[0]: row[3] for row in cells if len(row) == 4 and "." in row[0]}
    assert columns["cronos.segments_since_reset"].startswith("task switches")
    assert "4 scene reset" in columns["cronos.event"]
    assert "cronos.log_prob" in columns
    assert "episode_index" not in columns


@pytest.mark.parametrize(
    ("wanted", "frames", "kept", "flags", "is_chosen"),
    [
        ({"success": True, "found_complete": False}, 0, 8,
         "--filter.success=True --filter.found_complete=False --frames_after_success=0", True),
        ({"found_complete": True}, None, 4, "--filter.found_complete=True", True),
        ({"streams": [0, 1], "min_policy_version": 2}, None, 8,
         "--filter.streams=[0, 1] --filter.min_policy_version=2", False),
    ],
)  # fmt: skip
def test_a_filter_is_told_and_what_it_chose_by_is_no_result(
    recorded, tmp_path, wanted, frames, kept, flags, is_chosen
):
    root = tmp_path / "filtered"
    source = StreamDataset("me/stream", recorded)
    filter_streams(
        source, SegmentFilter(**wanted), "me/filtered", root, frames_after_success=frames, schema="streams"
    )
    card = card_of(root, tmp_path / "out")
    assert f"kept {kept} of 24 segments of `me/stream`: `{flags}`" in card
    assert (CHOSEN in card, SUCCESS in rows(card)) == (is_chosen, not is_chosen)
    assert ["before a segment", "times"] in rows(card)


def test_a_recording_that_broke_off_is_told(tmp_path):
    record(tmp_path / "cut", skip=[(1, 7)])
    card = card_of(tmp_path / "cut", tmp_path / "out")
    assert "The streams are not whole: `stream 1 ends after 28 steps" in card
    assert "whole and in order" not in card


def test_demonstrations_have_their_flags(tmp_path):
    env = CronosEnvConfig(observation_height=64, observation_width=64, num_threads=1)
    record_demos(
        RecordDemosConfig(env=env, dataset=DemoDatasetConfig("me/demos", tmp_path / "d", 2), num_envs=2, seed=4)
    )
    card = card_of(tmp_path / "d", tmp_path / "out")
    assert "Demonstrations of a scripted expert in the CRONOS scene `kitchen_2x2`" in card
    assert ["--seed", "4"] in rows(card)
    assert "lerobot-train --policy.type=pocketvla --policy.push_to_hub=false --dataset.repo_id=me/d" in card


# Datasets of other people --------------------------------------------------------------------------------


def test_only_files_of_the_dataset_are_pushed(copy, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HOME", "/home/melanie")
    secrets = [
        ".env",
        "token",
        "data/id_rsa",
        "meta/notes.json",
        "meta/episodes/chunk-000/key.txt",
        "images/a.png",
    ]
    for name in secrets:
        (copy / name).parent.mkdir(exist_ok=True)
        (copy / name).write_text("KEY")
    data = next((copy / "data").rglob("*.parquet"))
    shutil.copy(data, data.with_name("file-123.parquet"))
    origin = json.loads((copy / "meta/cronos.json").read_text())
    origin["flags"] = {
        "env.benchmark": "/home/melanie/bench",
        "seed": "1\n```\n# Injected",
        "protocol.x": "hf_" + "a" * 34,
    }
    (copy / "meta/cronos.json").write_text(json.dumps(origin))
    card = card_of(copy, tmp_path / "out")
    out = tree(tmp_path / "out")
    assert out.keys() == tree(copy).keys() - set(secrets) - {"data/chunk-000/file-123.parquet"}
    assert not [name for name, content in out.items() if b"melanie" in content or b"hf_a" in content]
    assert "# Injected" not in card.splitlines()
    left = capsys.readouterr().out.partition("not pushed: ")[2].splitlines()[0].split(", ")
    assert set(left) == {*secrets, "data/chunk-000/file-123.parquet"}


def test_a_link_out_of_the_dataset_is_refused(copy, tmp_path):
    data = next((copy / "data").rglob("*.parquet"))
    elsewhere = tmp_path / "elsewhere.parquet"
    shutil.move(data, elsewhere)
    data.symlink_to(elsewhere)
    with pytest.raises(ValueError, match="leads out"):
        card_of(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("change", [{"filters": [{"filter": 3}]}, {"filters": [7]}, {"flags": 3}])
def test_a_damaged_origin_is_named(copy, tmp_path, change):
    file = copy / "meta/cronos.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(ValueError, match=r"cronos\.json is damaged"):
        card_of(copy, tmp_path / "out")


def test_a_damaged_dataset_is_not_published(copy, tmp_path):
    data = next((copy / "data").rglob("*.parquet"))
    pq.write_table(pq.read_table(data).slice(0, 5), data)
    with pytest.raises(ValueError, match=r"file-000\.parquet"):
        card_of(copy, tmp_path / "out")


def test_what_is_being_recorded_is_not_published(copy, tmp_path):
    with FolderLock(copy), pytest.raises(FolderInUseError):
        card_of(copy, tmp_path / "out")
    with not_being_recorded(copy), pytest.raises(FolderInUseError):
        FolderLock(copy).acquire()
    card_of(copy, tmp_path / "out")
