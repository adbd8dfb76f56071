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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

    def append(self, episode: Any, /) -> None:
        """Write the pixels of an episode."""

    def close(self) -> None:
        """Complete the file."""


class Shard:
    """One data file, one episodes file and one mp4 per video key, being written under `.incomplete`.

    Args:
        meta: of the dataset.
        index: number of the shard: 0, 1, ...
        stats: of the dataset; takes in what is written.
        open_video: takes a video key and a path.
    """

    def __init__(
        self,
        meta: LeRobotDatasetMetadata,
        index: int,
        stats: DatasetStats,
        open_video: Callable[[str, Path], VideoSink],
    ) -> None:
        chunk, file = divmod(index, meta.info.chunks_size)
        self._place = {"chunk_index": chunk, "file_index": file}
        self._meta = meta
        self._stats = stats
        self.num_frames = 0
        self.num_bytes = 0
        self.rows: list[dict[str, Any]] = []
        self._schema = get_hf_features_from_features(meta.features).arrow_schema
        self._data_path = DEFAULT_DATA_PATH.format(**self._place)
        self._episodes_path = DEFAULT_EPISODES_PATH.format(**self._place)
        self._data = pq.ParquetWriter(stage(meta.root, self._data_path), self._schema, compression="snappy")
        self.videos = {key: open_video(key, stage(meta.root, self._video_path(key))) for key in meta.video_keys}

    def is_full_for(self, length: int) -> bool:
        """Whether an episode of so many frames belongs into the next shard."""
        info = self._meta.info
        most = int(MAX_FILE_DURATION_S * info.fps)
        return self.num_frames + length > most or self.num_bytes >= info.data_files_size_in_mb * 2**20

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
        """Write one episode of another dataset that has all features of this one.

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
            field = rows.schema.field(place)
            rows = rows.set_column(place, field, pa.array(values, field.type))
        # The source's schema metadata would describe the source.
        rows = rows.select(self._schema.names).cast(self._schema).replace_schema_metadata(self._schema.metadata)
        stats = stats | {name: vector_stats(values) for name, values in columns.items()}
        self._append(rows, videos, task, metadata, stats)

    def publish(self, tasks: Mapping[str, int]) -> None:
        """Move the shard into the dataset and count it in `info.json`, which makes it part of the dataset.

        Everything is on disk before the first file moves, so that they all move within a millisecond.

        Args:
            tasks: `task_index` by instruction, of the whole dataset.
        """
        meta, info = self._meta, self._meta.info
        for key, video in self.videos.items():
            video.close()
            if not info.features[key].get("info"):
                described = get_video_info(stage(meta.root, self._video_path(key)), fast_encoder())
                info.features[key]["info"] = described
        write_tasks(tasks_frame(tasks), meta.root / INCOMPLETE)
        self._data.close()
        table = pa.Table.from_pylist(self.rows, schema=_episodes_schema(meta.root))
        pq.write_table(table, stage(meta.root, self._episodes_path))
        meta.stats = self._stats.stats()
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
        self._stats.add_rows(table)
        self._stats.add_images([stats])
        self.num_frames += table.num_rows

    def _video_path(self, key: str) -> str:
        return DEFAULT_VIDEO_PATH.format(video_key=key, **self._place)


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


def truncate(meta: LeRobotDatasetMetadata, num_episodes: int) -> DatasetStats:
    """Drop all episodes from `num_episodes` on, and every file that belongs to no episode.

    Killed half-way, the dataset still loads, and doing it again completes it.

    Args:
        meta: of the dataset on disk; its `info`, `stats` and `episodes` are brought up to date.
        num_episodes: how many of the first episodes to keep.

    Returns:
        The statistics of what is left.

    Raises:
        ValueError: the dataset has fewer episodes.
        DatasetFileError: something in its folder is a link, which may lead out of it.
    """
    root, info = meta.root, meta.info
    if num_episodes > info.total_episodes:
        raise ValueError(f"cannot keep {num_episodes} episodes of {root}: it has only {info.total_episodes}")
    if link := next((path for path in root.rglob("*") if path.is_symlink()), None):
        raise DatasetFileError(f"{link} is a symbolic link: a dataset that is resumed has none")
    files = {path: pq.read_table(path) for path in _files(root / "meta/episodes")}
    kept = {path: _first(table, num_episodes) for path, table in files.items()}
    rows = pa.concat_tables(kept.values()) if kept else pa.table({"length": []})
    info.total_episodes, info.total_frames = rows.num_rows, pc.sum(rows["length"]).as_py() or 0
    named = {folder: _places(rows, folder) for folder in ("data", *(f"videos/{key}" for key in meta.video_keys))}
    stats = _stats_of(meta, rows, [path for path in _files(root / "data") if _place(path) in named["data"]])
    meta.stats = stats.stats()
    move_into_place(root, stage_summary(meta, {} if meta.tasks is None else dict(meta.tasks["task_index"])))
    if not rows.num_rows:
        (root / STATS_PATH).unlink(missing_ok=True)
    for path, table in kept.items():
        if table.num_rows < files[path].num_rows:
            _replace_or_delete(root, path, [table])
    for folder, places in named.items():
        for path in _files(root / folder):
            if _place(path) not in places:
                path.unlink()
            elif folder == "data" and _last_episode(path) >= num_episodes:
                _replace_or_delete(root, path, (_first(group, num_episodes) for group in _row_groups(path)))
    shutil.rmtree(root / INCOMPLETE, ignore_errors=True)
    meta.episodes = load_episodes(root) if rows.num_rows else None
    return stats


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


def _place(path: Path) -> str:
    return f"{path.parent.name}/{path.stem}"


def _places(rows: pa.Table, folder: str) -> set[str]:
    """Files of a folder that rows of `meta/episodes` name, without the ending."""
    if not rows.num_rows:
        return set()
    chunks, files = (rows[f"{folder}/{name}"].to_pylist() for name in ("chunk_index", "file_index"))
    return {f"chunk-{chunk:03d}/file-{file:03d}" for chunk, file in set(zip(chunks, files, strict=True))}


def _first(table: pa.Table, num_episodes: int) -> pa.Table:
    return table.filter(pc.field("episode_index") < num_episodes)


def _last_episode(path: Path) -> int:
    return pc.max(pq.read_table(path, columns=["episode_index"])["episode_index"]).as_py()


def _row_groups(path: Path) -> Iterator[pa.Table]:
    with pq.ParquetFile(path) as file:
        for number in range(file.num_row_groups):
            yield file.read_row_group(number)


def _stats_of(meta: LeRobotDatasetMetadata, rows: pa.Table, data: Sequence[Path]) -> DatasetStats:
    """Statistics of the episodes `rows`, whose frames are in the files `data`."""
    stats = DatasetStats(meta.features)
    numbers = [key for key, feature in meta.features.items() if feature["dtype"] not in ("image", "video")]
    for path in data:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(columns=numbers):
                stats.add_rows(_first(pa.Table.from_batches([batch]), meta.info.total_episodes))
    images = tuple(f"stats/{key}/" for key in meta.features if key not in numbers)
    of_images = rows.select([name for name in rows.column_names if images and name.startswith(images)])
    stats.add_images(stats_of_row(row) for row in of_images.to_pylist())
    return stats


def _replace_or_delete(root: Path, path: Path, tables: Iterable[pa.Table]) -> None:
    """Put row groups in the place of a file, or nothing if they have no row."""
    relative, writer = str(path.relative_to(root)), None
    for table in tables:
        if table.num_rows:
            writer = writer or pq.ParquetWriter(stage(root, relative), table.schema, compression="snappy")
            writer.write_table(table)
    if writer is None:
        path.unlink()
        return
    writer.close()
    move_into_place(root, [relative])


def _episodes_schema(root: Path) -> pa.Schema | None:
    """The schema of the episodes written so far: LeRobot reads all such files as one table."""
    path = next(iter(_files(root / "meta/episodes")), None)
    return None if path is None else pq.read_schema(path)


def _to_table(columns: Mapping[str, np.ndarray], schema: pa.Schema) -> pa.Table:
    arrays = []
    for field in schema:
        values = columns[field.name]
        if pa.types.is_fixed_size_list(field.type):
            flat = pa.array(np.ascontiguousarray(values).reshape(-1), type=field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        elif pa.types.is_struct(field.type):  # the storage of datasets.Image
            arrays.append(pa.array([{"bytes": _encode_png(image)} for image in values], type=field.type))
        else:
            arrays.append(pa.array(values, type=field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _encode_png(pixels: np.ndarray) -> bytes:
    """A uint8 (H, W, 3) RGB image as the bytes of a PNG file.

    Matching runs only (`Z_RLE`) is the fastest setting of zlib on rendered frames, and after PNG's row filters
    its files are no larger than those of the default search.
    """
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return buffer.getvalue()
