"""The files of a LeRobotDataset (v3), a *shard* at a time: one data, one episodes and one mp4 file each.

Pixels of the dtype `image` have no file of their own: they are PNG inside the data file, as LeRobot does it.

A shard is written under `<root>/.incomplete`, in the tree it will have, and moved into place when it is
whole, `info.json` last. A process killed at any moment leaves a dataset that loads: LeRobot takes the number
of episodes from `info.json` and looks up everything else from there.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import (
    load_episodes,
    write_info,
    write_stats,
    write_table_one_row_group_per_episode,
    write_tasks,
)
from lerobot.datasets.utils import (
    DEFAULT_DATA_PATH,
    DEFAULT_EPISODES_PATH,
    DEFAULT_TASKS_PATH,
    DEFAULT_VIDEO_PATH,
    INFO_PATH,
    STATS_PATH,
)
from lerobot.datasets.video_utils import get_video_info
from lerobot.utils.utils import flatten_dict, unflatten_dict

from cronos_lerobot.data.png import encode_png
from cronos_lerobot.data.stats import Stats, episode_stats, vector_stats

INCOMPLETE = ".incomplete"


class VideoSink(Protocol):
    """An mp4 being written, one episode after the other."""

    num_frames: int

    def append(self, episode: Any, /) -> None:
        """Write the pixels of an episode."""

    def close(self) -> None:
        """Complete the file."""


class Shard:
    """One data file, one episodes file and one mp4 per video key, being written under `.incomplete`."""

    def __init__(
        self, meta: LeRobotDatasetMetadata, index: int, open_video: Callable[[str, Path], VideoSink]
    ) -> None:
        """Start shard `index` (0, 1, ...) of the dataset `meta`; `open_video` takes a video key and a path."""
        chunk, file = divmod(index, meta.info.chunks_size)
        self._place = {"chunk_index": chunk, "file_index": file}
        self._meta = meta
        self._staging = meta.root / INCOMPLETE
        self.num_frames = 0
        self.num_bytes = 0
        self.rows: list[dict[str, Any]] = []
        self.stats: list[Stats] = []
        self._schema = get_hf_features_from_features(meta.features).arrow_schema
        self._data = pq.ParquetWriter(self._stage(self._data_path), self._schema, compression="snappy")
        self.videos = {key: open_video(key, self._stage(self._video_path(key))) for key in meta.video_keys}

    @property
    def _data_path(self) -> str:
        return DEFAULT_DATA_PATH.format(**self._place)

    @property
    def _episodes_path(self) -> str:
        return DEFAULT_EPISODES_PATH.format(**self._place)

    def append(
        self, frames: Mapping[str, np.ndarray], task: str, task_index: int, metadata: Mapping[str, Any]
    ) -> None:
        """Write one episode: arrays (T, ...) by feature, without LeRobot's own index columns."""
        columns = {**frames, **self._bookkeeping(len(next(iter(frames.values()))), task_index)}
        table = _to_table(columns, self._schema)
        stats = episode_stats(columns, self._meta.features)
        self._append(table, {key: frames[key] for key in self.videos}, task, metadata, stats)

    def copy(
        self,
        rows: pa.Table,
        videos: Mapping[str, Any],
        task: str,
        task_index: int,
        metadata: Mapping[str, Any],
        stats: Stats,
    ) -> None:
        """Write one episode of another dataset with the same features.

        Args:
            rows: its rows of the data file, from its first frame on; its indices are replaced.
            videos: by video key, what the sinks of this shard take.
            task: the instruction.
            task_index: its index in this dataset.
            metadata: columns for the episode's row in `meta/episodes`.
            stats: of all its columns but the indices.
        """
        columns = self._bookkeeping(rows.num_rows, task_index)
        for name, values in columns.items():
            place = rows.schema.get_field_index(name)
            rows = rows.set_column(
                place, rows.schema.field(place), pa.array(values, rows.schema.field(place).type)
            )
        # The source's schema metadata would describe the source.
        rows = rows.select(self._schema.names).cast(self._schema).replace_schema_metadata(self._schema.metadata)
        stats = stats | {name: vector_stats(values) for name, values in columns.items()}
        self._append(rows, videos, task, metadata, stats)

    def publish(self, tasks: Mapping[str, int], encoder: RGBEncoderConfig | None) -> None:
        """Move the shard into the dataset and count it in `info.json`, which makes it part of the dataset.

        Everything is on disk before the first file moves, so that they all move within a millisecond.

        Args:
            tasks: `task_index` by instruction, of the whole dataset.
            encoder: of the videos, for `info.json`; None where it describes them already.
        """
        meta, info = self._meta, self._meta.info
        for key, video in self.videos.items():
            video.close()
            if info.total_episodes == 0 and encoder is not None:
                # As LeRobot's `update_video_info` does with a file that is in place.
                described = get_video_info(self._stage(self._video_path(key)), encoder)
                info.features[key]["info"] = (info.features[key].get("info") or {}) | described
        write_tasks(tasks_frame(tasks), self._staging)
        self._data.close()
        table = pa.Table.from_pylist(self.rows, schema=_episodes_schema(meta.root))
        pq.write_table(table, self._stage(self._episodes_path))
        meta.stats = aggregate_stats([*([meta.stats] if meta.stats else []), *self.stats])
        info.total_episodes += len(self.rows)
        info.total_frames += self.num_frames
        videos = [self._video_path(key) for key in self.videos]
        staged = [*videos, DEFAULT_TASKS_PATH, self._data_path, self._episodes_path, *stage_summary(meta, tasks)]
        move_into_place(meta.root, staged)

    def abandon(self) -> None:
        """Close the files after a failure, whatever is in them."""
        for file in (self._data, *self.videos.values()):
            with contextlib.suppress(Exception):
                file.close()

    def _bookkeeping(self, length: int, task_index: int) -> dict[str, np.ndarray]:
        """LeRobot's own columns of the next episode."""
        frame_index = np.arange(length)
        return {
            "timestamp": (frame_index / self._meta.fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(length, self._meta.info.total_episodes + len(self.rows)),
            "index": self._meta.info.total_frames + self.num_frames + frame_index,
            "task_index": np.full(length, task_index),
        }

    def _append(
        self, table: pa.Table, videos: Mapping[str, Any], task: str, metadata: Mapping[str, Any], stats: Stats
    ) -> None:
        # One row group per episode, as LeRobot's own writer does, for readers that want single episodes.
        self._data.write_table(table)
        self.num_bytes += table.nbytes
        start, fps = self._meta.info.total_frames + self.num_frames, self._meta.fps
        row: dict[str, Any] = {
            "episode_index": self._meta.info.total_episodes + len(self.rows),
            "tasks": [task],
            "length": table.num_rows,
            **{f"data/{key}": value for key, value in self._place.items()},
            "dataset_from_index": start,
            "dataset_to_index": start + table.num_rows,
        }
        for key, video in self.videos.items():
            row |= {f"videos/{key}/{name}": value for name, value in self._place.items()}
            row[f"videos/{key}/from_timestamp"] = video.num_frames / fps
            video.append(videos[key])
            row[f"videos/{key}/to_timestamp"] = video.num_frames / fps
        row |= metadata
        row |= {key: value.tolist() for key, value in flatten_dict({"stats": stats}).items()}
        row |= {f"meta/episodes/{key}": value for key, value in self._place.items()}
        self.rows.append(row)
        self.stats.append(stats)
        self.num_frames += table.num_rows

    def _video_path(self, key: str) -> str:
        return DEFAULT_VIDEO_PATH.format(video_key=key, **self._place)

    def _stage(self, relative: str) -> Path:
        return stage(self._meta.root, relative)


def stage(root: Path, relative: str) -> Path:
    """Where a file is written before `move_into_place`; its folder is made."""
    path = root / INCOMPLETE / relative
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def move_into_place(root: Path, staged: Sequence[str]) -> None:
    """Put staged files at `<root>/<relative>`, in this order, each in one step and with its content on disk."""
    for relative in staged:
        (root / relative).parent.mkdir(parents=True, exist_ok=True)
        with open(root / INCOMPLETE / relative, "rb") as file:
            os.fsync(file.fileno())
    for relative in staged:
        os.replace(root / INCOMPLETE / relative, root / relative)


def stage_summary(meta: LeRobotDatasetMetadata, tasks: Mapping[str, int]) -> list[str]:
    """Stage `stats.json` and `info.json` with its totals; returns them in the order to move them."""
    info = meta.info
    info.total_tasks = len(tasks)
    info.splits = {"train": f"0:{info.total_episodes}"}
    staged = [INFO_PATH]
    if meta.stats:
        stage(meta.root, STATS_PATH)
        write_stats(meta.stats, meta.root / INCOMPLETE)
        staged.insert(0, STATS_PATH)
    stage(meta.root, INFO_PATH)
    write_info(info, meta.root / INCOMPLETE)
    return staged


def tasks_frame(tasks: Mapping[str, int]) -> pd.DataFrame:
    """LeRobot's tasks table: `task_index` by instruction."""
    return pd.DataFrame({"task_index": list(tasks.values())}, index=pd.Index(list(tasks), name="task"))


def truncate(meta: LeRobotDatasetMetadata, num_episodes: int) -> None:
    """Drop all episodes from `num_episodes` on, and every file that belongs to no episode.

    Killed half-way, the dataset still loads, and doing it again completes it.

    Args:
        meta: of the dataset on disk; its `info`, `stats` and `episodes` are brought up to date.
        num_episodes: how many of the first episodes to keep.

    Raises:
        ValueError: the dataset has fewer episodes.
    """
    root, info = meta.root, meta.info
    if num_episodes > info.total_episodes:
        raise ValueError(f"cannot keep {num_episodes} episodes of {root}: it has only {info.total_episodes}")
    files = {path: pq.read_table(path) for path in sorted(root.glob("meta/episodes/*/*.parquet"))}
    kept = {path: table.filter(pc.field("episode_index") < num_episodes) for path, table in files.items()}
    rows = [row for table in kept.values() for row in table.to_pylist()]
    info.total_episodes = len(rows)
    info.total_frames = sum(row["length"] for row in rows)
    meta.stats = aggregate_stats([stats_of_row(row) for row in rows]) if rows else None
    move_into_place(root, stage_summary(meta, {} if meta.tasks is None else dict(meta.tasks["task_index"])))
    if not rows:
        (root / STATS_PATH).unlink(missing_ok=True)

    for path, table in kept.items():
        if table.num_rows < files[path].num_rows:
            _replace_or_delete(root, path, table, pq.write_table)
    data_files = {DEFAULT_DATA_PATH.format(**_place(row, "data")) for row in rows}
    for path in root.glob("data/*/*.parquet"):
        if str(path.relative_to(root)) not in data_files:
            path.unlink()
        elif pq.read_table(path, columns=["episode_index"])["episode_index"][-1].as_py() >= num_episodes:
            table = pq.read_table(path, filters=[("episode_index", "<", num_episodes)])
            _replace_or_delete(root, path, table, write_table_one_row_group_per_episode)
    for key in meta.video_keys:
        videos = {DEFAULT_VIDEO_PATH.format(video_key=key, **_place(row, f"videos/{key}")) for row in rows}
        for path in (root / "videos" / key).glob("*/*.mp4"):
            if str(path.relative_to(root)) not in videos:
                path.unlink()
    shutil.rmtree(root / INCOMPLETE, ignore_errors=True)
    meta.episodes = load_episodes(root) if rows else None


def next_shard_index(meta: LeRobotDatasetMetadata) -> int:
    """The first shard number that no file of the dataset uses."""
    paths: Iterable[Path] = meta.root.glob("data/*/*.parquet")
    numbers = [(int(path.parent.name.split("-")[1]), int(path.stem.split("-")[1])) for path in paths]
    return max((chunk * meta.info.chunks_size + file + 1 for chunk, file in numbers), default=0)


def _replace_or_delete(root: Path, path: Path, table: pa.Table, write: Callable[[pa.Table, Path], None]) -> None:
    if table.num_rows == 0:
        path.unlink()
        return
    relative = str(path.relative_to(root))
    write(table, stage(root, relative))
    move_into_place(root, [relative])


def _place(row: Mapping[str, Any], prefix: str) -> dict[str, int]:
    return {name: row[f"{prefix}/{name}"] for name in ("chunk_index", "file_index")}


def stats_of_row(row: Mapping[str, Any]) -> Stats:
    """The statistics in a row of `meta/episodes`."""
    flat = {key: np.array(value) for key, value in row.items() if key.startswith("stats/")}
    return unflatten_dict(flat)["stats"]


def _episodes_schema(root: Path) -> pa.Schema | None:
    """The schema of the episodes written so far: LeRobot reads all such files as one table."""
    path = next(iter(sorted(root.glob("meta/episodes/*/*.parquet"))), None)
    return None if path is None else pq.read_schema(path)


def _to_table(columns: Mapping[str, np.ndarray], schema: pa.Schema) -> pa.Table:
    arrays = []
    for field in schema:
        values = columns[field.name]
        if pa.types.is_fixed_size_list(field.type):
            flat = pa.array(np.ascontiguousarray(values).reshape(-1), type=field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        elif pa.types.is_struct(field.type):  # the storage of datasets.Image
            arrays.append(pa.array([{"bytes": encode_png(image)} for image in values], type=field.type))
        else:
            arrays.append(pa.array(values, type=field.type))
    return pa.Table.from_arrays(arrays, schema=schema)
