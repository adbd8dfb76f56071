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
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.utils import INFO_PATH
from lerobot.utils.constants import DEFAULT_FEATURES

from cronos_lerobot.data.drawing import UndrawnFrames
from cronos_lerobot.data.origin import (
    STREAMS,
    Origin,
    check_same,
    marked,
    read_origin,
    with_changes,
    write_origin,
)
from cronos_lerobot.data.schema import Features, frame_format
from cronos_lerobot.data.storage import INCOMPLETE, Shard, next_shard_index, truncate
from cronos_lerobot.data.video import MAX_FILE_DURATION_S, VideoFile, fast_encoder
from cronos_lerobot.dataset_metadata import check_path, open_metadata
from cronos_lerobot.locks import FolderLock

FLUSH_INTERVAL_S = 20.0
"""Age of the oldest segment not on disk at which all are written [s]. A full queue takes a few seconds more to
encode, so that what ended 30 s ago is on disk."""

Column = np.ndarray | UndrawnFrames


class RecordingError(RuntimeError):
    """The dataset can no longer be written; what was flushed before stays and loads."""


@dataclass
class _Segment:
    frames: Mapping[str, Column]
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
        robot_type: str | None = None,
        encoder: RGBEncoderConfig | None = None,
        max_pending_bytes: int = 256 * 2**20,
        flush_interval_s: float = FLUSH_INTERVAL_S,
        origin: Origin | None = None,
    ) -> None:
        """Start a new dataset.

        Args:
            repo_id: the dataset's name, "owner/name".
            root: its folder, which must not exist yet.
            features: LeRobot's feature dictionary, without the bookkeeping columns (`timestamp`, ...).
            fps: frames per second, the control frequency.
            robot_type: for `info.json`.
            encoder: of the videos; `fast_encoder()` when None.
            max_pending_bytes: segments waiting for the encoder; `add_segment` blocks when it is exceeded.
            flush_interval_s: the longest that a segment waits for a flush [s].
            origin: where it comes from; what appends to it later has to be of the same.

        Raises:
            FileExistsError: `root` exists.
            OSError: it cannot be made, or another process writes to it.
            ValueError: LeRobot could not read what is in a folder of this path.
        """
        check_path(Path(root))
        has_video = any(feature["dtype"] == "video" for feature in features.values())
        with ExitStack() as on_failure:
            self._lock = on_failure.enter_context(FolderLock(root))
            meta = LeRobotDatasetMetadata.create(
                repo_id, fps, features if origin is None else marked(features, origin), robot_type=robot_type,
                root=Path(root), use_videos=has_video,
            )  # fmt: skip
            if origin is not None:
                write_origin(meta.root, origin)
            self._start(meta, encoder, max_pending_bytes, flush_interval_s)
            on_failure.pop_all()

    @classmethod
    def resume(
        cls,
        repo_id: str,
        root: str | Path,
        state: Mapping[str, Any] | None = None,
        *,
        encoder: RGBEncoderConfig | None = None,
        max_pending_bytes: int = 256 * 2**20,
        flush_interval_s: float = FLUSH_INTERVAL_S,
        origin: Origin | None = None,
        may_differ: tuple[str, ...] = (),
    ) -> Self:
        """Go on with the dataset in `root` as it was at `state`; what was written after it is dropped.

        Args:
            repo_id: the dataset's name.
            root: its folder.
            state: of `state_dict()`; None keeps every episode that was flushed.
            encoder: as for a new dataset; it must match, LeRobot assumes one encoding per camera.
            max_pending_bytes: as for a new dataset.
            flush_interval_s: as for a new dataset.
            origin: of what is to be appended.
            may_differ: flags of the origin that may be others than they were.

        Raises:
            FileNotFoundError: there is no dataset in `root`.
            DatasetFileError: a file of its `meta/` is missing.
            ValueError: the dataset holds fewer episodes than `state`, or is of another origin.
            FolderInUseError: another process writes to it.
        """
        if not (Path(root) / INFO_PATH).is_file():
            raise FileNotFoundError(f"no LeRobotDataset to resume in {root}")
        writer = cls.__new__(cls)
        with ExitStack() as on_failure:
            writer._lock = on_failure.enter_context(FolderLock(root))
            meta = open_metadata(repo_id, Path(root))
            if origin is not None:
                there = read_origin(meta.root, meta.features, f"the dataset in {root}")
                check_same(there, origin, f"the dataset in {root}", may_differ)
            truncate(meta, meta.info.total_episodes if state is None else state["num_episodes"])
            if origin is not None and origin.kind == STREAMS:
                write_origin(meta.root, with_changes(there, origin, meta.info.total_episodes))
            writer._start(meta, encoder, max_pending_bytes, flush_interval_s)
            on_failure.pop_all()
        return writer

    @property
    def root(self) -> Path:
        """The dataset's folder."""
        return self._meta.root

    @property
    def num_episodes(self) -> int:
        """Episodes on disk, as of the last flush."""
        return self._on_disk[0]

    @property
    def num_frames(self) -> int:
        """Frames on disk, as of the last flush."""
        return self._on_disk[1]

    def add_segment(
        self,
        frames: Mapping[str, Column],
        task: str,
        *,
        episode_metadata: Mapping[str, Any] | None = None,
        written: Callable[[], None] | None = None,
    ) -> None:
        """Queue one segment as the next episode. Blocks while the encoder is too far behind.

        Args:
            frames: one array (T, *shape) of the feature's dtype per feature ((T,) where the shape is (1,));
                pixels as uint8 (T, H, W, 3) or still to be drawn. They are NOT copied: leave them alone
                until `written` is called.
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
        metadata = dict(episode_metadata or {})
        if self._metadata_keys is None:
            self._metadata_keys = set(metadata)
        if set(metadata) != self._metadata_keys:
            raise ValueError(
                f"episode_metadata has the keys {sorted(metadata)}, not {sorted(self._metadata_keys)}"
            )
        segment = _Segment(frames, task, metadata, written)
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

    def state_dict(self) -> dict[str, Any]:
        """What `resume` needs to come back to the last flush."""
        return {"num_episodes": self.num_episodes}

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

    def _start(
        self,
        meta: LeRobotDatasetMetadata,
        encoder: RGBEncoderConfig | None,
        max_pending: int,
        flush_interval_s: float,
    ) -> None:
        if flush_interval_s <= 0:
            raise ValueError(f"flush_interval_s must be more than 0 s, got {flush_interval_s}")
        self._meta = meta
        self._encoder = encoder or fast_encoder()
        self._max_pending = max_pending
        self._flush_interval_s = flush_interval_s
        self.features: Features = {
            key: feature for key, feature in meta.features.items() if key not in DEFAULT_FEATURES
        }
        self._tasks: dict[str, int] = {} if meta.tasks is None else dict(meta.tasks["task_index"])
        self._metadata_keys: set[str] | None = None
        self._max_shard_frames = int(MAX_FILE_DURATION_S * meta.fps)
        self._shard: Shard | None = None
        self._canvas: dict[str, np.ndarray] = {}
        self._oldest = 0.0
        self._on_disk = meta.info.total_episodes, meta.info.total_frames
        tasks = [] if meta.episodes is None else meta.episodes["tasks"]
        self.episodes_before: Counter[str] = Counter(chain.from_iterable(tasks))
        """Episodes of each task that were there when writing began."""
        self._next_shard = next_shard_index(meta)
        self._failure: BaseException | None = None
        self._pending = 0
        self._room = threading.Condition()
        self._queue: queue.SimpleQueue[_Segment | _Flush | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="segment-writer", daemon=True)
        self._thread.start()

    def _check_alive(self) -> None:
        self._check_failure()
        if not self._thread.is_alive():
            raise RuntimeError(f"the writer of {self.root} is finalized")

    def _check_failure(self) -> None:
        if self._failure is not None:
            raise RecordingError(f"writing to {self.root} failed: {self._failure}") from self._failure

    def _check_frames(self, frames: Mapping[str, Column]) -> None:
        if set(frames) != set(self.features):
            missing, unknown = set(self.features) - set(frames), set(frames) - set(self.features)
            raise ValueError(f"segment lacks {sorted(missing)} and has unknown {sorted(unknown)}")
        length = len(next(iter(frames.values())))
        if not 1 <= length <= self._max_shard_frames:
            raise ValueError(f"a segment needs 1 to {self._max_shard_frames} frames, got {length}")
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
                self._fail(failure)
            if isinstance(item, _Flush):
                item.done.set()
            else:
                with self._room:
                    self._pending -= item.num_bytes
                    self._room.notify_all()

    def _next_item(self) -> _Segment | _Flush | None:
        if self._shard is None:
            return self._queue.get()
        remaining = self._oldest + self._flush_interval_s - time.monotonic()
        if remaining > 0:
            with contextlib.suppress(queue.Empty):
                return self._queue.get(timeout=remaining)
        return _Flush()

    def _fail(self, failure: BaseException) -> None:
        """Give up, and what was being written with it: on a full disk others may need the room."""
        self._failure = failure
        shard, self._shard = self._shard, None
        if shard is not None:
            shard.abandon()
        shutil.rmtree(self.root / INCOMPLETE, ignore_errors=True)

    def _handle(self, item: _Segment | _Flush) -> None:
        if isinstance(item, _Flush):
            self._publish()
            return
        length = len(next(iter(item.frames.values())))
        max_bytes = self._meta.info.data_files_size_in_mb * 2**20
        if self._shard is not None and (
            self._shard.num_frames + length > self._max_shard_frames or self._shard.num_bytes >= max_bytes
        ):
            self._publish()
        if self._shard is None:
            self._shard = Shard(self._meta, self._next_shard, self._open_video)
            # A writer that lags would else flush after every segment, and never catch up.
            self._oldest = max(item.ended, time.monotonic() - self._flush_interval_s / 2)
            self._next_shard += 1
        task_index = self._tasks.setdefault(item.task, len(self._tasks))
        self._shard.append(self._draw(item.frames), item.task, task_index, item.metadata)
        if item.written is not None:
            item.written()

    def _draw(self, frames: Mapping[str, Column]) -> dict[str, np.ndarray]:
        drawn = {}
        for key, array in frames.items():
            if isinstance(array, UndrawnFrames):
                # Kept from segment to segment: to take this much memory anew costs more than to fill it.
                if key not in self._canvas or len(self._canvas[key]) < len(array):
                    self._canvas[key] = np.empty(array.shape, array.dtype)
                array = array.draw(self._canvas[key])
            drawn[key] = array
        return drawn

    def _publish(self) -> None:
        if self._shard is not None:
            self._shard.publish(self._tasks, self._encoder)
            self._shard = None
            self._on_disk = self._meta.info.total_episodes, self._meta.info.total_frames

    def _open_video(self, key: str, path: Path) -> VideoFile:
        height, width, _ = self._meta.features[key]["shape"]
        return VideoFile(path, self._meta.fps, height, width, self._encoder)
