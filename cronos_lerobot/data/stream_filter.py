"""Writes some segments of recorded streams as an ordinary LeRobotDataset, without encoding anything again."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import DEFAULT_FEATURES
from tqdm import tqdm

from cronos_lerobot.data.origin import write_origin
from cronos_lerobot.data.schema import (
    EXPERT,
    INTERVENTION,
    POLICY_VERSION,
    POSITION,
    SEGMENT_INDEX,
    STEP,
    STREAM_ID,
    SUCCESS,
    SUCCESS_FRAME,
    TRUNCATED,
)
from cronos_lerobot.data.stats import Stats, episode_stats
from cronos_lerobot.data.storage import INCOMPLETE, Shard, stats_of_row
from cronos_lerobot.data.streams import Segment, StreamDataset, to_array
from cronos_lerobot.data.video import MAX_FILE_DURATION_S, Clip, CopiedVideoFile, read_frames
from cronos_lerobot.dataset_metadata import check_path
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.protocol.interventions import BEFORE_SEGMENTS

PROVENANCE = "meta/filter.json"
"""What a filtered dataset was made of, and how."""


@dataclass
class SegmentFilter:
    """Which segments to keep: those that fit everything that is given. Unknown kinds are a ValueError."""

    success: bool | None = None
    """Only segments in which the task was complete at any step (true), or never (false)."""
    found_complete: bool | None = None
    """Only segments whose task was complete from the start, so that nothing had to be done (true), or leave them
    out (false)."""
    streams: list[int] | None = None
    """Only these streams."""
    tasks: list[str] | None = None
    """Only these instructions."""
    interventions: list[str] | None = None
    """Only segments that began after one of these: task_switch, end_effector_reset, heuristic_reset, scene_reset,
    divergence, initial."""
    takeover: bool | None = None
    """Only segments that an expert did (true), or leave them out (false)."""
    min_policy_version: int | None = None
    """Only segments that began with this policy update or a later one."""
    max_policy_version: int | None = None
    """Only segments that began with this policy update or an earlier one."""
    min_position: int | None = None
    """Only segments with at least so many task switches since the last scene reset."""
    max_position: int | None = None
    """Only segments with at most so many task switches since the last scene reset."""

    def __post_init__(self) -> None:
        valid = [kind.name.lower() for kind in BEFORE_SEGMENTS]
        if unknown := set(self.interventions or []) - set(valid):
            raise ValueError(f"unknown interventions {sorted(unknown)}; valid ones: {valid}")

    def __call__(self, segment: Segment) -> bool:
        """Whether to keep a segment."""

        def among(value: Any, wanted: Any) -> bool:
            return wanted is None or value in wanted

        def within(value: int, low: int | None, high: int | None) -> bool:
            return (low is None or value >= low) and (high is None or value <= high)

        return (
            self.success in (None, segment.success)
            and self.found_complete in (None, segment.found_complete)
            and self.takeover in (None, segment.taken_over)
            and among(segment.stream, self.streams)
            and among(segment.task, self.tasks)
            and among(segment.intervention.name.lower(), self.interventions)
            and within(segment.policy_version, self.min_policy_version, self.max_policy_version)
            and within(segment.position, self.min_position, self.max_position)
        )


def read_filter(root: Path) -> dict[str, Any] | None:
    """What `filter_streams` says that it made a dataset of, and how; None of one that it did not make.

    Raises:
        ValueError: the file is damaged.
    """
    path = root / PROVENANCE
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def filter_streams(
    source: StreamDataset,
    wanted: SegmentFilter,
    repo_id: str,
    root: str | Path,
    *,
    frames_after_success: int | None = None,
) -> int:
    """Write the wanted segments of `source`, in the order in which they ended, as the dataset `repo_id` in `root`.

    Rows are copied and videos cut at packets, so that nothing loses quality. `root` appears when it is whole.

    Args:
        source: on this machine.
        wanted: which segments.
        repo_id: name of the new dataset.
        root: its folder, which must not exist yet.
        frames_after_success: cut a segment so many frames after the first in which its task was complete.

    Returns:
        Segments written.

    Raises:
        FileExistsError: `root` exists.
        FolderInUseError: another process writes it.
        ValueError: no segment is wanted, or a stream or task that is not there; `source` is on the Hub; or LeRobot
            could not read what is in a folder of this path.
    """
    root = Path(root)
    check_path(root)
    _check_free(root)
    if not source.is_local:
        raise ValueError(f"{source.repo_id} is streamed from the Hub; open it with streaming=False to filter it")
    for name, given, there in (
        ("streams", wanted.streams, source.streams),
        ("tasks", wanted.tasks, sorted({segment.task for segment in source.segments})),
    ):
        if unknown := [one for one in given or [] if one not in there]:
            raise ValueError(f"unknown {name} {unknown}; {source.repo_id} has {there}")
    segments = sorted((s for s in source.segments if wanted(s)), key=lambda s: s.episode)
    if not segments:
        raise ValueError(f"none of the {len(source.segments)} segments fits {wanted}")
    with FolderLock(root):
        # Another process may have been quicker.
        _check_free(root)
        _write(source, segments, wanted, repo_id, root, frames_after_success)
    return len(segments)


def _check_free(root: Path) -> None:
    if root.exists():
        raise FileExistsError(f"{root} exists; choose another folder for the filtered dataset")


def _write(
    source: StreamDataset,
    segments: Sequence[Segment],
    wanted: SegmentFilter,
    repo_id: str,
    root: Path,
    frames_after_success: int | None,
) -> None:
    partial = root.with_name(f".{root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    writer = _Writer(source, repo_id, partial)
    bar = tqdm(total=len(segments), unit="segment", disable=None)
    for segment, rows, stats in _read(source, segments):
        writer.add(segment, rows, stats, _length(segment, frames_after_success))
        bar.update()
    bar.close()
    writer.close()
    provenance = {
        "source": source.repo_id,
        "source_segments": len(source.segments),
        "segments": len(segments),
        "filter": asdict(wanted),
        "frames_after_success": frames_after_success,
        "filter_of_source": read_filter(source.meta.root),
    }
    (partial / PROVENANCE).write_text(json.dumps(provenance, indent=2))
    write_origin(partial, source.origin)
    os.replace(partial, root)


class _Writer:
    """Appends segments of another dataset, a shard at a time."""

    def __init__(self, source: StreamDataset, repo_id: str, root: Path) -> None:
        self._source = source
        features = {key: feature for key, feature in source.meta.features.items() if key not in DEFAULT_FEATURES}
        self._meta = LeRobotDatasetMetadata.create(
            repo_id, source.meta.fps, features, robot_type=source.meta.robot_type, root=root,
            use_videos=bool(source.meta.video_keys),
        )  # fmt: skip
        self._tasks: dict[str, int] = {}
        self._shard: Shard | None = None
        self._num_shards = 0
        self._videos: dict[str, CopiedVideoFile] = {}

    def add(self, segment: Segment, rows: pa.Table, stats: Stats, length: int) -> None:
        """Write the first `length` frames of a segment, whose rows and statistics are given."""
        clips = {key: self._source.clip(segment, key) for key in self._meta.video_keys}
        if length < segment.length:
            clips = {key: Clip(clip.path, clip.start, length) for key, clip in clips.items()}
            rows = _end_with_cut(rows.slice(0, length))
            stats = self._stats(rows, clips)
        shard = self._shard_for(clips, length)
        task_index = self._tasks.setdefault(segment.task, len(self._tasks))
        shard.copy(rows, clips, segment.task, task_index, _metadata(segment), stats)

    def close(self) -> None:
        """Complete the dataset."""
        if self._shard is not None:
            self._shard.publish(self._tasks, encoder=None)
        self._shard = None
        shutil.rmtree(self._meta.root / INCOMPLETE)

    def _shard_for(self, clips: Mapping[str, Clip], length: int) -> Shard:
        info = self._meta.info
        if self._shard is not None:
            is_full = (
                self._shard.num_frames + length > MAX_FILE_DURATION_S * info.fps
                or self._shard.num_bytes >= info.data_files_size_in_mb * 2**20
            )
            if is_full or not all(self._videos[key].fits(clip) for key, clip in clips.items()):
                self._shard.publish(self._tasks, encoder=None)
                self._shard = None
        if self._shard is None:
            self._shard = Shard(self._meta, self._num_shards, self._open_video)
            self._num_shards += 1
        return self._shard

    def _open_video(self, key: str, path: Path) -> CopiedVideoFile:
        self._videos[key] = CopiedVideoFile(path, self._meta.fps)
        return self._videos[key]

    def _stats(self, rows: pa.Table, clips: Mapping[str, Clip]) -> Stats:
        frames = {name: to_array(rows[name]) for name in rows.column_names if name not in DEFAULT_FEATURES}
        for key, clip in clips.items():
            frames[key] = read_frames(clip.path, clip.start, clip.length, self._meta.fps)
        return episode_stats(frames, self._meta.features)


def _read(source: StreamDataset, segments: Iterable[Segment]) -> Iterator[tuple[Segment, pa.Table, Stats]]:
    """The segments' rows and statistics; every file is read once."""
    root, meta = source.meta.root, source.meta
    stats_of: dict[int, Stats] = {}
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        for row in pq.read_table(path).to_pylist():
            stats = stats_of_row(row)
            stats_of[row["episode_index"]] = {k: v for k, v in stats.items() if k not in DEFAULT_FEATURES}
    for path, group in groupby(segments, key=lambda s: meta.get_data_file_path(s.episode)):
        table = pq.read_table(root / path)
        first = table["index"][0].as_py()
        for segment in group:
            yield segment, table.slice(segment.start - first, segment.length), stats_of[segment.episode]


def _length(segment: Segment, frames_after_success: int | None) -> int:
    if frames_after_success is None or segment.success_frame is None:
        return segment.length
    return min(segment.length, segment.success_frame + 1 + frames_after_success)


def _end_with_cut(rows: pa.Table) -> pa.Table:
    cut = np.zeros(rows.num_rows, bool)
    cut[-1] = True
    return rows.set_column(rows.schema.get_field_index(TRUNCATED), rows.schema.field(TRUNCATED), pa.array(cut))


def _metadata(segment: Segment) -> dict[str, Any]:
    """The columns of the episode's row, as the recorder writes them."""
    return {
        STREAM_ID: segment.stream,
        SEGMENT_INDEX: segment.index,
        POSITION: segment.position,
        STEP: segment.step,
        INTERVENTION: int(segment.intervention),
        POLICY_VERSION: segment.policy_version,
        EXPERT: segment.taken_over,
        SUCCESS: segment.success,
        SUCCESS_FRAME: -1 if segment.success_frame is None else segment.success_frame,
    }
