"""A recording that is killed at random moments loses nothing that was flushed, and resumes as if unbroken."""

import json
import multiprocessing
import os
import pickle
import random
import shutil
import time
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset
from synthetic_segments import FPS, observation_space, world
from synthetic_streams import ORIGIN, STREAMS, K, record, step

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.whole_files import written_whole

FLUSH_INTERVAL_S, SLACK_S = 0.1, 3.0
SAVE_EVERY, KILLS, MAX_STEPS = 50, 4, 10**6
CAMERA = "observation.images.front"


def record_on(folder: Path, steps: int) -> None:
    """Record from the last checkpoint on, if there is one, with a journal of the segments that have ended."""
    checkpoint, start, state = folder / "checkpoint", 0, None
    if checkpoint.exists():
        start, state = pickle.loads(checkpoint.read_bytes())
    else:
        shutil.rmtree(folder / "d", ignore_errors=True)
    writer = SegmentWriter(
        "me/stream", folder / "d", stream_features(world(observation_space(environment_state=None))), FPS,
        resume=None if state is None else state["num_episodes"], origin=ORIGIN,
        flush_interval_s=FLUSH_INTERVAL_S,
    )  # fmt: skip
    recorder = StreamRecorder(writer, num_envs=STREAMS, segment_length=K)
    if state is not None:
        recorder.load_partial_segments(state)
    journal, add_segment = os.open(folder / "journal", os.O_WRONLY | os.O_CREAT | os.O_APPEND), writer.add_segment

    def noted(frames, task, **options):
        segment = int(frames["cronos.stream_id"][0]), int(frames["cronos.segment_index"][0])
        os.write(journal, json.dumps([segment, time.monotonic()]).encode() + b"\n")
        add_segment(frames, task, **options)

    writer.add_segment = noted
    for t in range(start, steps):
        step(recorder, t)
        time.sleep(0.002)
        if t % SAVE_EVERY == SAVE_EVERY - 1:
            state = recorder.state_dict()
            with written_whole(checkpoint, "wb") as file:
                pickle.dump((t + 1, state), file)
    recorder.close()


PROCESSES = multiprocessing.get_context("forkserver")


def begin(folder: Path, steps: int):
    """A process that records. The imports take seconds: a server does them once and forks."""
    PROCESSES.set_forkserver_preload(["cronos_lerobot.data.recorder", "cronos_lerobot.data.streams"])
    process = PROCESSES.Process(target=record_on, args=(folder, steps))
    process.start()
    return process


def read_journal(folder: Path) -> list:
    # The last line may be half there.
    whole = (folder / "journal").read_text().rpartition("\n")[0] if (folder / "journal").exists() else ""
    return [json.loads(line) for line in whole.splitlines()]


def check(folder: Path, killed_at: float, started_at: float) -> int:
    """Check what a kill has left; returns how many segments that had ended were not on disk."""
    root, found = folder / "d", set()
    if (root / "meta/info.json").exists() and json.loads((root / "meta/info.json").read_text())["total_episodes"]:
        streams = StreamDataset("me/stream", root, streaming=True)
        streams.check(is_finished=False)
        assert streams.pixels(streams.segments_of(0)[-1], CAMERA).std() > 10
        found = {(segment.stream, segment.index) for segment in streams.segments}
    if (folder / "checkpoint").exists():
        _, state = pickle.loads((folder / "checkpoint").read_bytes())
        assert len(found) >= state["num_episodes"], "a checkpoint counts on more than is on disk"
    ended = {tuple(segment): at for segment, at in read_journal(folder)}
    assert found <= ended.keys()
    lost = [killed_at - at for segment, at in ended.items() if segment not in found and at >= started_at]
    assert max(lost, default=0) < FLUSH_INTERVAL_S + SLACK_S
    return len(lost)


def test_kills_at_random_moments(tmp_path):
    rng, lost = random.Random(0), 0
    for kill in range(KILLS):
        started_at, before = time.monotonic(), len(read_journal(tmp_path))
        process = begin(tmp_path, MAX_STEPS)
        # One kill comes while the process starts, the others at any moment after its first segment.
        while kill != 2 and len(read_journal(tmp_path)) == before:
            assert process.exitcode is None
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.25))
        process.kill()
        killed_at = time.monotonic()
        process.join()
        lost += check(tmp_path, killed_at, started_at)
    assert lost, "no kill came before a flush"
    steps = (max(index for (_, index), _ in read_journal(tmp_path)) + 2) * K
    process = begin(tmp_path, steps)
    process.join()
    assert process.exitcode == 0
    record(tmp_path / "unbroken", steps=steps)
    # TorchCodec keeps decoders by path, also of files that are no longer there.
    options = {"video_backend": "pyav"}
    broken, unbroken = (LeRobotDataset("me/s", root=tmp_path / name, **options) for name in ("d", "unbroken"))
    rows = [dataset.hf_dataset.with_format("numpy")[:] for dataset in (broken, unbroken)]
    for name in rows[1]:
        np.testing.assert_array_equal(rows[0][name], rows[1][name], err_msg=name)
    for name, stats in unbroken.meta.stats["observation.state"].items():
        np.testing.assert_array_equal(broken.meta.stats["observation.state"][name], stats, err_msg=name)
    for index in range(0, len(unbroken), 1 + len(unbroken) // 10):
        assert (broken[index][CAMERA] - unbroken[index][CAMERA]).abs().mean() < 0.01
