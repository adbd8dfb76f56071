"""Opens what `meta/` of a LeRobotDataset says, without writing to a folder that holds one."""

from __future__ import annotations

import json
import reprlib
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import CODEBASE_VERSION, LeRobotDatasetMetadata
from lerobot.datasets.utils import (
    DATA_DIR,
    DEFAULT_DATA_PATH,
    DEFAULT_TASKS_PATH,
    DEFAULT_VIDEO_PATH,
    EPISODES_DIR,
    INFO_PATH,
    VIDEO_DIR,
    CompatibilityError,
    check_version_compatibility,
    has_legacy_hub_download_metadata,
)

PATTERNS = ("[", "*", "?", "::")
"""What `datasets` takes for a pattern or an archive in a path. LeRobot hands it the paths of data files, so that
it finds nothing there, or also what is in a folder beside it."""
MAX_GROWTH = 20
"""Values, or bytes, that a byte of a parquet file may become, besides a row: beyond that it is no recording."""


class DatasetFileError(ValueError):
    """A file of a dataset is missing or damaged, or is not what a dataset of ours holds."""


def brief(value: object) -> str:
    """A value from a file, or what an error says of one, short enough for a message."""
    text = str(value) if isinstance(value, Exception) else _BRIEF.repr(value)
    return text if len(text) <= 300 else f"{text[:297]}..."


_BRIEF = reprlib.Repr(maxstring=150, maxother=150, maxlist=20)


def open_metadata(
    repo_id: str, root: str | Path | None = None, revision: str | None = None
) -> LeRobotDatasetMetadata:
    """Open a dataset's metadata, as `LeRobotDatasetMetadata` does.

    Args:
        repo_id: the dataset's name, "owner/name".
        root: its folder; None looks where LeRobot keeps its datasets, then on the Hub.
        revision: of the repo on the Hub.

    Raises:
        DatasetFileError: a file of `meta/` in `root` is missing or damaged, or leads out of the dataset.
        ValueError: another version of LeRobot made it, or the Hub has no version of it.
    """
    try:
        if root is not None:
            _check_meta_is_there(Path(root), repo_id)
        meta = LeRobotDatasetMetadata(repo_id, root, revision)
    except (CompatibilityError, NotImplementedError) as error:
        raise ValueError(
            f"{repo_id} has another version of LeRobot's format than {CODEBASE_VERSION}: convert it as LeRobot's "
            "documentation says"
        ) from error
    except (KeyError, TypeError, json.JSONDecodeError, pa.ArrowInvalid) as error:
        raise DatasetFileError(f"meta/ of {repo_id} cannot be read: {brief(error)}") from error
    except RuntimeError as error:
        if "must be tagged" not in str(error):
            raise
        raise ValueError(
            f"{repo_id} on the Hub has no tag {CODEBASE_VERSION}: give a --dataset.revision that it has"
        ) from error
    # Names that lead out of the folder.
    for path, expected in ((meta.data_path, DEFAULT_DATA_PATH), (meta.video_path, DEFAULT_VIDEO_PATH)):
        if path not in (expected, None):
            raise DatasetFileError(f"{INFO_PATH} keeps files at {brief(path)}, LeRobot at {expected}")
    for name in meta.features:
        if "/" in name or "\\" in name or name in (".", ".."):
            raise DatasetFileError(f"{INFO_PATH} has a feature {brief(name)}, which is no name of a file")
    return meta


def _check_meta_is_there(root: Path, repo_id: str) -> None:
    """Check that `meta/` is whole if there is a dataset in a folder.

    What LeRobot does not find in a folder it downloads into it, over what is there.
    """
    check_path(root)
    if not any((root / name).exists() for name in (INFO_PATH, EPISODES_DIR, DATA_DIR)):
        return
    if not (root / INFO_PATH).is_file():
        raise DatasetFileError(f"{root / INFO_PATH} is missing")
    info = json.loads((root / INFO_PATH).read_text())
    check_version_compatibility(repo_id, info["codebase_version"], CODEBASE_VERSION)
    # The first segment brings the other files.
    if info["total_episodes"]:
        episodes = sorted((root / EPISODES_DIR).glob("*/*.parquet")) or [root / EPISODES_DIR]
        for path in (root / DEFAULT_TASKS_PATH, *episodes):
            check_parquet(path, root)


def check_parquet(path: Path, root: Path) -> None:
    """Look at what a parquet file says of its size, before anything of it is read.

    Raises:
        DatasetFileError: the file is missing, damaged, or holds far more than a recording of its size.
    """
    relative = path.relative_to(root)
    try:
        metadata = pq.read_metadata(path)
    except (FileNotFoundError, IsADirectoryError):
        raise DatasetFileError(f"{relative} is missing") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise DatasetFileError(f"{relative} is damaged: {brief(error)}") from error
    # The sums are what a reader goes by; the total of the rows is only said.
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    lists = [i for i in range(metadata.num_columns) if metadata.schema.column(i).max_repetition_level]
    values = sum(group.column(i).num_values for group in groups for i in lists)
    rows, size = sum(group.num_rows for group in groups), path.stat().st_size
    decoded = sum(group.total_byte_size for group in groups)
    if rows > size or max(values, decoded) > size * MAX_GROWTH or min(rows, values, decoded) < 0:
        raise DatasetFileError(f"{relative} has {rows} rows, {values} values, {decoded} bytes in {size} bytes")


def check_path(root: Path) -> None:
    """Check that LeRobot can read a dataset in a folder of this path, before hours are recorded into it.

    Raises:
        ValueError: it cannot.
    """
    path = str(root.absolute())
    if found := [pattern for pattern in PATTERNS if pattern in path]:
        raise ValueError(f"LeRobot cannot read a dataset in {path}: choose a path without {' '.join(found)}")


def check_files_are_there(meta: LeRobotDatasetMetadata, root: Path) -> None:
    """Check that the dataset in a folder has an episode, and every data and video file that its episodes name.

    If one is missing, LeRobot downloads the Hub's dataset into the folder, over what is there. It may do so in a
    folder that it has downloaded into before, or that has no such file.

    Args:
        meta: of the dataset in `root`.
        root: its folder.

    Raises:
        DatasetFileError: names the missing file.
    """
    if not meta.total_episodes:
        raise DatasetFileError(f"the dataset in {root} has no episode yet")
    is_recording = any((root / name).exists() for name in (DATA_DIR, VIDEO_DIR))
    if is_recording and not has_legacy_hub_download_metadata(root) and (missing := missing_files(meta)):
        raise DatasetFileError(f"{root / missing[0]} is missing")


def named_files(meta: LeRobotDatasetMetadata) -> list[str]:
    """Return the data and video files that `meta/episodes` names, relative to the dataset's folder, sorted."""
    assert meta.episodes is not None
    templates = {"data": DEFAULT_DATA_PATH} | {f"videos/{key}": DEFAULT_VIDEO_PATH for key in meta.video_keys}
    named = set()
    for prefix, template in templates.items():
        # Whole columns: to look at thousands of episodes one by one takes seconds.
        chunks, files = (
            meta.episodes[f"{prefix}/{name}"][: meta.total_episodes] for name in ("chunk_index", "file_index")
        )
        named |= {
            template.format(video_key=prefix.removeprefix("videos/"), chunk_index=chunk, file_index=file)
            for chunk, file in set(zip(chunks, files, strict=True))
        }
    return sorted(named)


def missing_files(meta: LeRobotDatasetMetadata) -> list[str]:
    """Return those of `named_files` that the dataset's folder lacks."""
    return [file for file in named_files(meta) if not (meta.root / file).is_file()]
