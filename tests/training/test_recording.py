"""Recordings of whole runs: what happens when a recording fails."""

import logging
import shutil

import pytest
from dummies import DummyEnv
from runs import STREAMS, assert_same_weights, metrics, resumed, train
from runs import config as plain_config
from test_cronos_train import OBSERVATIONS, SMALL, cronos_train

from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import RecordingError, SegmentWriter
from cronos_lerobot.training.config import RecordConfig


def config(folder, **options):
    """Records every stream."""
    return plain_config(folder, **{"record": RecordConfig("me/stream", streams="all"), "eval_freq": 0} | options)


def test_a_failed_recording_keeps_what_was_flushed_and_is_not_resumed(tmp_path, caplog):
    """Segments until the first checkpoint are there; a run resumed from a later one says why there are no more."""
    recorded = {"record": RecordConfig("me/stream", streams="all"), "eval_freq": 0}

    class FailingEnv(DummyEnv):
        def step(self, actions):
            if self.t == 10:
                # The folder is gone, as if its disk were: what the writer does next fails.
                staging = tmp_path / "run/streams/.incomplete"
                shutil.rmtree(staging)
                staging.write_text("")
            return super().step(actions)

    train(config(tmp_path / "run"), env=FailingEnv(STREAMS))
    streams = StreamDataset("me/stream", tmp_path / "run/streams", streaming=True)
    streams.check()
    assert [len(streams.segments_of(i)) for i in range(STREAMS)] == [2] * STREAMS
    assert len(metrics(tmp_path / "run", "recording")) == 1
    train(config(tmp_path / "whole", record=RecordConfig()), env=DummyEnv(STREAMS))
    assert_same_weights(tmp_path / "whole", tmp_path / "run")

    def resume(steps):
        with caplog.at_level(logging.WARNING):
            train(resumed(tmp_path / "run", steps=steps, **recorded))
        assert "ended before the checkpoint and is not resumed" in caplog.text
        caplog.clear()

    resume(6 * 8 * STREAMS)
    assert len(StreamDataset("me/stream", tmp_path / "run/streams", streaming=True).segments) == 2 * STREAMS
    # Somebody has made room.
    shutil.rmtree(tmp_path / "run/streams")
    resume(8 * 8 * STREAMS)
    assert not (tmp_path / "run/streams").exists()


def test_a_recording_that_fails_in_the_flush_of_a_checkpoint_is_told_once(tmp_path, monkeypatch):
    """And not behind the place in the log from which a resumed run goes on."""
    flush, flushes = SegmentWriter.flush, []

    def fail_at_the_second(writer):
        flushes.append(writer)
        if len(flushes) == 2:
            raise RecordingError("the disk is full")
        flush(writer)

    monkeypatch.setattr(SegmentWriter, "flush", fail_at_the_second)
    train(config(tmp_path / "run", steps=16 * STREAMS))
    record = RecordConfig("me/stream", streams="all")
    train(resumed(tmp_path / "run", steps=24 * STREAMS, record=record, eval_freq=0))
    assert len(metrics(tmp_path / "run", "recording")) == 1


@pytest.mark.parametrize(
    "flags",
    [
        ["--record.root={folder}/existing"],
        # Nobody may make a folder there, not even root.
        ["--record.root=/proc/1/streams"],
        ["--record.streams=3"],
    ],
)
def test_a_recording_that_cannot_begin_stops_the_run_at_once(tmp_path, monkeypatch, flags):
    (tmp_path / "existing").mkdir()
    flags = [flag.format(folder=tmp_path) for flag in flags]
    with pytest.raises(SystemExit, match=r"^error: "):
        cronos_train(
            monkeypatch, *SMALL, *OBSERVATIONS["state"], "--record.repo_id=me/stream",
            f"--output_dir={tmp_path / 'run'}", *flags,
        )  # fmt: skip
    assert not list((tmp_path / "existing").iterdir())


def test_resuming_without_the_recording_is_told(tmp_path, monkeypatch):
    run = tmp_path / "run"
    flags = (*SMALL, *OBSERVATIONS["state"], "--record.repo_id=me/stream", f"--output_dir={run}")
    cronos_train(monkeypatch, *flags, "--steps=16")
    metrics = (run / "metrics.jsonl").read_bytes()
    shutil.rmtree(run / "streams")
    file = run / "checkpoints/last/pretrained_model/train_config.json"
    with pytest.raises(SystemExit, match=rf"^error: .*{run / 'streams'}"):
        cronos_train(monkeypatch, "--resume=true", f"--config_path={file}", "--steps=32")
    assert (run / "metrics.jsonl").read_bytes() == metrics
    assert not (run / "streams").exists()
