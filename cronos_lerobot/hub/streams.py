"""The repository of a recorded dataset, streams or demonstrations: the LeRobotDataset as it is, and a card."""

from __future__ import annotations

import errno
import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.origin import DEMONSTRATIONS, ORIGIN, STREAMS, Origin
from cronos_lerobot.data.stream_statistics import statistics
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.dataset_metadata import named_files, open_metadata
from cronos_lerobot.hub.cards import code, render_card
from cronos_lerobot.hub.config import StreamConfig
from cronos_lerobot.hub.runs import changed_flags
from cronos_lerobot.hub.stage import read_json, readable, stage, write_text
from cronos_lerobot.locks import FolderInUseError, FolderLock
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.statistics import wilson_interval

META = re.compile(rf"{EPISODES_DIR}/chunk-\d+/file-\d+\.parquet")
REPLACES = ["data/*", "meta/*", "videos/*"]
"""What a new version of a dataset removes of the old one."""
OUTCOMES = ("success", "found_complete")
"""Fields of a filter that choose segments by how they went."""
COLUMNS = {
    "action": "executed action: end-effector target delta [m, rad] and gripper (1 open, 0 close)",
    "next.reward": "reward of the action",
    "next.success": "the task is complete after the action",
    "next.done": "the episode ends with its task; always false in a stream, which never ends",
    "next.truncated": "last frame of a segment, or of an episode whose time is over",
    "intervention": "a person or a script acted",
    "cronos.stream_id": "number of the stream",
    "cronos.step": "control step of the stream, from 0",
    "cronos.segment_index": "number of the segment in its stream",
    "cronos.segments_since_reset": "task switches since the stream's last scene reset",
    "cronos.event": "what happened right before the frame: "
    + ", ".join(f"{kind.value} {kind.name.lower().replace('_', ' ')}" for kind in Intervention),
    "cronos.stream_interventions": "interventions of this stream so far",
    "cronos.total_interventions": "interventions of all streams so far",
    "cronos.policy_version": "policy updates before the action",
    "cronos.log_prob": "log-probability of the action [nats]",
    "cronos.value": "the policy's value",
}
"""What the columns hold that do not say it themselves."""
LEROBOTS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def write_stream_repository(config: StreamConfig, folder: Path) -> str:
    """Write the tree of a dataset's repository into `folder`; returns what it is, in words.

    Raises:
        ValueError: the dataset is damaged, empty, of another robot or version, or has a link that leads out of it.
    """
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
    """LeRobot's version of the dataset's format: the tag that LeRobot looks for on the Hub.

    Raises:
        ValueError: --root is missing, or info.json is damaged.
        FileNotFoundError: there is no dataset.
    """
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
    """Keep writers out of a dataset while it is read and pushed; one that may only be read has none.

    Raises:
        FolderInUseError: it is still being recorded.
    """
    lock = FolderLock(root)
    try:
        lock.acquire()
    except FolderInUseError:
        raise
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
    try:
        yield
    finally:
        lock.release()


def _card(repo_id: str, root: Path, info: dict[str, Any], origin: Origin) -> str:
    is_stream = origin.kind == STREAMS
    shown = _what_happened(StreamDataset(repo_id, root=root), origin) if is_stream else {}
    return render_card(
        "dataset",
        repo_id=repo_id,
        is_stream=is_stream,
        is_demonstration=origin.kind == DEMONSTRATIONS,
        info=info,
        scene=code(origin.scene),
        environment=code(origin.environment),
        filters=[_describe_filter(one) for one in origin.filters],
        flags=list(_flags(origin)),
        columns=list(_columns(info)),
        **shown,
    )


def _columns(info: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, feature in info["features"].items():
        if name not in LEROBOTS:
            shape = " x ".join(str(int(size)) for size in feature["shape"])
            yield code(name), code(feature["dtype"]), shape, COLUMNS.get(name, "")


def _flags(origin: Origin) -> Iterator[tuple[str, str]]:
    """What made the dataset, as rows of a table."""
    if origin.kind == DEMONSTRATIONS:
        for name, value in origin.flags.items():
            if value not in (None, False, "", [], {}) and not name.startswith(("env.features", "dataset.")):
                yield code(f"--{name}"), code(value)
        return
    yield from changed_flags(origin.flags)
    for change in origin.resumed:
        for name, value in change["flags"].items():
            yield code(f"--{name}"), code(f"{value}, from episode {change['episodes']} of the recording")


def _what_happened(streams: StreamDataset, origin: Origin) -> dict[str, Any]:
    """Numbers of recorded streams for the card."""
    counts = statistics(streams)
    try:
        streams.check()
        missing = None
    except ValueError as error:
        missing = code(error)
    # Segments that were chosen by how they went say nothing of how often the policy succeeded.
    is_chosen = any(one["filter"].get(name) is not None for one in origin.filters for name in OUTCOMES)
    return {
        "num_streams": counts["streams"],
        "missing": missing,
        "is_chosen": is_chosen,
        "success": [] if is_chosen else list(_success_rows(counts["success_by_position"])),
        "began_after": [(code(name.replace("_", " ")), n) for name, n in counts["began_after"].items()],
    }


def _success_rows(by_position: dict[int, list[int]]) -> Iterator[tuple[Any, ...]]:
    for position, (successes, _, n) in by_position.items():
        low, high = wilson_interval(successes, n)
        yield position + 1, f"{successes / n:.2f}", f"{low:.2f} to {high:.2f}", n


def _describe_filter(one: dict[str, Any]) -> dict[str, Any]:
    """A call of `cronos-streams filter`."""
    flags = {f"filter.{name}": value for name, value in one["filter"].items()}
    flags["frames_after_success"] = one["frames_after_success"]
    given = [f"--{name}={value}" for name, value in flags.items() if value is not None]
    return {"kept": int(one["segments"]), "of": int(one["source_segments"]), "source": code(one["source"]),
            "flags": code(" ".join(given))}  # fmt: skip
