"""Kills recording training runs at random moments, and checks after each kill that no data is lost or torn.

    python -m cronos_lerobot.studies.kill_test --kills 20 --seed 0

A small `cronos-train` run from pixels records all its streams, and one of them filmed. Its process gets SIGKILL
at a random moment, the start-up included. Then both datasets must load in a plain LeRobotDataset and hold each
segment that was complete by the last flush, once and whole. The run is resumed from its last checkpoint, and so
on. In the end the recordings must be those of a run that was never killed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, cast

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.utils import INFO_PATH

from cronos_lerobot.data.schema import SEGMENT_INDEX, STREAM_ID
from cronos_lerobot.data.storage import INCOMPLETE
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.writer import SegmentWriter

REPO_ID = "local/streams"
FLUSH_INTERVAL_S = 0.5
SLACK_S = 3.0
"""Time that encoding and writing may take after the flush is due, on a busy machine [s]."""
STREAMS, SEGMENT, UPDATE = 4, 8, 16
RECORDINGS = ("streams", "streams_96x64")

Key = tuple[int, int]
"""Stream and number of a segment."""


class KillTestError(AssertionError):
    """A recording lost, tore or doubled something."""


@dataclass
class Tally:
    """What came of the kills; counts are over both recordings."""

    kills: int = 0
    amid_startup: int = 0
    """Kills before the process had recorded anything: while it loaded or brought the recordings back in line."""
    amid_writing: int = 0
    """Kills that left an unfinished file behind."""
    segments_checked: int = 0
    """Segments found on disk after a kill, over all kills."""
    segments_dropped: int = 0
    """Segments that had ended but not been flushed; the resumed run records them again."""
    oldest_dropped_s: float = 0.0
    """Age of the oldest of those at the kill [s]; flushes are due every FLUSH_INTERVAL_S."""


def train_config(folder: Path, steps: int) -> Any:
    """The run: four streams of 64 x 64 pixels, segments of 8 steps, a tiny policy."""
    from lerobot.policies import make_policy_config
    from lerobot_env_cronos import CronosEnvConfig

    from cronos_lerobot.agents.ppo.config import PPOConfig
    from cronos_lerobot.protocol.config import ProtocolConfig
    from cronos_lerobot.training.config import CronosTrainConfig
    from cronos_lerobot.training.record_config import RecordConfig

    return CronosTrainConfig(
        env=CronosEnvConfig(observation_height=64, observation_width=64, render_size=(64, 96), num_threads=1),
        policy=make_policy_config("pocketvla", device="cpu", push_to_hub=False, hidden_width=16, hidden_depth=1),
        output_dir=folder / "run",
        steps=steps,
        num_envs=STREAMS,
        protocol=ProtocolConfig(
            task_switch_interval=SEGMENT, update_interval=UPDATE, scene_reset_interval=4 * SEGMENT
        ),
        algorithm=PPOConfig(minibatch_size=32, value_warmup_updates=0),
        record=RecordConfig(REPO_ID, streams="all", filmed_streams=1, flush_interval_s=FLUSH_INTERVAL_S),
        eval_freq=0,
        save_freq=2 * STREAMS * UPDATE,
        keep_checkpoints=2,
        tensorboard=False,
    )


def train_until_killed(folder: Path, steps: int) -> None:
    """Train and record in this process, from the last checkpoint if there is one, with a journal of what ended."""
    from lerobot.utils.import_utils import register_third_party_plugins

    from cronos_lerobot.scripts.train import train

    _write_to(folder / "run.log")
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    register_third_party_plugins()
    keep_journal(folder / "journal.jsonl")
    config = train_config(folder, steps)
    last = folder / "run/checkpoints/last"
    if last.exists():
        config.resume, config.checkpoint_path = True, last.resolve()
    else:
        # Killed before its first checkpoint: it begins anew.
        shutil.rmtree(folder / "run", ignore_errors=True)
    train(config)


def keep_journal(path: Path) -> None:
    """Have every SegmentWriter of this process note, before it does anything, which segment has ended."""
    journal = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    add_segment = SegmentWriter.add_segment

    def noted(self: SegmentWriter, frames: Any, task: str, **options: Any) -> None:
        key = [int(frames[STREAM_ID][0]), int(frames[SEGMENT_INDEX][0])]
        line = {"recording": self.root.name, "segment": key, "time": time.monotonic()}
        os.write(journal, json.dumps(line).encode() + b"\n")
        add_segment(self, frames, task, **options)

    SegmentWriter.add_segment = noted


def read_segments(root: Path, known: Collection[str] = ()) -> dict[Key, str]:
    """What plain LeRobot finds in a recording: a hash of the numbers of each segment.

    Args:
        root: of the recording.
        known: hashes of segments whose pictures were decoded before.

    Raises:
        KillTestError: a segment is torn or there twice, or a stream has a gap.
    """
    if not (root / INFO_PATH).is_file() or not json.loads((root / INFO_PATH).read_text())["total_episodes"]:
        return {}
    # TorchCodec's decoders are kept by path in this process; a resumed run puts other videos there.
    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    try:
        StreamDataset(REPO_ID, root, streaming=True).check(is_finished=False)
    except ValueError as error:
        raise KillTestError(f"{root}: {error}") from error
    columns = dataset.hf_dataset.with_format("numpy")[: len(dataset)]
    pixels = dataset.meta.video_keys[0]
    segments: dict[Key, str] = {}
    assert dataset.meta.episodes is not None
    for episode in range(dataset.num_episodes):
        row = dataset.meta.episodes[episode]
        first, last = row["dataset_from_index"], row["dataset_to_index"] - 1
        # Everything but the place in the dataset.
        parts = [columns[key][first : last + 1].tobytes() for key in sorted(columns) if key not in _PLACES]
        digest = hashlib.sha256(b"".join(parts)).hexdigest()
        for index in () if digest in known else (first, last):
            item = cast(dict[str, torch.Tensor], dataset[index])
            if item[pixels].std() < 0.01:
                raise KillTestError(f"{root}: frame {index} has no picture")
        segments[row[STREAM_ID], row[SEGMENT_INDEX]] = digest
    if len(segments) != dataset.num_episodes:
        raise KillTestError(f"{root}: {dataset.num_episodes} episodes, but {len(segments)} different segments")
    return segments


_PLACES = {"index", "episode_index"}


class KillTest:
    """One run that is killed again and again.

    Args:
        folder: of the run, new.
        seed: of the moments.
        report: called with a line after each kill.
    """

    def __init__(self, folder: Path, seed: int, report: Callable[[str], None] = print) -> None:
        self.folder = folder
        self.tally = Tally()
        self._random = random.Random(seed)
        self._report = report
        self._seen: dict[tuple[str, Key], set[str]] = {}
        # Imports cost seconds: a server does them once and forks.
        self._processes = multiprocessing.get_context("forkserver")
        plugins = [d.name for d in distributions() if d.name.startswith("lerobot_policy_")]
        self._processes.set_forkserver_preload([__name__, "cronos_lerobot.scripts.train", *plugins])

    def run(self, kills: int) -> Tally:
        """Kill, check and resume, then compare with a run that was never killed.

        The first kill comes when there is a checkpoint, the second when a segment has ended that is not flushed,
        which may take more than one, the others at random moments.

        Raises:
            KillTestError: a recording lost, tore or doubled something.
        """
        # The first process waits for the server's imports.
        warm_up = self._processes.Process(target=time.sleep, args=(0,))
        warm_up.start()
        warm_up.join()
        start = self._time_to_checkpoint()
        if kills > 1:
            self._kill_unflushed()
        while self.tally.kills < kills:
            self._kill_after(self._random.uniform(0.0, 1.5) * start)
            self._check()
        # A whole number of updates beyond what any of its lives has seen.
        furthest = max((line["segment"][1] for line in self._journal()), default=0)
        per_update = UPDATE // SEGMENT
        steps = (furthest // per_update + 2) * STREAMS * UPDATE
        self._finish(self.folder, steps)
        self._finish(self.folder / "unbroken", steps)
        self._compare()
        return self.tally

    def _start(self, folder: Path, steps: int) -> Any:
        folder.mkdir(parents=True, exist_ok=True)
        process = self._processes.Process(target=train_until_killed, args=(folder, steps))
        self._started_at = time.monotonic()
        process.start()
        return process

    def _time_to_checkpoint(self) -> float:
        """Start the run and kill it once it has a checkpoint; how long that took [s]."""
        process, start = self._start(self.folder, 10**9), time.monotonic()
        while not (self.folder / "run/checkpoints/last").exists():
            if process.exitcode is not None:
                raise RuntimeError(f"the run ended by itself: {self.folder / 'run.log'}")
            time.sleep(0.01)
        self._kill(process)
        self._check()
        return self._killed_at - start

    def _kill_unflushed(self) -> None:
        """Resume the run and kill it as soon as a segment has ended, until a kill has come before the flush."""
        dropped = self.tally.segments_dropped
        while self.tally.segments_dropped == dropped:
            process = self._start(self.folder, 10**9)
            while not any(line["time"] >= self._started_at for line in self._journal()):
                if process.exitcode is not None:
                    raise RuntimeError(f"the run ended by itself: {self.folder / 'run.log'}")
                time.sleep(0.01)
            self._kill(process)
            self._check()

    def _kill_after(self, seconds: float) -> None:
        process = self._start(self.folder, 10**9)
        process.join(seconds)
        if process.exitcode is not None:
            raise RuntimeError(f"the run ended by itself: {self.folder / 'run.log'}")
        self._kill(process)

    def _kill(self, process: Any) -> None:
        process.kill()
        self._killed_at = time.monotonic()
        process.join()
        self.tally.kills += 1

    def _finish(self, folder: Path, steps: int) -> None:
        process = self._start(folder, steps)
        process.join()
        if process.exitcode:
            raise RuntimeError(f"the run failed: {folder / 'run.log'}")

    def _journal(self) -> list[dict[str, Any]]:
        path = self.folder / "journal.jsonl"
        # The last line may be half there.
        whole = path.read_text().rpartition("\n")[0] if path.is_file() else ""
        return [json.loads(line) for line in whole.splitlines()]

    def _check(self) -> None:
        """Check both recordings as the kill left them."""
        journal, lines, is_unfinished = self._journal(), [], False
        for name in RECORDINGS:
            root = self.folder / "run" / name
            known = set().union(*self._seen.values())
            found = read_segments(root, known)
            for key, digest in found.items():
                self._seen.setdefault((name, key), set()).add(digest)
            ended = {tuple(line["segment"]): line["time"] for line in journal if line["recording"] == name}
            if invented := set(found) - set(ended):
                raise KillTestError(f"{root}: {sorted(invented)} are on disk but never ended")
            # Of earlier processes: dropped because their checkpoint came before, recorded again later.
            dropped = {
                key: self._killed_at - at
                for key, at in ended.items()
                if key not in found and at >= self._started_at
            }
            oldest = max(dropped.values(), default=0.0)
            if oldest > FLUSH_INTERVAL_S + SLACK_S:
                raise KillTestError(f"{root}: lost segments up to {oldest:.1f} s old: {sorted(dropped)}")
            self._check_checkpoint(name, len(found))
            self.tally.segments_checked += len(found)
            self.tally.segments_dropped += len(dropped)
            self.tally.oldest_dropped_s = max(self.tally.oldest_dropped_s, oldest)
            is_unfinished |= any(path.is_file() for path in (root / INCOMPLETE).rglob("*"))
            lines.append(f"{len(found)} segments, {len(dropped)} not flushed")
        self.tally.amid_writing += is_unfinished
        self.tally.amid_startup += not any(line["time"] >= self._started_at for line in journal)
        self._report(
            f"kill {self.tally.kills} after {self._killed_at - self._started_at:.2f} s: {'; '.join(lines)}"
        )

    def _check_checkpoint(self, name: str, found: int) -> None:
        """What a checkpoint counts on was flushed before it was written."""
        path = self.folder / "run/checkpoints/last/training_state/observers.pt"
        if path.is_file():
            state = torch.load(path)["recorder"]["streams" if name == "streams" else "film"]
            if found < state["writer"]["num_episodes"]:
                raise KillTestError(f"{name}: {found} segments, the last checkpoint counts on more: {state}")

    def _compare(self) -> None:
        """Compare the recordings, and all that any kill left, with the run that was never killed."""
        for name in RECORDINGS:
            broken, unbroken = (read_segments(f / "run" / name) for f in (self.folder, self.folder / "unbroken"))
            if broken != unbroken:
                differing = [key for key in unbroken if broken.get(key) != unbroken[key]]
                raise KillTestError(f"{name}: not what an unbroken run records: {differing or set(broken)}")
            for (recording, key), digests in self._seen.items():
                if recording == name and digests != {unbroken[key]}:
                    raise KillTestError(f"{name}: segment {key} was not always what an unbroken run records")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _write_to(log: Path) -> None:
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)


def main() -> None:
    """Run the test and print its tally."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        tally = KillTest(Path(folder) / "killed", args.seed).run(args.kills)
    for name, value in asdict(tally).items():
        print(f"{name:24s} {value:.2f}" if isinstance(value, float) else f"{name:24s} {value}")
    print(
        f"nothing lost, torn or doubled; the recordings equal an unbroken run's ({time.monotonic() - start:.0f} s)"
    )


if __name__ == "__main__":
    from cronos_lerobot.studies import kill_test

    # Else every process that is started would run this module once more, with a warning.
    __spec__ = None
    kill_test.main()
