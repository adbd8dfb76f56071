"""What a dataset says about where it comes from: environment, benchmark, and how it was made.

All of it is in `meta/cronos.json`. LeRobot's own tools (delete, split, merge) write datasets without that file.
So format, environment and benchmark are also in the feature that they judge, `next.success` of `meta/info.json`.
These tools keep it, and LeRobot merges only datasets that have it in common.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import draccus
from draccus.utils import DecodingError
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.utils import flatten_dict

from cronos_lerobot.data.schema import FORMAT, STREAM_ID, SUCCESS, Features
from cronos_lerobot.dataset_metadata import brief
from cronos_lerobot.environment_id import check_environment_id
from cronos_lerobot.protocol.streams import Streams
from cronos_lerobot.provenance import git_commit, package_versions
from cronos_lerobot.whole_files import written_whole

ORIGIN = "meta/cronos.json"
DEMONSTRATIONS, STREAMS, SEGMENTS = "demonstrations", "streams", "segments"
"""Kinds of datasets: what the scripted expert showed; recorded streams; segments of streams that were chosen, with
the columns of demonstrations."""
NO_FLAGS = ("root", "discover_packages_path", "features", "features_map")
"""Fields that are left out: folders of whoever made the dataset, and what follows from the flags."""
MAYBE_FOLDERS = ("benchmark", "policy", "pretrained_path", "checkpoint", "adapter", "judge")
"""Fields that name a folder or something on the Hub; of a folder only that it was one. A hash says which."""

README = """---
configs:
- config_name: default
  data_files: data/*/*.parquet
tags:
- LeRobot
- cronos
---

{what} in `{environment}`, recorded with cronos-lerobot. `meta/cronos.json` says how they were made.

```python
from lerobot.datasets import LeRobotDataset

dataset = LeRobotDataset("<owner>/<name>", root="<this folder>")
```
"""
"""Without its first lines `datasets.load_dataset` takes every parquet file of the folder for data."""


@dataclass(frozen=True)
class Origin:
    """Where a dataset comes from."""

    kind: str
    """DEMONSTRATIONS, STREAMS or SEGMENTS."""
    environment: str
    """Gymnasium id with the version."""
    benchmark: str
    """Fingerprint of the benchmark whose configurations it began from."""
    source: str = ""
    """Of that benchmark, in words."""
    flags: dict[str, Any] = field(default_factory=dict)
    """How it was made: every flag by its name on the command line. Empty after LeRobot's tools."""
    versions: dict[str, str] = field(default_factory=dict)
    """Of the packages that began it."""
    commit: str | None = None
    filters: list[dict[str, Any]] = field(default_factory=list)
    """Calls of `cronos-streams filter` that it came through, the last one at the end; see `filter_streams`."""
    format: int = FORMAT

    @property
    def scene(self) -> str:
        """Name in the environment's id."""
        return check_environment_id(self.environment, "the dataset")


def origin_of(env: Streams, kind: str, flags: Mapping[str, Any]) -> Origin:
    """The origin of what is about to be recorded in `env`."""
    source = env.identity.source
    return Origin(
        kind,
        env.identity.id,
        env.identity.fingerprint,
        "a folder" if Path(source).exists() else source,
        # As a file gives them back: a tuple is a list.
        json.loads(json.dumps(flags)),
        package_versions(),
        git_commit(),
    )


def flags_of(config: Any, only: Sequence[str] | None = None) -> dict[str, Any]:
    """Flags of a config by their names on the command line, without those of NO_FLAGS.

    Args:
        config: a dataclass, as draccus parses it.
        only: the fields to take; all when None.
    """
    encoded = draccus.encode(config)
    flags = flatten_dict({name: encoded[name] for name in only or encoded}, sep=".")
    kept = {name: value for name, value in flags.items() if not set(name.split(".")) & set(NO_FLAGS)}
    for name, value in kept.items():
        if name.split(".")[-1] in MAYBE_FOLDERS and isinstance(value, str) and Path(value).is_dir():
            kept[name] = "a folder"
    return kept


def create_dataset(
    repo_id: str, root: Path, fps: int, features: Features, origin: Origin | None, robot_type: str | None
) -> LeRobotDatasetMetadata:
    """Start an empty dataset that says where it comes from; format, environment and benchmark also in SUCCESS."""
    if origin is not None:
        mark = {name: getattr(origin, name) for name in ("format", "environment", "benchmark")}
        features = features | {SUCCESS: features[SUCCESS] | {"info": mark}}
    has_video = any(feature["dtype"] == "video" for feature in features.values())
    meta = LeRobotDatasetMetadata.create(
        repo_id, fps, features, robot_type=robot_type, root=root, use_videos=has_video
    )
    if origin is not None:
        write_origin(root, origin)
    return meta


def write_origin(root: Path, origin: Origin) -> None:
    """Write `meta/cronos.json` and README.md of a dataset."""
    with written_whole(root / ORIGIN) as file:
        json.dump(asdict(origin), file, indent=2)
    what = {
        DEMONSTRATIONS: "Demonstrations",
        STREAMS: "Training streams",
        SEGMENTS: "Segments of training streams",
    }
    (root / "README.md").write_text(README.format(what=what[origin.kind], environment=origin.environment))


def read_origin(root: Path, features: Mapping[str, Mapping[str, Any]], what: str) -> Origin:
    """Where a dataset comes from.

    Args:
        root: its folder, or where LeRobot keeps its metadata.
        features: of its `info.json`.
        what: the dataset as the subject of a sentence.

    Raises:
        ValueError: it does not say, or another version of this package or of the environment made it.
    """
    mark = (features.get(SUCCESS) or {}).get("info") or {}
    kind = STREAMS if STREAM_ID in features else DEMONSTRATIONS
    try:
        file = root / ORIGIN
        stored = json.loads(file.read_text()) if file.is_file() else {"kind": kind, **mark}
        found = stored.get("format") if mark else None
        if found == FORMAT:
            check_environment_id(stored.get("environment"), what, "record it anew")
            origin = draccus.decode(Origin, stored)
    except (json.JSONDecodeError, DecodingError, AttributeError) as error:
        raise ValueError(f"{root / ORIGIN} is damaged: {brief(error)}") from error
    if found != FORMAT:
        raise ValueError(f"{what} has the format {brief(found)}, this version reads {FORMAT}: record it anew")
    for name, value in mark.items():
        if value != getattr(origin, name, None):
            raise ValueError(f"{what}: {ORIGIN} and info.json have another {name}")
    if (origin.kind == STREAMS) != (kind == STREAMS):
        raise ValueError(f"{what} is of the kind {brief(origin.kind)}, but its columns are of another")
    return origin


def check_same(there: Origin, here: Origin, what: str, ignored: tuple[str, ...] = ()) -> None:
    """Check that a dataset may be resumed.

    Args:
        there: of the dataset.
        here: of what is to be appended.
        what: the dataset as the subject of a sentence.
        ignored: flags that may differ. Those of streams are the business of the run that is resumed.

    Raises:
        ValueError: names what differs.
    """
    for name in ("kind", "environment", "benchmark"):
        if (had := getattr(there, name)) != (has := getattr(here, name)):
            raise ValueError(f"{what} cannot be resumed: its {name} is {brief(had)}, not {brief(has)}")
    if there.kind != DEMONSTRATIONS:
        return
    for name in sorted({*there.flags, *here.flags} - set(ignored)):
        if (had := there.flags.get(name)) != (has := here.flags.get(name)):
            raise ValueError(
                f"{what} cannot be resumed: it was recorded with --{name}={brief(had)}, not {brief(has)}"
            )
