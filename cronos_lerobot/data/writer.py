"""Writes whole segments straight into a LeRobotDataset (v3), fast, and loadable after every flush.

`StreamRecorder` (recorder.py), the observer that a training loop calls once per step, sits on top of this.
"""

import contextlib
import queue
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Self

import numpy as np
from lerobot.datasets.utils import INFO_PATH
from lerobot.utils.constants import DEFAULT_FEATURES

from cronos_lerobot.data.origin import Origin, check_same, create_dataset, read_origin
from cronos_lerobot.data.schema import Features, frame_format
from cronos_lerobot.data.stats import DatasetStats
from cronos_lerobot.data.storage import INCOMPLETE, GrowingDataset, truncate
from cronos_lerobot.data.video import MAX_FILE_DURATION_S, VideoFile
from cronos_lerobot.dataset_metadata import brief, check_path, open_metadata
from cronos_lerobot.locks import FolderLock

FLUSH_INTERVAL_S = 20.0
"""Age of the oldest segment not on disk at which all are written [s]. A full queue takes a few seconds more to
encode, so that what ended 30 s ago is on disk."""


class RecordingError(RuntimeError):
    """The dataset can no longer be written; what was flushed before stays and loads."""


@dataclass
class _Segment:
    frames: Mapping[str, np.ndarray]
    task: str
    metadata: Mapping[str, Any]
    written: Callable[[], None] | None = None
    ended: float = field(default_factory=time.monotonic)

    @property
    def num_bytes(self) -> int:
        return sum(array.nbytes for array in self.frames.values())


@dataclass
class _Flush:
    done: threading.Event = field(default_factory=threading.Event)


class SegmentWriter:
    """Appends segments (arrays in memory) to a LeRobotDataset, one episode each.

    A thread of its own encodes, in memory, and writes. Pixels go where their feature's dtype says: `video` into
    mp4 files, `image` as PNG into the data files, which are then lossless and fast to read at random. Episodes
    share files: many in one mp4, one parquet and one episodes file per flush (or per 1000 s of video, or per
    `data_files_size_in_mb` of data). It flushes by itself when a segment has waited for `flush_interval_s`.
    """

    def __init__(
        self,
        repo_id: str,
        root: str | Path,
        features: Features,
        fps: int,
        *,
        resume: int | None = None,
        max_pending_bytes: int = 256 * 2**20,
        flush_interval_s: float = FLUSH_INTERVAL_S,
        robot_type: str | None = None,
        origin: Origin | None = None,
        may_differ: tuple[str, ...] = (),
    ) -> None:
        """Start a new dataset, or resume one.

        Args:
            repo_id: the dataset's name, "owner/name".
            root: its folder, which must not exist yet, or hold the dataset to resume.
            features: LeRobot's feature dictionary, without the bookkeeping columns (`timestamp`, ...).
            fps: frames per second, the control frequency.
            resume: how many of the first episodes to keep, -1 for all; None starts a new dataset.
            max_pending_bytes: segments waiting for the encoder; `add_segment` blocks when it is exceeded.
            flush_interval_s: the longest that a segment waits for a flush [s].
            robot_type: LeRobot's; LeRobot merges only datasets of one robot.
            origin: where it comes from; what is appended later has to be of the same.
            may_differ: flags of the origin that may be others than they were.

        Raises:
            FileExistsError: `root` exists, and nothing is to be resumed.
            FileNotFoundError: there is no dataset to resume.
            DatasetFileError: a file of its `meta/` is missing, or something leads out of its folder.
            ValueError: it has fewer episodes or other features than given, or another origin.
            OSError: `root` cannot be made, or another process writes to it (FolderInUseError).
        """
        self.root, self.features = Path(root), features
        check_path(self.root)
        if resume is not None and not (self.root / INFO_PATH).is_file():
            raise FileNotFoundError(f"no LeRobotDataset to resume in {root}")
        self._flush_interval_s, self._max_pending = flush_interval_s, max_pending_bytes
        with ExitStack() as on_failure:
            self._lock = on_failure.enter_context(FolderLock(self.root))
            if resume is None:
                self._meta = create_dataset(repo_id, self.root, fps, features, origin, robot_type)
                stats = DatasetStats(self._meta.features)
            else:
                stats = self._resume(repo_id, resume, origin, may_differ)
            on_failure.pop_all()
        meta = self._meta
        self._dataset = GrowingDataset(meta, stats, VideoFile)
        tasks = [] if meta.episodes is None else meta.episodes["tasks"]
        self.episodes_before: Counter[str] = Counter(chain.from_iterable(tasks))
        """Episodes of each task that were there when writing began."""
        self._max_frames = int(MAX_FILE_DURATION_S * meta.fps)
        self._oldest = 0.0
        self._failure: BaseException | None = None
        self._pending = 0
        self._room = threading.Condition()
        self._queue: queue.SimpleQueue[_Segment | _Flush | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="segment-writer", daemon=True)
        self._thread.start()

    @property
    def num_episodes(self) -> int:
        """Episodes on disk, as of the last flush."""
        return self._dataset.on_disk[0]

    @property
    def num_frames(self) -> int:
        """Frames on disk, as of the last flush."""
        return self._dataset.on_disk[1]

    def add_segment(
        self,
        frames: Mapping[str, np.ndarray],
        task: str,
        *,
        episode_metadata: Mapping[str, Any] | None = None,
        written: Callable[[], None] | None = None,
    ) -> None:
        """Queue one segment as the next episode. Blocks while the encoder is too far behind.

        Args:
            frames: one array (T, *shape) of the feature's dtype per feature ((T,) where the shape is (1,));
                pixels as uint8 (T, H, W, 3). They are NOT copied: leave them alone until `written` is called.
            task: the instruction.
            episode_metadata: columns for the episode's row in `meta/episodes`, the same keys every time.
            written: called in the writer's thread when it needs the arrays no longer.

        Raises:
            ValueError: a feature is missing, unknown, or of another dtype or shape.
            RecordingError: its thread has failed: the disk is full, say.
            RuntimeError: the writer is finalized.
        """
        self._check_alive()
        self._check_frames(frames)
        segment = _Segment(frames, task, dict(episode_metadata or {}), written)
        with self._room:
            self._room.wait_for(
                lambda: self._pending == 0 or self._pending + segment.num_bytes <= self._max_pending
            )
            self._pending += segment.num_bytes
        self._queue.put(segment)

    def flush(self) -> None:
        """Write everything queued. The dataset on disk then loads in LeRobotDataset, whatever follows."""
        self._check_alive()
        request = _Flush()
        self._queue.put(request)
        request.done.wait()
        self._check_alive()

    def finalize(self) -> None:
        """Flush, stop the thread, and accept no more segments. Idempotent."""
        if not self._thread.is_alive():
            self._lock.release()
            self._check_failure()
            return
        try:
            self.flush()
        finally:
            self._queue.put(None)
            self._thread.join()
            self._lock.release()
        shutil.rmtree(self.root / INCOMPLETE, ignore_errors=True)

    def __enter__(self) -> Self:
        """The writer."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Finalize, also after an exception: what was recorded until then stays."""
        self.finalize()

    def _resume(
        self, repo_id: str, num_episodes: int, origin: Origin | None, may_differ: tuple[str, ...]
    ) -> DatasetStats:
        """Drop what is not kept of the dataset; returns the statistics of what is."""
        what = f"the dataset in {self.root}"
        meta = self._meta = open_metadata(repo_id, self.root)
        if origin is not None:
            check_same(read_origin(self.root, meta.features, what), origin, what, may_differ)
        _check_features(meta.features, self.features, what)
        return truncate(meta, meta.total_episodes if num_episodes < 0 else num_episodes)

    def _check_alive(self) -> None:
        self._check_failure()
        if not self._thread.is_alive():
            raise RuntimeError(f"the writer of {self.root} is finalized")

    def _check_failure(self) -> None:
        if self._failure is not None:
            raise RecordingError(f"writing to {self.root} failed: {self._failure}") from self._failure

    def _check_frames(self, frames: Mapping[str, np.ndarray]) -> None:
        if set(frames) != set(self.features):
            raise ValueError(f"a segment has the columns {sorted(frames)}, not {sorted(self.features)}")
        length = len(next(iter(frames.values())))
        if not 1 <= length <= self._max_frames:
            raise ValueError(f"a segment needs 1 to {self._max_frames} frames, got {length}")
        for key, feature in self.features.items():
            shape, dtype = frame_format(feature)
            array = frames[key]
            if array.dtype != dtype or array.shape != (length, *shape):
                raise ValueError(f"{key} must be {dtype} {(length, *shape)}, got {array.dtype} {array.shape}")

    def _work(self) -> None:
        while (item := self._next_item()) is not None:
            try:
                if self._failure is None:
                    self._handle(item)
            except BaseException as failure:  # handed to the caller's thread by `_check_failure`
                self._failure = failure
                self._dataset.abandon()
            if isinstance(item, _Flush):
                item.done.set()
            else:
                with self._room:
                    self._pending -= item.num_bytes
                    self._room.notify_all()

    def _next_item(self) -> _Segment | _Flush | None:
        if not self._dataset.num_unpublished:
            return self._queue.get()
        remaining = self._oldest + self._flush_interval_s - time.monotonic()
        if remaining > 0:
            with contextlib.suppress(queue.Empty):
                return self._queue.get(timeout=remaining)
        return _Flush()

    def _handle(self, item: _Segment | _Flush) -> None:
        if isinstance(item, _Flush):
            self._dataset.publish()
            return
        self._dataset.append(item.frames, item.task, item.metadata)
        if self._dataset.num_unpublished == 1:
            # A writer that lags would else flush after every segment, and never catch up.
            self._oldest = max(item.ended, time.monotonic() - self._flush_interval_s / 2)
        if item.written is not None:
            item.written()


def _check_features(there: Features, ours: Features, what: str) -> None:
    """Check that what is appended has the columns of a dataset, and nothing is written elsewhere."""

    def described(features: Features, key: str) -> Any:
        feature = features.get(key)
        return feature and (feature["dtype"], tuple(feature["shape"]), feature["names"] and list(feature["names"]))

    for key in {*there, *ours} - set(DEFAULT_FEATURES):
        if described(there, key) != described(ours, key):
            had, has = brief(described(there, key)), brief(described(ours, key))
            raise ValueError(f"{what} cannot be resumed: its column {brief(key)} is {had}, not {has}")
