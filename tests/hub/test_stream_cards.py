"""The card of a recording whose segments were chosen: by what, and no success where that is what chose them."""

import json
import shutil

import draccus
import pytest
from lerobot_env_cronos import CronosEnvConfig
from synthetic_streams import record

from cronos_lerobot.data.stream_filter import PROVENANCE, SegmentFilter, filter_streams
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.hub.config import StreamConfig
from cronos_lerobot.hub.streams import write_stream_repository
from cronos_lerobot.training.config import CronosTrainConfig

FAILS = "The policy fails often, above all early on"
TABLE = "| segment since the scene reset | success |"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """24 segments, of which every second one succeeds."""
    root = tmp_path_factory.mktemp("recorded") / "streams"
    record(root)
    return root


def card_of(root, out):
    out.mkdir()
    write_stream_repository(StreamConfig(repo_id="me/d", root=root, dry_run=True, output_dir=out), out)
    return (out / "README.md").read_text()


def test_a_recording_as_it_is_has_its_success(recorded, tmp_path):
    card = card_of(recorded, tmp_path / "out")
    assert FAILS in card
    # Segment k of stream i succeeds if i + k is even: the first and the fifth of two streams of three.
    assert f"{TABLE} 95 % interval | segments |" in card
    assert "| 1 | 0.67 | " in card
    assert "cronos-streams filter` kept" not in card


@pytest.mark.parametrize(
    ("wanted", "frames", "kept", "flags", "tells"),
    [
        ({"success": True, "found_complete": False}, 0, 8,
         "--filter.success=true --filter.found_complete=false --frames_after_success=0", False),
        ({"found_complete": True}, None, 4, "--filter.found_complete=true", False),
        ({"streams": [0, 1], "min_policy_version": 2}, None, 8,
         "--filter.streams=[0, 1] --filter.min_policy_version=2", True),
    ],
)  # fmt: skip
def test_a_filter_is_told_and_what_it_chose_by_is_no_result(
    recorded, tmp_path, wanted, frames, kept, flags, tells
):
    root = tmp_path / "filtered"
    source = StreamDataset("me/stream", recorded)
    filter_streams(source, SegmentFilter(**wanted), "me/filtered", root, frames_after_success=frames)
    card = card_of(root, tmp_path / "out")
    assert f"`cronos-streams filter` kept {kept} of the 24 segments of `me/stream`, by `{flags}`." in card
    assert ("They were chosen by how they went" in card) == (not tells)
    assert (FAILS in card, TABLE in card) == (tells, tells)
    # What they began after is none of their outcome.
    assert "| before a segment | times |" in card


def test_filters_one_after_the_other_are_all_told(recorded, tmp_path):
    won, two = tmp_path / "won", tmp_path / "two"
    filter_streams(StreamDataset("me/stream", recorded), SegmentFilter(success=True), "me/won", won)
    filter_streams(StreamDataset("me/won", won), SegmentFilter(streams=[0]), "me/two", two)
    card = card_of(two, tmp_path / "out")
    assert "of the 12 segments of `me/won`, by `--filter.streams=[0]`." in card
    assert "kept 12 of the 24 segments of `me/stream`, by `--filter.success=true`." in card
    assert "They were chosen by how they went" in card
    assert (FAILS in card, TABLE in card) == (False, False)


def test_a_recording_that_broke_off_is_told(recorded, tmp_path):
    record(tmp_path / "cut", skip=[(1, 7)])
    assert "not whole here" not in card_of(recorded, tmp_path / "whole")
    card = card_of(tmp_path / "cut", tmp_path / "out")
    assert "The streams are not whole here (stream 1 ends after 28 steps, stream 0 after 32: the" in card
    assert "whole and in order" not in card


def test_a_recording_that_ends_before_its_run_is_told(recorded, tmp_path):
    """All of its streams end at one step, 32, as those of a whole one do."""
    run = tmp_path / "run"
    run.mkdir()
    shutil.copytree(recorded, run / "streams")
    config = json.loads(json.dumps(draccus.encode(CronosTrainConfig(env=CronosEnvConfig(), num_envs=3))))
    start = {"config": config, "environment": "lerobot_env_cronos/kitchen_2x2-v1", "git_commit": None}
    start |= {"command": ["cronos-train"], "versions": {"cronos-lerobot": "0.2.0"}}
    (run / "manifest.json").write_text(json.dumps({"starts": [start]}))
    for steps, told in ((96, ", whole and in order"), (480, "the recording ends after 32 of 160 control steps")):
        record = {"kind": "update", "interaction_steps": steps, "interventions": 4, "updates": 1}
        record |= {"interventions_by_kind": {"scene_reset": 4}}
        (run / "metrics.jsonl").write_text(json.dumps(record) + "\n")
        card = card_of(run / "streams", tmp_path / f"out{steps}")
        assert told in card
        assert ("whole and in order" in card) == (steps == 96)


def test_a_filters_note_that_is_damaged_is_named(recorded, tmp_path):
    root = tmp_path / "filtered"
    filter_streams(StreamDataset("me/stream", recorded), SegmentFilter(streams=[0]), "me/filtered", root)
    note = root / PROVENANCE
    note.write_text(json.dumps({"filter": {}})[:-1])
    with pytest.raises(ValueError, match=rf"{note} is damaged: "):
        card_of(root, tmp_path / "out")
