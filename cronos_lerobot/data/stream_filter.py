"""Writes some segments of recorded streams as an ordinary LeRobotDataset, without encoding anything again."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import DEFAULT_FEATURES, REWARD
from tqdm import tqdm

from cronos_lerobot.data.origin import SEGMENTS, create_dataset
from cronos_lerobot.data.recorder import segment_row
from cronos_lerobot.data.schema import (
    DECISION_COLUMNS,
    SEGMENT_COLUMNS,
    STREAM_COLUMNS,
    STREAM_ID,
    SUCCESS,
    TRUNCATED,
)
from cronos_lerobot.data.stats import DatasetStats, Stats, episode_stats, to_array
from cronos_lerobot.data.storage import INCOMPLETE, GrowingDataset, stats_of_row
from cronos_lerobot.data.streams import Segment, StreamDataset
from cronos_lerobot.data.video import CopiedVideoFile, read_frames
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
    success_as_reward: bool = False,
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
        success_as_reward: write rewards of 1 where a frame's pictures show the task complete and 0 elsewhere, as
            LeRobot's reward classifier learns them.

    Returns:
        Segments written.

    Raises:
        FileExistsError: `root` exists.
        FolderInUseError: another process writes it.
        ValueError: no segment is wanted, or a stream or task that is not there; or `source` is on the Hub; or a
            stream, whose rewards are as they were paid, is to have others.
    """
    root = Path(root)
    check_path(root)
    if success_as_reward and schema == "streams":
        raise ValueError("--success_as_reward=true needs --schema=demonstrations, got --schema=streams")
    segments = _wanted_segments(source, wanted)
    done = {
        "source": source.repo_id,
        "source_segments": len(source.segments),
        "segments": len(segments),
        "filter": asdict(wanted),
        "frames_after_success": frames_after_success,
        "success_as_reward": success_as_reward,
    }
    origin = replace(source.origin, filters=[*source.origin.filters, done])
    dropped = set(DEFAULT_FEATURES)
    if schema != "streams":
        origin, dropped = replace(origin, kind=SEGMENTS), dropped | {*STREAM_COLUMNS, *DECISION_COLUMNS}
    features = {key: feature for key, feature in source.meta.features.items() if key not in dropped}
    with FolderLock(root):
        if root.exists():
            raise FileExistsError(f"{root} exists: give another --output.root")
        partial = root.with_name(f".{root.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        meta = create_dataset(repo_id, partial, source.meta.fps, features, origin, source.meta.robot_type)
        dataset = GrowingDataset(meta, DatasetStats(meta.features), CopiedVideoFile)
        for segment, rows, stats in _read(source, segments):
            if success_as_reward:
                rows, stats = _reward_success(rows, stats, meta)
            _copy(source, segment, rows, stats, meta, dataset, frames_after_success)
        dataset.publish()
        shutil.rmtree(partial / INCOMPLETE)
        os.replace(partial, root)
    return len(segments)


def _wanted_segments(source: StreamDataset, wanted: SegmentFilter) -> list[Segment]:
    if not source.is_local:
        raise ValueError(f"{source.repo_id} is streamed from the Hub; open it with streaming=False to filter it")
    for name, given, there in (
        ("filter.streams", wanted.streams, source.streams),
        ("filter.tasks", wanted.tasks, sorted({segment.task for segment in source.segments})),
    ):
        if unknown := [one for one in given or [] if one not in there]:
            raise ValueError(f"--{name} has unknown {unknown}; valid: {there}")
    segments = sorted((s for s in source.segments if wanted(s)), key=lambda s: s.episode)
    if not segments:
        raise ValueError(f"none of the {len(source.segments)} segments fits {wanted}")
    return segments


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


def _copy(
    source: StreamDataset,
    segment: Segment,
    rows: pa.Table,
    stats: Stats,
    meta: LeRobotDatasetMetadata,
    dataset: GrowingDataset,
    frames_after_success: int | None,
) -> None:
    """Copy a segment, or what there is of it until some frames after its success."""
    length = segment.length
    if frames_after_success is not None and segment.success_frame is not None:
        length = min(length, segment.success_frame + 1 + frames_after_success)
    clips = {key: replace(source.clip(segment, key), length=length) for key in meta.video_keys}
    if length < segment.length:
        rows = _end_with_cut(rows.slice(0, length))
        columns = {name: to_array(rows[name]) for name in meta.features if name in rows.column_names}
        for key, clip in clips.items():
            columns[key] = read_frames(clip.path, clip.start, length, meta.fps)
        stats = episode_stats(columns, meta.features)
    stats = {key: stats[key] for key in meta.features if key in stats}
    row = segment_row({name: to_array(rows[name]) for name in SEGMENT_COLUMNS})
    if STREAM_ID not in meta.features:
        row = {SUCCESS: row[SUCCESS]}
    dataset.copy(rows, clips, segment.task, row, stats)


def _reward_success(rows: pa.Table, stats: Stats, meta: LeRobotDatasetMetadata) -> tuple[pa.Table, Stats]:
    """`next.success` is of the moment after a frame's action, its pictures are of the moment before."""
    after = to_array(rows[SUCCESS])
    # Found complete: no task can be done in one step.
    seen = np.concatenate([after[:1], after[:-1]]).astype(np.float32)
    place = rows.schema.get_field_index(REWARD)
    rows = rows.set_column(place, rows.schema.field(REWARD), pa.array(seen))
    return rows, stats | episode_stats({REWARD: seen}, {REWARD: meta.features[REWARD]})


def _end_with_cut(rows: pa.Table) -> pa.Table:
    cut = np.zeros(rows.num_rows, bool)
    cut[-1] = True
    return rows.set_column(rows.schema.get_field_index(TRUNCATED), rows.schema.field(TRUNCATED), pa.array(cut))
