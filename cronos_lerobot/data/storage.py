"""The files of a LeRobotDataset (v3), a *shard* at a time: one data, one episodes and one mp4 file each.

Pixels of the dtype `image` have no file of their own: they are PNG inside the data file, as in LeRobot.

A shard is written under `<root>/.incomplete`, in the tree it will have, and moved into place when it is whole,
`info.json` last. A process killed at any moment leaves a dataset that loads: LeRobot takes the number of episodes
from `info.json` and looks up everything else from there.
"""

import contextlib
import io
import os
import re
import shutil
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_episodes, write_info, write_stats, write_tasks
from lerobot.datasets.utils import (
    DEFAULT_DATA_PATH,
    DEFAULT_EPISODES_PATH,
    DEFAULT_TASKS_PATH,
    DEFAULT_VIDEO_PATH,
    EPISODES_DIR,
    INFO_PATH,
    STATS_PATH,
)
from lerobot.datasets.video_utils import get_video_info
from lerobot.utils.utils import flatten_dict, unflatten_dict
from PIL import Image

from cronos_lerobot.data.stats import DatasetStats, Stats, episode_stats, vector_stats
from cronos_lerobot.data.video import MAX_FILE_DURATION_S, fast_encoder
from cronos_lerobot.dataset_metadata import DatasetFileError

INCOMPLETE = ".incomplete"
PLACE = re.compile(r"chunk-\d{3,}/file-\d{3,}\.(parquet|mp4)")
"""How the files of data, videos and episodes are called; others are never deleted."""


class VideoSink(Protocol):
    """An mp4 being written, one episode after the other."""

    num_frames: int

    def fits(self, episode: Any, /) -> bool:
        """Whether the file can take the pixels of an episode."""

    def append(self, episode: Any, /) -> None:
        """Write the pixels of an episode."""

    def close(self) -> None:
        """Complete the file."""


@dataclass
class _Shard:
    """The files that are being written."""

    place: dict[str, int]
    data: pq.ParquetWriter
    videos: dict[str, VideoSink]
    num_frames: int = 0
    num_bytes: int = 0
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Of `meta/episodes`."""


class GrowingDataset:
    """A dataset that grows by episodes, and on disk by shards.

    Args:
        meta: of the dataset on disk.
        stats: of what it holds already.
        open_video: takes a path, frames per second, and the height and width of a picture [px].
    """

    def __init__(
        self,
        meta: LeRobotDatasetMetadata,
        stats: DatasetStats,
        open_video: Callable[[Path, int, int, int], VideoSink],
    ) -> None:
        self._meta, self._stats, self._open_video = meta, stats, open_video
        self._schema = get_hf_features_from_features(meta.features).arrow_schema
        self._tasks: dict[str, int] = {} if meta.tasks is None else dict(meta.tasks["task_index"])
        self._shard: _Shard | None = None
        self._next_shard = next_shard_index(meta)
        self._num_episodes, self._num_frames = meta.info.total_episodes, meta.info.total_frames
        self.on_disk = self._num_episodes, self._num_frames
        """Episodes and frames, as of the last `publish`."""

    @property
    def num_unpublished(self) -> int:
        """Episodes that are not on disk."""
        return self._num_episodes - self.on_disk[0]

    def append(self, frames: Mapping[str, np.ndarray], task: str, metadata: Mapping[str, Any]) -> None:
        """Write one episode.

        Args:
            frames: arrays (T, ...) by feature, without LeRobot's own index columns.
            task: the instruction.
            metadata: columns for the episode's row in `meta/episodes`.
        """
        length = len(next(iter(frames.values())))
        shard = self._shard_for(length, frames)
        columns = {**frames, **self._bookkeeping(length, task)}
        stats = episode_stats(columns, self._meta.features)
        self._add(shard, _to_table(columns, self._schema), frames, task, metadata, stats)

    def copy(
        self, rows: pa.Table, videos: Mapping[str, Any], task: str, metadata: Mapping[str, Any], stats: Stats
    ) -> None:
        """Write one episode of another dataset that has all features of this one.

        Args:
            rows: its rows of the data file, from its first frame on; its indices are replaced.
            videos: by video key, what the sinks take.
            task: the instruction.
            metadata: columns for the episode's row in `meta/episodes`.
            stats: of all its columns but the indices.
        """
        shard = self._shard_for(rows.num_rows, videos)
        columns = self._bookkeeping(rows.num_rows, task)
        for name, values in columns.items():
            place = rows.schema.get_field_index(name)
            kind = rows.schema.field(place)
            rows = rows.set_column(place, kind, pa.array(values, kind.type))
        # The source's schema metadata would describe the source.
        rows = rows.select(self._schema.names).cast(self._schema).replace_schema_metadata(self._schema.metadata)
        stats = stats | {name: vector_stats(values) for name, values in columns.items()}
        self._add(shard, rows, videos, task, metadata, stats)

    def publish(self) -> None:
        """Move the shard into the dataset and count it in `info.json`, which makes it part of the dataset.

        Everything is on disk before the first file moves, so that they all move within a millisecond.
        """
        meta, info, shard = self._meta, self._meta.info, self._shard
        if shard is None:
            return
        videos = {key: DEFAULT_VIDEO_PATH.format(video_key=key, **shard.place) for key in shard.videos}
        for key, video in shard.videos.items():
            video.close()
            if not info.features[key].get("info"):
                info.features[key]["info"] = get_video_info(stage(meta.root, videos[key]), fast_encoder())
        tasks = pd.DataFrame({"task_index": list(self._tasks.values())}, pd.Index(list(self._tasks), name="task"))
        write_tasks(tasks, meta.root / INCOMPLETE)
        shard.data.close()
        data, episodes = (path.format(**shard.place) for path in (DEFAULT_DATA_PATH, DEFAULT_EPISODES_PATH))
        # LeRobot reads all files of episodes as one table.
        written = next(iter(_files(meta.root / EPISODES_DIR)), None)
        table = pa.Table.from_pylist(shard.rows, None if written is None else pq.read_schema(written))
        pq.write_table(table, stage(meta.root, episodes))
        meta.stats = self._stats.stats()
        info.total_episodes, info.total_frames = self._num_episodes, self._num_frames
        summary = _stage_summary(meta, len(self._tasks))
        _move_into_place(meta.root, [*videos.values(), DEFAULT_TASKS_PATH, data, episodes, *summary])
        self._shard = None
        self.on_disk = self._num_episodes, self._num_frames

    def abandon(self) -> None:
        """Close the files after a failure, whatever is in them, and delete them: others may need the room."""
        for file in (self._shard.data, *self._shard.videos.values()) if self._shard is not None else ():
            with contextlib.suppress(Exception):
                file.close()
        self._shard = None
        self._num_episodes, self._num_frames = self.on_disk
        shutil.rmtree(self._meta.root / INCOMPLETE, ignore_errors=True)

    def _bookkeeping(self, length: int, task: str) -> dict[str, np.ndarray]:
        """LeRobot's own columns of the next episode."""
        frame_index = np.arange(length)
        return {
            "timestamp": (frame_index / self._meta.fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(length, self._num_episodes),
            "index": self._num_frames + frame_index,
            "task_index": np.full(length, self._tasks.setdefault(task, len(self._tasks))),
        }

    def _add(
        self,
        shard: _Shard,
        table: pa.Table,
        videos: Mapping[str, Any],
        task: str,
        metadata: Mapping[str, Any],
        stats: Stats,
    ) -> None:
        length, fps = table.num_rows, self._meta.fps
        # One row group per episode, as LeRobot's own writer does, for readers that want single episodes.
        shard.data.write_table(table)
        row: dict[str, Any] = {
            "episode_index": self._num_episodes,
            "tasks": [task],
            "length": length,
            **{f"data/{key}": value for key, value in shard.place.items()},
            "dataset_from_index": self._num_frames,
            "dataset_to_index": self._num_frames + length,
        }
        for key, video in shard.videos.items():
            row |= {f"videos/{key}/{name}": value for name, value in shard.place.items()}
            row[f"videos/{key}/from_timestamp"] = video.num_frames / fps
            video.append(videos[key])
            row[f"videos/{key}/to_timestamp"] = video.num_frames / fps
        row |= metadata
        row |= {key: value.tolist() for key, value in flatten_dict({"stats": stats}).items()}
        shard.rows.append(row | {f"meta/episodes/{key}": value for key, value in shard.place.items()})
        self._stats.add_rows(table)
        self._stats.add_images([stats])
        shard.num_bytes += table.nbytes
        shard.num_frames += length
        self._num_episodes += 1
        self._num_frames += length

    def _shard_for(self, length: int, videos: Mapping[str, Any]) -> _Shard:
        """The shard that an episode belongs into; what is full is published."""
        meta, shard = self._meta, self._shard
        if shard is not None and (
            shard.num_frames + length > int(MAX_FILE_DURATION_S * meta.fps)
            or shard.num_bytes >= meta.info.data_files_size_in_mb * 2**20
            or not all(video.fits(videos[key]) for key, video in shard.videos.items())
        ):
            self.publish()
        if self._shard is None:
            chunk, file = divmod(self._next_shard, meta.info.chunks_size)
            place = {"chunk_index": chunk, "file_index": file}
            data = stage(meta.root, DEFAULT_DATA_PATH.format(**place))
            opened = {}
            for key in meta.video_keys:
                path = stage(meta.root, DEFAULT_VIDEO_PATH.format(video_key=key, **place))
                opened[key] = self._open_video(path, meta.fps, *meta.features[key]["shape"][:2])
            self._shard = _Shard(place, pq.ParquetWriter(data, self._schema, compression="snappy"), opened)
            self._next_shard += 1
        return self._shard


def stage(root: Path, relative: str) -> Path:
    """Where a file is written before it is moved into place; its folder is made."""
    path = root / INCOMPLETE / relative
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _move_into_place(root: Path, staged: Sequence[str]) -> None:
    """Put staged files at `<root>/<relative>`, in this order, each in one step and with its content on disk."""
    for relative in staged:
        (root / relative).parent.mkdir(parents=True, exist_ok=True)
        with open(root / INCOMPLETE / relative, "rb") as file:
            os.fsync(file.fileno())
    for relative in staged:
        os.replace(root / INCOMPLETE / relative, root / relative)


def _stage_summary(meta: LeRobotDatasetMetadata, num_tasks: int) -> list[str]:
    """Stage `stats.json` and `info.json` with its totals; returns them in the order to move them."""
    meta.info.total_tasks = num_tasks
    meta.info.splits = {"train": f"0:{meta.info.total_episodes}"}
    stage(meta.root, INFO_PATH)
    write_info(meta.info, meta.root / INCOMPLETE)
    if not meta.stats:
        return [INFO_PATH]
    write_stats(meta.stats, meta.root / INCOMPLETE)
    return [STATS_PATH, INFO_PATH]


def truncate(meta: LeRobotDatasetMetadata, num_episodes: int) -> DatasetStats:
    """Drop the shards from episode `num_episodes` on, and every file that belongs to no episode.

    Killed half-way, the dataset still loads, and doing it again completes it.

    Args:
        meta: of the dataset on disk; its `info`, `stats` and `episodes` are brought up to date.
        num_episodes: how many of the first episodes to keep, as many as there were after some `publish`.

    Returns:
        The statistics of what is left.

    Raises:
        ValueError: the dataset has fewer episodes, or a file has some to keep and some to drop.
        DatasetFileError: something in its folder is a link, which may lead out of it.
    """
    root, info = meta.root, meta.info
    if num_episodes > info.total_episodes:
        raise ValueError(f"cannot keep {num_episodes} episodes of {root}: it has only {info.total_episodes}")
    if link := next((path for path in root.rglob("*") if path.is_symlink()), None):
        raise DatasetFileError(f"{link} is a symbolic link: a dataset that is resumed has none")
    tables = {path: pq.read_table(path) for path in _files(root / EPISODES_DIR)}
    rows = pa.concat_tables(tables.values() or [_NO_ROWS])
    is_kept = pc.field("episode_index") < num_episodes
    kept, dropped = rows.filter(is_kept), rows.filter(~is_kept)
    named = {
        folder: _named(root, folder, kept) for folder in ("data", *(f"videos/{key}" for key in meta.video_keys))
    }
    named[EPISODES_DIR] = {path for path, table in tables.items() if table.filter(is_kept).num_rows}
    if both := next((path for folder in named for path in named[folder] & _named(root, folder, dropped)), None):
        raise ValueError(f"cannot keep {num_episodes} episodes of {root}: {both} holds more than these")
    info.total_episodes, info.total_frames = kept.num_rows, pc.sum(kept["length"]).as_py() or 0
    stats = _stats_of(meta, kept, sorted(named["data"]))
    meta.stats = stats.stats()
    _move_into_place(root, _stage_summary(meta, 0 if meta.tasks is None else len(meta.tasks)))
    if not kept.num_rows:
        (root / STATS_PATH).unlink(missing_ok=True)
    for folder, files in named.items():
        for path in set(_files(root / folder)) - files:
            path.unlink()
    shutil.rmtree(root / INCOMPLETE, ignore_errors=True)
    meta.episodes = load_episodes(root) if kept.num_rows else None
    return stats


_NO_ROWS = pa.table({"episode_index": pa.array([], pa.int64()), "length": pa.array([], pa.int64())})


def next_shard_index(meta: LeRobotDatasetMetadata) -> int:
    """The first shard number that no file of the dataset uses."""
    numbers = [
        (int(path.parent.name.split("-")[1]), int(path.stem.split("-")[1])) for path in _files(meta.root / "data")
    ]
    return max((chunk * meta.info.chunks_size + file + 1 for chunk, file in numbers), default=0)


def stats_of_row(row: Mapping[str, Any]) -> Stats:
    """The statistics in a row of `meta/episodes`."""
    flat = {key: np.array(value) for key, value in row.items() if key.startswith("stats/")}
    return unflatten_dict(flat)["stats"] if flat else {}


def _files(folder: Path) -> list[Path]:
    """Files of a folder of data, videos or episodes that are named as LeRobot names them, in their order."""
    return sorted(path for path in folder.glob("*/*") if PLACE.fullmatch(f"{path.parent.name}/{path.name}"))


def _named(root: Path, folder: str, rows: pa.Table) -> set[Path]:
    """Files of a folder that rows of `meta/episodes` name."""
    if not rows.num_rows:
        return set()
    chunks, files = (rows[f"{folder}/{name}"].to_pylist() for name in ("chunk_index", "file_index"))
    ending = "mp4" if folder.startswith("videos/") else "parquet"
    return {
        root / folder / f"chunk-{chunk:03d}/file-{file:03d}.{ending}"
        for chunk, file in set(zip(chunks, files, strict=True))
    }


def _stats_of(meta: LeRobotDatasetMetadata, rows: pa.Table, data: Sequence[Path]) -> DatasetStats:
    """Statistics of the episodes `rows`, whose frames are in the files `data`."""
    stats = DatasetStats(meta.features)
    numbers = [key for key, feature in meta.features.items() if feature["dtype"] not in ("image", "video")]
    for path in data:
        stats.add_rows(pq.read_table(path, columns=numbers))
    images = tuple(f"stats/{key}/" for key in meta.features if key not in numbers)
    of_images = rows.select([name for name in rows.column_names if images and name.startswith(images)])
    stats.add_images(stats_of_row(row) for row in of_images.to_pylist())
    return stats


def _to_table(columns: Mapping[str, np.ndarray], schema: pa.Schema) -> pa.Table:
    arrays = []
    for column in schema:
        values = columns[column.name]
        if pa.types.is_fixed_size_list(column.type):
            flat = pa.array(np.ascontiguousarray(values).reshape(-1), type=column.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=column.type))
        elif pa.types.is_struct(column.type):  # the storage of datasets.Image
            arrays.append(pa.array([{"bytes": _encode_png(image)} for image in values], type=column.type))
        else:
            arrays.append(pa.array(values, type=column.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _encode_png(pixels: np.ndarray) -> bytes:
    """A uint8 (H, W, 3) RGB image as the bytes of a PNG file.

    Matching runs only (`Z_RLE`) is the fastest setting of zlib on rendered frames, and after PNG's row filters
    its files are no larger than those of the default search.
    """
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return buffer.getvalue()
