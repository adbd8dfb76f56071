"""The repository of a recorded dataset, streams or demonstrations: the LeRobotDataset as it is, and a card."""

from __future__ import annotations

import errno
import re
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.origin import DEMONSTRATIONS, ORIGIN, STREAMS, Origin
from cronos_lerobot.data.stream_statistics import statistics
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.dataset_metadata import named_files, open_metadata
from cronos_lerobot.hub.cards import changed_flags, interval, render_card
from cronos_lerobot.hub.config import StreamConfig
from cronos_lerobot.hub.stage import read_json, readable, stage, write_text
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.statistics import wilson_interval

META = re.compile(rf"{EPISODES_DIR}/chunk-\d+/file-\d+\.parquet")
REPLACES = ["data/*", "meta/*", "videos/*"]
"""What a new version of a dataset removes of the old one."""
OUTCOMES = ("success", "found_complete")
"""Fields of a filter that choose segments by how they went."""
LEROBOTS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def write_stream_repository(config: StreamConfig, folder: Path) -> str:
    """Write the tree of a dataset's repository into `folder`; returns what it is, in words."""
    root = config.root
    assert root is not None
    origin = check_dataset(root)
    stage(root, _files(root), folder)
    info = read_json(root / INFO_PATH)
    with readable(root / ORIGIN):
        card = _card(config.repo_id, root, info, origin)
    write_text(folder / "README.md", card)
    return f"{origin.kind}: {info['total_episodes']} episodes, {info['total_frames']} frames"


def read_version(config: StreamConfig) -> str:
    """LeRobot's version of the dataset's format: the tag that LeRobot looks for on the Hub."""
    if config.root is None:
        raise ValueError("--root=<folder of the dataset> is required, such as outputs/train/eer/streams")
    file = config.root / INFO_PATH
    if not file.is_file():
        raise FileNotFoundError(f"--root={config.root} is no LeRobotDataset: it has no {INFO_PATH}")
    with readable(file):
        return str(read_json(file)["codebase_version"])


def _files(root: Path) -> list[str]:
    """The files of a dataset: what `info.json` and `meta/episodes` name."""
    names = [name for name in (INFO_PATH, STATS_PATH, DEFAULT_TASKS_PATH, ORIGIN) if (root / name).exists()]
    meta = (path.relative_to(root).as_posix() for path in sorted((root / EPISODES_DIR).glob("*/*")))
    return [*names, *filter(META.fullmatch, meta), *named_files(open_metadata("local/dataset", root))]


@contextmanager
def not_being_recorded(root: Path) -> Generator[None]:
    """Keep writers out of a dataset while it is read and pushed; one that may only be read has none."""
    with ExitStack() as stack:
        try:
            stack.enter_context(FolderLock(root))
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
                raise
        yield


def _card(repo_id: str, root: Path, info: dict[str, Any], origin: Origin) -> str:
    is_stream = origin.kind == STREAMS
    return render_card(
        "dataset",
        repo_id=repo_id,
        is_stream=is_stream,
        is_demonstration=origin.kind == DEMONSTRATIONS,
        info=info,
        origin=origin,
        filters=[one | {"flags": _filter_flags(one)} for one in origin.filters],
        flags=_demonstration_flags(origin) if origin.kind == DEMONSTRATIONS else changed_flags(origin.flags),
        columns={name: feature for name, feature in info["features"].items() if name not in LEROBOTS},
        events=", ".join(f"{kind.value} {kind.name.lower().replace('_', ' ')}" for kind in Intervention),
        **(_what_happened(StreamDataset(repo_id, root=root), origin) if is_stream else {}),
    )


def _demonstration_flags(origin: Origin) -> dict[str, Any]:
    return {
        name: value
        for name, value in origin.flags.items()
        if value not in (None, False, "", [], {}) and not name.startswith(("env.features", "dataset."))
    }


def _filter_flags(one: dict[str, Any]) -> str:
    """The flags of a call of `cronos-streams filter`."""
    flags = {f"filter.{name}": value for name, value in one["filter"].items()}
    flags["frames_after_success"] = one["frames_after_success"]
    flags["success_as_reward"] = one.get("success_as_reward") or None
    return " ".join(f"--{name}={value}" for name, value in flags.items() if value is not None)


def _what_happened(streams: StreamDataset, origin: Origin) -> dict[str, Any]:
    """Numbers of recorded streams for the card."""
    counts = statistics(streams)
    try:
        streams.check()
        missing = None
    except ValueError as error:
        missing = error
    # Segments that were chosen by how they went say nothing of how often the policy succeeded.
    is_chosen = any(one["filter"].get(name) is not None for one in origin.filters for name in OUTCOMES)
    return {
        "num_streams": counts["streams"],
        "missing": missing,
        "is_chosen": is_chosen,
        "success": [] if is_chosen else list(_success_rows(counts["success_by_position"])),
        "began_after": counts["began_after"],
    }


def _success_rows(by_position: dict[int, list[int]]) -> Iterator[tuple[int, str, int]]:
    """(segment, success with interval, segments)."""
    for position, (successes, _, n) in by_position.items():
        yield position + 1, interval(successes / n, wilson_interval(successes, n), 2), n
