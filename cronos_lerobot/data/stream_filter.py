"""Writes some segments of recorded streams as an ordinary LeRobotDataset, without encoding anything again."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import DEFAULT_FEATURES
from tqdm import tqdm

from cronos_lerobot.data.origin import SEGMENTS, marked, write_origin
from cronos_lerobot.data.recorder import segment_row
from cronos_lerobot.data.schema import DECISION_COLUMNS, SEGMENT_COLUMNS, STREAM_COLUMNS, SUCCESS, TRUNCATED
from cronos_lerobot.data.stats import DatasetStats, Stats, episode_stats, to_array
from cronos_lerobot.data.storage import INCOMPLETE, Shard, stats_of_row
from cronos_lerobot.data.streams import Segment, StreamDataset
from cronos_lerobot.data.video import Clip, CopiedVideoFile, read_frames
from cronos_lerobot.dataset_metadata import check_path
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.protocol.interventions import BEFORE_SEGMENTS

SCHEMAS = ("demonstrations", "streams")
"""Columns of a filtered dataset: those of demonstrations, which LeRobot can merge with them, or of streams."""


@dataclass
class SegmentFilter:
    """Which segments to keep: those that fit everything that is given."""

    success: bool | None = None
    """Only segments in which the task was complete at any step (true), or never (false)."""
    found_complete: bool | None = None
    """Only segments whose task was complete from the start (true), or leave them out (false): nothing was done."""
    streams: list[int] | None = None
    """Only these streams."""
    tasks: list[str] | None = None
    """Only these instructions."""
    events: list[str] | None = None
    """Only segments that began after one of these: task_switch, end_effector_reset, heuristic_reset, scene_reset,
    divergence, initial."""
    helped: bool | None = None
    """Only segments in which a person or a script acted at any step (true), or leave them out (false)."""
    min_policy_version: int | None = None
    """Only segments that began with this policy update or a later one."""
    max_policy_version: int | None = None
    """Only segments that began with this policy update or an earlier one."""
    min_position: int | None = None
    """Only segments with at least this many task switches since the last scene reset."""
    max_position: int | None = None
    """Only segments with at most this many task switches since the last scene reset."""

    def __post_init__(self) -> None:
        valid = [kind.name.lower() for kind in BEFORE_SEGMENTS]
        if unknown := set(self.events or []) - set(valid):
            raise ValueError(f"--filter.events has unknown {sorted(unknown)}; valid: {valid}")

    def __call__(self, segment: Segment) -> bool:
        """Whether to keep a segment."""

        def among(value: Any, wanted: Any) -> bool:
            return wanted is None or value in wanted

        def within(value: int, low: int | None, high: int | None) -> bool:
            return (low is None or value >= low) and (high is None or value <= high)

        return (
            self.success in (None, segment.success)
            and self.found_complete in (None, segment.found_complete)
            and self.helped in (None, segment.helped)
            and among(segment.stream, self.streams)
            and among(segment.task, self.tasks)
            and among(segment.event.name.lower(), self.events)
            and within(segment.policy_version, self.min_policy_version, self.max_policy_version)
            and within(segment.position, self.min_position, self.max_position)
        )


def filter_streams(
    source: StreamDataset,
    wanted: SegmentFilter,
    repo_id: str,
    root: str | Path,
    *,
    schema: str = "demonstrations",
    frames_after_success: int | None = None,
) -> int:
    """Write the wanted segments of `source`, in the order in which they ended, as the dataset `repo_id` in `root`.

    Rows are copied and videos cut at packets, so that nothing loses quality. `root` appears when it is whole.

    Args:
        source: on this machine.
        wanted: which segments.
        repo_id: name of the new dataset.
        root: its folder, which must not exist yet.
        schema: of SCHEMAS.
        frames_after_success: cut a segment this many frames after the first in which its task was complete.

    Returns:
        Segments written.

    Raises:
        FileExistsError: `root` exists.
        FolderInUseError: another process writes it.
        ValueError: no segment is wanted, or a stream or task that is not there; or `source` is on the Hub.
    """
    root = Path(root)
    check_path(root)
    if not source.is_local:
        raise ValueError(f"{source.repo_id} is streamed from the Hub; open it with streaming=False to filter it")
    for name, given, there in (
        ("schema", [schema], SCHEMAS),
        ("filter.streams", wanted.streams, source.streams),
        ("filter.tasks", wanted.tasks, sorted({segment.task for segment in source.segments})),
    ):
        if unknown := [one for one in given or [] if one not in there]:
            raise ValueError(f"--{name} has unknown {unknown}; valid: {there}")
    segments = sorted((s for s in source.segments if wanted(s)), key=lambda s: s.episode)
    if not segments:
        raise ValueError(f"none of the {len(source.segments)} segments fits {wanted}")
    done = {
        "source": source.repo_id,
        "source_segments": len(source.segments),
        "segments": len(segments),
        "filter": asdict(wanted),
        "frames_after_success": frames_after_success,
    }
    with FolderLock(root):
        if root.exists():
            raise FileExistsError(f"{root} exists: give another --output.root")
        partial = root.with_name(f".{root.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        writer = _Writer(source, repo_id, partial, schema, done)
        for segment, rows, stats in _read(source, segments):
            writer.add(segment, rows, stats, _length(segment, frames_after_success))
        writer.close()
        os.replace(partial, root)
    return len(segments)


class _Writer:
    """Appends segments of another dataset, a shard at a time."""

    def __init__(
        self, source: StreamDataset, repo_id: str, root: Path, schema: str, done: Mapping[str, Any]
    ) -> None:
        self._source = source
        self._keeps_stream = schema == "streams"
        dropped = set(DEFAULT_FEATURES)
        dropped |= set() if self._keeps_stream else {*STREAM_COLUMNS, *DECISION_COLUMNS}
        features = {key: feature for key, feature in source.meta.features.items() if key not in dropped}
        origin = replace(source.origin, filters=[*source.origin.filters, done])
        if not self._keeps_stream:
            origin = replace(origin, kind=SEGMENTS)
        self._meta = LeRobotDatasetMetadata.create(
            repo_id, source.meta.fps, marked(features, origin), robot_type=source.meta.robot_type, root=root,
            use_videos=bool(source.meta.video_keys),
        )  # fmt: skip
        write_origin(root, origin)
        self._stats = DatasetStats(self._meta.features)
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
            stats = self._stats_of(rows, clips)
        stats = {key: stats[key] for key in self._meta.features if key in stats}
        frames = {name: to_array(rows[name]) for name in SEGMENT_COLUMNS}
        row = segment_row(frames) if self._keeps_stream else {SUCCESS: bool(frames[SUCCESS].any())}
        task_index = self._tasks.setdefault(segment.task, len(self._tasks))
        self._shard_for(clips, length).copy(rows, clips, segment.task, task_index, row, stats)

    def close(self) -> None:
        """Complete the dataset."""
        self._publish()
        shutil.rmtree(self._meta.root / INCOMPLETE)

    def _publish(self) -> None:
        if self._shard is not None:
            self._shard.publish(self._tasks)
        self._shard = None

    def _shard_for(self, clips: Mapping[str, Clip], length: int) -> Shard:
        if self._shard is not None and (
            self._shard.is_full_for(length) or not all(self._videos[key].fits(clips[key]) for key in clips)
        ):
            self._publish()
        if self._shard is None:
            self._shard = Shard(self._meta, self._num_shards, self._stats, self._open_video)
            self._num_shards += 1
        return self._shard

    def _open_video(self, key: str, path: Path) -> CopiedVideoFile:
        self._videos[key] = CopiedVideoFile(path, self._meta.fps)
        return self._videos[key]

    def _stats_of(self, rows: pa.Table, clips: Mapping[str, Clip]) -> Stats:
        frames = {name: to_array(rows[name]) for name in self._meta.features if name in rows.column_names}
        for key, clip in clips.items():
            frames[key] = read_frames(clip.path, clip.start, clip.length, self._meta.fps)
        return episode_stats(frames, self._meta.features)


def _read(source: StreamDataset, segments: Sequence[Segment]) -> Iterator[tuple[Segment, pa.Table, Stats]]:
    """The segments' rows and statistics; every file is read once."""
    root, meta = source.meta.root, source.meta
    stats_of: dict[int, Stats] = {}
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        for row in pq.read_table(path).to_pylist():
            stats = stats_of_row(row)
            stats_of[row["episode_index"]] = {k: v for k, v in stats.items() if k not in DEFAULT_FEATURES}
    files = groupby(segments, key=lambda s: meta.get_data_file_path(s.episode))
    with tqdm(total=len(segments), unit="segment", disable=None) as bar:
        for path, group in files:
            table = pq.read_table(root / path)
            first = table["index"][0].as_py()
            for segment in group:
                yield segment, table.slice(segment.start - first, segment.length), stats_of[segment.episode]
                bar.update()


def _length(segment: Segment, frames_after_success: int | None) -> int:
    if frames_after_success is None or segment.success_frame is None:
        return segment.length
    return min(segment.length, segment.success_frame + 1 + frames_after_success)


def _end_with_cut(rows: pa.Table) -> pa.Table:
    cut = np.zeros(rows.num_rows, bool)
    cut[-1] = True
    return rows.set_column(rows.schema.get_field_index(TRUNCATED), rows.schema.field(TRUNCATED), pa.array(cut))
