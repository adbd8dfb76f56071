"""The repository of a recorded dataset, streams or demonstrations: the LeRobotDataset as it is, and a card."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.datasets.utils import INFO_PATH
from lerobot_env_cronos.statistics import wilson_interval

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.origin import STREAMS, Origin
from cronos_lerobot.data.stream_filter import read_filter
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.hub.cards import render_card
from cronos_lerobot.hub.config import StreamConfig
from cronos_lerobot.hub.runs import read_run, run_facts
from cronos_lerobot.locks import FolderInUseError, FolderLock
from cronos_lerobot.report.runs import TrainingRun
from cronos_lerobot.training.logging import MANIFEST, METRICS

FOLDERS = ("data", "meta", "videos")
"""Of a LeRobotDataset; others, such as pictures that wait to be encoded, stay here."""
REPLACES = [f"{folder}/*" for folder in FOLDERS]
OUTCOMES = ("success", "found_complete")
"""Fields of a filter that choose segments by how they went."""
READ_ONLY = (errno.EACCES, errno.EPERM, errno.EROFS)
"""Errors of a folder that this process may only read."""


def read_info(config: StreamConfig) -> dict[str, Any]:
    """meta/info.json of the dataset.

    Raises:
        ValueError: --root is missing, or the dataset is empty.
        FileNotFoundError: there is no dataset.
    """
    if config.root is None:
        raise ValueError("--root=<folder of the dataset> is required, such as outputs/train/eer/streams")
    path = config.root / INFO_PATH
    if not path.is_file():
        raise FileNotFoundError(f"{config.root} is no LeRobotDataset: it has no {INFO_PATH}")
    info = json.loads(path.read_text())
    if not info["total_episodes"]:
        raise ValueError(f"{config.root} has no episode yet")
    return info


def read_codebase_version(config: StreamConfig) -> str:
    """LeRobot's version of the dataset's format, the tag that LeRobot looks for on the Hub."""
    return read_info(config)["codebase_version"]


@contextmanager
def not_being_recorded(root: Path) -> Generator[None]:
    """Keep writers out of a dataset while its files are checked and pushed.

    One that may only be read, as a shared one, is not locked.

    Raises:
        FolderInUseError: it is still being recorded.
    """
    lock = FolderLock(root)
    try:
        lock.acquire()
    except FolderInUseError as error:
        raise FolderInUseError(f"{root} is still being recorded, publish it afterwards: {error}") from error
    except OSError as error:
        if error.errno not in READ_ONLY:
            raise
    try:
        yield
    finally:
        lock.release()


def write_stream_repository(config: StreamConfig, folder: Path) -> str:
    """Write the tree of a dataset's repository into `folder`; returns what it is, in words.

    A dry run copies the files; a push, whose tree is gone afterwards, links them.

    Raises:
        ValueError: --root is missing, the dataset is empty or not ours, or a file of it is damaged.
        FileNotFoundError: there is no dataset, or --run is no run.
    """
    info = read_info(config)
    assert config.root is not None
    origin = check_dataset(config.root)
    for name in FOLDERS:
        for file in sorted((config.root / name).rglob("*")):
            # What the recorder has not finished yet has a hidden name.
            if file.is_file() and not file.name.startswith("."):
                place = folder / file.relative_to(config.root)
                place.parent.mkdir(parents=True, exist_ok=True)
                if config.dry_run:
                    shutil.copyfile(file, place)
                else:
                    place.symlink_to(file.resolve())
    is_stream = origin.kind == STREAMS
    card = _stream_card(config, info, origin) if is_stream else _demonstrations_card(config, info, origin)
    (folder / "README.md").write_text(card)
    kind = "streams" if is_stream else "demonstrations"
    return f"{kind}: {info['total_episodes']} episodes, {info['total_frames']} frames"


def _find_run(config: StreamConfig) -> Path | None:
    """Folder of the training run, given or around the dataset."""
    assert config.root is not None
    if config.run is not None:
        if not (config.run / MANIFEST).is_file():
            raise FileNotFoundError(f"{config.run} is no run of cronos-train: it has no {MANIFEST}")
        return config.run
    around = config.root.resolve().parent
    return around if (around / MANIFEST).is_file() and (around / METRICS).is_file() else None


def _stream_card(config: StreamConfig, info: dict[str, Any], origin: Origin) -> str:
    from cronos_lerobot.data.stream_statistics import statistics

    assert config.root is not None
    streams = StreamDataset(config.repo_id, root=config.root)
    filters, counts = _filters(config.root), statistics(streams)
    chosen_by_outcome = any(one["filter"].get(name) is not None for one in filters for name in OUTCOMES)
    run = _find_run(config)
    trained = read_run(run) if run else None
    if trained and (scene := trained.config["env"]["scene"]) != origin.scene:
        raise ValueError(f"{config.root} was recorded in {origin.scene}, the run {run} is of {scene}")
    return render_card(
        "streams",
        repo_id=config.repo_id,
        info=info,
        statistics=counts,
        missing=_missing(streams) or (_broken_off(streams, trained) if trained and not filters else None),
        filters=filters,
        chosen_by_outcome=chosen_by_outcome,
        # There are none of the policy's own where an expert did all segments.
        tells_success=not chosen_by_outcome and bool(counts["success_by_position"]),
        run=run_facts(trained) if trained else None,
        interval=wilson_interval,
        **_common(info, origin),
    )


def _filters(root: Path) -> list[dict[str, Any]]:
    """The filters that a dataset came through, the last one first; see `filter_streams`."""
    found, last = [], read_filter(root)
    while last:
        found.append(last | {"flags": _filter_flags(last)})
        # Notes of earlier releases do not have it.
        last = last.get("filter_of_source")
    return found


def _filter_flags(filtered: dict[str, Any]) -> list[str]:
    """Flags of `cronos-streams filter` that made a dataset."""
    flags = {f"filter.{name}": value for name, value in filtered["filter"].items()}
    flags["frames_after_success"] = filtered["frames_after_success"]
    return [f"--{name}={json.dumps(value)}" for name, value in flags.items() if value is not None]


def _missing(streams: StreamDataset) -> str | None:
    """What is missing of the streams, if anything: filtered ones are not whole."""
    try:
        streams.check()
    except ValueError as error:
        return str(error)
    return None


def _broken_off(streams: StreamDataset, run: TrainingRun) -> str | None:
    """How far a recording came that ended before its run: all of its streams end at the same step."""
    recorded = max(segment.step + segment.length for segment in streams.segments)
    taken = run.last["interaction_steps"] // run.config["num_envs"]
    return f"the recording ends after {recorded} of {taken} control steps" if recorded < taken else None


def _demonstrations_card(config: StreamConfig, info: dict[str, Any], origin: Origin) -> str:
    return render_card("demonstrations", repo_id=config.repo_id, info=info, **_common(info, origin))


def _common(info: dict[str, Any], origin: Origin) -> dict[str, Any]:
    cameras = [name for name, feature in info["features"].items() if feature["dtype"] in ("video", "image")]
    observation = [
        f"`{name}` {feature['shape'][1]} x {feature['shape'][0]} px"
        for name, feature in info["features"].items()
        if name in cameras
    ] + [f"`{name}`" for name in info["features"] if name.startswith("observation.") and name not in cameras]
    return {
        "scene": origin.scene,
        "environment": origin.environment,
        "origin": origin,
        "observation": ", ".join(observation),
        "is_video": any(feature["dtype"] == "video" for feature in info["features"].values()),
    }
