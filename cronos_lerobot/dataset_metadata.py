"""Opens what `meta/` of a LeRobotDataset says, without writing to a folder that holds one."""

from __future__ import annotations

import json
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from lerobot.datasets import CODEBASE_VERSION, LeRobotDatasetMetadata
from lerobot.datasets.utils import (
    DATA_DIR,
    DEFAULT_TASKS_PATH,
    EPISODES_DIR,
    INFO_PATH,
    VIDEO_DIR,
    CompatibilityError,
    check_version_compatibility,
    has_legacy_hub_download_metadata,
)

PATTERNS = ("[", "*", "?", "::")
"""What `datasets`, to which LeRobot hands the paths of data files, takes for a pattern or an archive in a path: it
finds nothing there, or what is in a folder beside it, too."""


class DatasetFileError(ValueError):
    """A file of a dataset is missing or damaged, or is not what a dataset of ours holds."""


def open_metadata(
    repo_id: str, root: str | Path | None = None, revision: str | None = None
) -> LeRobotDatasetMetadata:
    """Open a dataset's metadata, as `LeRobotDatasetMetadata` does.

    Args:
        repo_id: the dataset's name, "owner/name".
        root: its folder; None looks where LeRobot keeps its datasets, then on the Hub.
        revision: of the repo on the Hub.

    Raises:
        DatasetFileError: a file of `meta/` in `root` is missing.
        ValueError: another version of LeRobot made it, or the Hub has no version of it; or LeRobot cannot read
            what is in a folder of this path.
    """
    if root is not None:
        check_meta_is_there(Path(root), repo_id)
    with versions_explained(repo_id):
        return LeRobotDatasetMetadata(repo_id, root, revision)


def check_meta_is_there(root: Path, repo_id: str) -> None:
    """Check that `meta/` is whole if there is a dataset in a folder.

    What LeRobot does not find in a folder it downloads into it, over what is there.

    Raises:
        DatasetFileError: names the missing file.
        ValueError: another version of LeRobot made it, or see `check_path`.
    """
    check_path(root)
    if not any((root / name).exists() for name in (INFO_PATH, EPISODES_DIR, DATA_DIR)):
        return
    if not (root / INFO_PATH).is_file():
        raise DatasetFileError(f"{root / INFO_PATH} is missing")
    try:
        info = json.loads((root / INFO_PATH).read_text())
        version, has_episodes = info["codebase_version"], bool(info["total_episodes"])
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetFileError(f"{root / INFO_PATH} is damaged: {error!r}") from error
    with versions_explained(repo_id):
        check_version_compatibility(repo_id, version, CODEBASE_VERSION)
    # The first segment brings them.
    if not has_episodes:
        return
    if not (root / DEFAULT_TASKS_PATH).is_file():
        raise DatasetFileError(f"{root / DEFAULT_TASKS_PATH} is missing")
    if not any((root / EPISODES_DIR).glob("*/*.parquet")):
        raise DatasetFileError(f"{root / EPISODES_DIR} is missing")


def check_path(root: Path) -> None:
    """Check that LeRobot can read a dataset in a folder of this path, before hours are recorded into it.

    Raises:
        ValueError: it cannot.
    """
    path = str(root.absolute())
    if found := [pattern for pattern in PATTERNS if pattern in path]:
        raise ValueError(
            f"{path} has {' and '.join(found)} in its path, with which LeRobot cannot read a dataset: choose a"
            f" folder without {', '.join(PATTERNS)}"
        )


def check_files_are_there(meta: LeRobotDatasetMetadata, root: Path) -> None:
    """Check that the dataset in a folder has an episode, and every data and video file that its episodes name.

    For one that it does not find LeRobot downloads the Hub's dataset into the folder, over what is there. A folder
    that it has downloaded into before, or without any such file, it may complete.

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


def missing_files(meta: LeRobotDatasetMetadata) -> list[str]:
    """Return the data and video files that `meta/episodes` names and the dataset's folder lacks, sorted."""
    assert meta.episodes is not None
    templates = {"data": meta.data_path} | {f"videos/{key}": meta.video_path for key in meta.video_keys}
    named = set()
    for prefix, template in templates.items():
        assert template is not None
        # Whole columns: to look at thousands of episodes one by one takes seconds.
        chunks, files = (
            meta.episodes[f"{prefix}/{name}"][: meta.total_episodes] for name in ("chunk_index", "file_index")
        )
        named |= {
            template.format(video_key=prefix.removeprefix("videos/"), chunk_index=chunk, file_index=file)
            for chunk, file in set(zip(chunks, files, strict=True))
        }
    return sorted(file for file in named if not (meta.root / file).is_file())


@contextmanager
def versions_explained(repo_id: str) -> Generator[None]:
    """Turn what LeRobot raises for other versions of its format into a ValueError of one line."""
    try:
        yield
    except (CompatibilityError, NotImplementedError) as error:
        raise ValueError(
            f"{repo_id} has another version of LeRobot's format than this LeRobot's, {CODEBASE_VERSION}; "
            "LeRobot's documentation says how to convert it"
        ) from error
    except RuntimeError as error:
        if "must be tagged" not in str(error):
            raise
        raise ValueError(
            f"{repo_id} on the Hub has no tag of a version, as {CODEBASE_VERSION}: name a revision of it that is "
            "there, a branch say, or give it the tag"
        ) from error
