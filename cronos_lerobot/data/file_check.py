"""Reads the files of a LeRobotDataset and says which one is not what `meta/` promises."""

from __future__ import annotations

import json
from collections import Counter
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.utils import INFO_PATH
from lerobot.utils.constants import ACTION, DONE, REWARD
from lerobot_env_cronos import get_scene
from lerobot_env_cronos.scene.scenes import CONTROL_HZ
from lerobot_env_cronos.simulation.simulation import ACTION_NAMES
from PIL import Image, UnidentifiedImageError
from tqdm import tqdm

from cronos_lerobot.data.demos import CONFIGURATION
from cronos_lerobot.data.origin import DEMONSTRATIONS, Origin, read_origin
from cronos_lerobot.data.schema import (
    INTERVENTION,
    POLICY_VERSION,
    POSITION,
    SEGMENT_INDEX,
    STEP,
    STREAM_COLUMNS,
    STREAM_ID,
    SUCCESS,
    SUCCESS_FRAME,
    TRUNCATED,
)
from cronos_lerobot.dataset_metadata import DatasetFileError, check_meta_is_there

EPISODE_COLUMNS = {
    True: (CONFIGURATION, SUCCESS),
    False: (STREAM_ID, SEGMENT_INDEX, POSITION, STEP, INTERVENTION, POLICY_VERSION, SUCCESS, SUCCESS_FRAME),
}
"""What the rows of `meta/episodes` have besides LeRobot's columns: of demonstrations, of streams."""


def check_dataset(root: Path) -> Origin:
    """Check that a dataset in a folder is ours and whole, by reading it.

    Every data file is read, of every mp4 all packets are counted and the first and the last frame decoded; of
    pictures in data files the first and the last.

    Returns:
        Where it comes from.

    Raises:
        DatasetFileError: names the file or the column.
        ValueError: another version of the environment made it, or none, or another of LeRobot.
    """
    if not (root / INFO_PATH).is_file():
        raise DatasetFileError(f"{root / INFO_PATH} is missing")
    check_meta_is_there(root, f"the dataset in {root}")
    rows = read_rows(root)
    try:
        meta = LeRobotDatasetMetadata("local/dataset", root=root)
    except (KeyError, TypeError, json.JSONDecodeError, pa.ArrowInvalid) as error:
        raise DatasetFileError(f"{root}/meta cannot be read: {error}") from error
    if not meta.total_episodes:
        raise DatasetFileError(f"the dataset in {root} has no episode yet")
    origin = read_origin(root, meta.features, f"the dataset in {root}")
    check_columns(meta, origin)
    rows = [row for row in rows if row["episode_index"] < meta.total_episodes]
    counted = len(rows), sum(row["length"] for row in rows)
    if counted != (meta.total_episodes, meta.total_frames):
        raise DatasetFileError(
            f"meta/episodes has {counted[0]} episodes and {counted[1]} frames, info.json counts"
            f" {meta.total_episodes} and {meta.total_frames}"
        )
    _check_tasks(meta, origin)
    data: dict[str, Counter] = {}
    videos: dict[tuple[str, str], int] = {}
    for row in rows:
        path = str(meta.get_data_file_path(row["episode_index"]))
        data.setdefault(path, Counter())[row["episode_index"]] = row["length"]
        for key in meta.video_keys:
            file = key, str(meta.get_video_file_path(row["episode_index"], key))
            videos[file] = max(videos.get(file, 0), round(row[f"videos/{key}/to_timestamp"] * meta.fps))
    with tqdm(total=len(data) + len(videos), unit="file", desc="reading the dataset", disable=None) as bar:
        for path, lengths in data.items():
            _check_data(root, path, lengths, meta)
            bar.update()
        for (key, path), frames in videos.items():
            _check_video(root, path, frames, meta.features[key]["shape"], meta.fps)
            bar.update()
    return origin


def check_columns(meta: LeRobotDatasetMetadata, origin: Origin) -> None:
    """Check that a dataset has the columns that its kind promises, of this robot.

    Raises:
        DatasetFileError: names what it lacks or has otherwise.
    """
    is_demonstration = origin.kind == DEMONSTRATIONS
    promised = [ACTION, REWARD, SUCCESS, DONE, TRUNCATED, *(() if is_demonstration else STREAM_COLUMNS)]
    if lost := [name for name in promised if name not in meta.features]:
        raise DatasetFileError(f"the dataset has lost columns of {origin.kind}: {lost}")
    if not any(name.startswith("observation.") for name in meta.features):
        raise DatasetFileError("the dataset has no observation")
    action = meta.features[ACTION]
    if list(action["names"] or []) != list(ACTION_NAMES):
        raise DatasetFileError(f"the actions are {action['names']}, those of the WidowX are {list(ACTION_NAMES)}")
    if meta.fps != CONTROL_HZ:
        raise DatasetFileError(
            f"the dataset has {meta.fps} frames per second, the control frequency is {CONTROL_HZ}"
        )
    assert meta.episodes is not None
    stored = meta.episodes.column_names
    if lost := [name for name in EPISODE_COLUMNS[is_demonstration] if name not in stored]:
        raise DatasetFileError(
            f"meta/episodes has lost the columns {lost}, as LeRobot's editing tools leave it: publish the dataset"
            " as it was recorded, or as cronos-streams filter writes it"
        )


def _check_tasks(meta: LeRobotDatasetMetadata, origin: Origin) -> None:
    scene = get_scene(origin.scene)
    known = {task.instruction for task in (*scene.tasks, *scene.reset_tasks)}
    if unknown := sorted(set(meta.tasks.index if meta.tasks is not None else []) - known):
        raise DatasetFileError(f"the dataset has tasks that {scene.name} has not: {unknown}")


def read_rows(root: Path) -> list[dict[str, Any]]:
    """Read what `meta/episodes` says of each episode, without statistics, file by file.

    Raises:
        DatasetFileError: names the file that is damaged.
    """
    rows = []
    for path in sorted(root.glob("meta/episodes/*/*.parquet")):
        try:
            table = pq.read_table(path)
        except (pa.ArrowInvalid, OSError) as error:
            raise DatasetFileError(f"{path.relative_to(root)} is damaged: {error}") from error
        rows += table.drop_columns([name for name in table.column_names if name.startswith("stats/")]).to_pylist()
    return rows


def _check_data(root: Path, relative: str, lengths: Counter, meta: LeRobotDatasetMetadata) -> None:
    try:
        table = pq.read_table(root / relative)
    except FileNotFoundError:
        raise DatasetFileError(f"{relative} is missing") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise DatasetFileError(f"{relative} is damaged: {error}") from error
    stored = [name for name in meta.features if meta.features[name]["dtype"] != "video"]
    if lost := [name for name in stored if name not in table.column_names]:
        raise DatasetFileError(f"{relative} lacks the columns {lost}, which info.json promises")
    found = Counter(table["episode_index"].to_pylist())
    # A killed recording may have left rows behind that it had not counted yet.
    wrong = [episode for episode, length in lengths.items() if found[episode] != length]
    if wrong:
        raise DatasetFileError(
            f"{relative} has {found[wrong[0]]} frames of episode {wrong[0]}, meta/episodes has {lengths[wrong[0]]}"
        )
    for key in meta.image_keys:
        for row in (0, table.num_rows - 1):
            try:
                picture = Image.open(BytesIO(table[key][row].as_py()["bytes"]))
                picture.load()
            except (UnidentifiedImageError, OSError, TypeError) as error:
                raise DatasetFileError(f"{relative}, row {row}: the picture {key} is damaged: {error}") from error


def _check_video(root: Path, relative: str, frames: int, shape: tuple[int, ...], fps: int) -> None:
    if not (root / relative).is_file():
        raise DatasetFileError(f"{relative} is missing")
    try:
        with av.open(str(root / relative)) as container:
            stream = container.streams.video[0]
            stamps = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
            if len(stamps) < frames:
                raise DatasetFileError(f"{relative} has {len(stamps)} frames, meta/episodes has {frames}")
            for number in (0, frames - 1):
                container.seek(sorted(stamps)[number], stream=stream)
                picture = next(
                    picture for picture in container.decode(stream)
                    if picture.time is not None and round(picture.time * fps) == number
                )  # fmt: skip
                if (picture.height, picture.width) != tuple(shape[:2]):
                    size = f"{picture.width} x {picture.height}"
                    raise DatasetFileError(f"{relative} is {size} px, info.json says {shape[1]} x {shape[0]}")
    except (av.FFmpegError, StopIteration, IndexError) as error:
        raise DatasetFileError(f"{relative} is damaged: {error or 'its frames cannot be decoded'}") from error
