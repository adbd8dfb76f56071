"""What a dataset says about where it comes from: environment, benchmark, and how it was made.

All of it is in `meta/cronos.json`. LeRobot's own tools (delete, split, merge) write new datasets without that
file, so the environment and the benchmark are also in the feature that they judge, `next.success` of
`meta/info.json`, which these tools keep, and which two datasets must have in common before LeRobot merges them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import draccus
from lerobot_env_cronos import CronosVectorEnv, check_environment_id, gymnasium_id

from cronos_lerobot.data.schema import SUCCESS, Features
from cronos_lerobot.provenance import git_commit, package_versions

ORIGIN = "meta/cronos.json"
DEMONSTRATIONS, STREAMS = "demonstrations", "streams"
KINDS = (DEMONSTRATIONS, STREAMS)
NO_FLAGS = ("root", "discover_packages_path", "features", "features_map")
"""Fields that are left out: folders of whoever made the dataset, and what follows from the flags."""

CHANGEABLE = ("protocol.", "algorithm.")
"""What the flags begin with that a resumed run may change."""

MAYBE_FOLDERS = ("benchmark", "policy", "pretrained_path", "checkpoint", "adapter")
"""Fields that name a folder or something on the Hub; of a folder only that it was one. A hash says which."""


@dataclass(frozen=True)
class Origin:
    """Where a dataset comes from."""

    kind: str
    """DEMONSTRATIONS or STREAMS."""
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
    start_policy: str | None = None
    """Of demonstrations that begin where a policy left the scene: a hash of that policy's files."""
    gone_on: list[dict[str, Any]] = field(default_factory=list)
    """Of streams, where their run went on with other flags of protocol or algorithm: the number of `episodes`
    before that, of the recording before any filter, and the `flags` that hold from there on, the changed ones."""

    def values(self, flag: str, default: Any) -> list[Any]:
        """Everything that a flag has been, in its order; its default where none is said."""
        changes = [change["flags"] for change in self.gone_on if flag in change["flags"]]
        return [self.flags.get(flag, default), *(change[flag] for change in changes)]

    @property
    def scene(self) -> str:
        """Name of its scene."""
        return check_environment_id(self.environment, "the dataset")


def origin_of(
    env: CronosVectorEnv, kind: str, flags: Mapping[str, Any], start_policy: str | None = None
) -> Origin:
    """The origin of what is about to be recorded in `env`; `start_policy` as in `Origin`."""
    source = env.benchmark.source
    return Origin(
        kind,
        gymnasium_id(env.scene.name),
        env.benchmark.fingerprint,
        "a folder" if Path(source).exists() else source,
        dict(flags),
        package_versions(),
        git_commit(),
        start_policy,
    )


def flags_of(config: Any, only: Sequence[str] | None = None) -> dict[str, Any]:
    """Flags of a config by their names on the command line, without those of NO_FLAGS.

    Args:
        config: a dataclass, as draccus parses it.
        only: the fields to take; all when None.
    """
    encoded = draccus.encode(config)
    return _flatten({name: value for name, value in encoded.items() if only is None or name in only}, "")


def _flatten(encoded: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    flags: dict[str, Any] = {}
    for name, value in encoded.items():
        if name in NO_FLAGS:
            continue
        if isinstance(value, dict) and value:
            flags |= _flatten(value, f"{prefix}{name}.")
        else:
            is_folder = name in MAYBE_FOLDERS and isinstance(value, str) and Path(value).is_dir()
            flags[prefix + name] = "a folder" if is_folder else value
    return flags


def marked(features: Features, origin: Origin) -> Features:
    """The features with the environment and the benchmark in the one that they judge."""
    mark = {name: getattr(origin, name) for name in ("kind", "environment", "benchmark")}
    return features | {SUCCESS: features[SUCCESS] | {"info": mark}}


def write_origin(root: Path, origin: Origin) -> None:
    """Write `meta/cronos.json` of a new dataset."""
    partial = root / f"{ORIGIN}.partial"
    with partial.open("w") as file:
        json.dump(asdict(origin), file, indent=2)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(root / ORIGIN)


def with_changes(there: Origin, here: Origin, num_episodes: int) -> Origin:
    """The origin of streams that go on after `num_episodes`, with the flags that have changed since they began.

    Args:
        there: of the dataset.
        here: of what is to be appended.
        num_episodes: that the dataset keeps; what had changed after them has not.
    """
    kept = [change for change in there.gone_on if change["episodes"] < num_episodes]
    # As JSON gives them back: a tuple is a list.
    now, before = json.loads(json.dumps([here.flags, there.flags]))
    for change in kept:
        before |= change["flags"]
    names = [name for name in now if name.startswith(CHANGEABLE) and now[name] != before.get(name)]
    if names and there.flags:
        kept.append({"episodes": num_episodes, "flags": {name: now[name] for name in sorted(names)}})
    return replace(there, gone_on=kept)


def read_origin(root: Path, features: Mapping[str, Mapping[str, Any]], what: str) -> Origin:
    """Where a dataset comes from.

    Args:
        root: its folder, or where LeRobot keeps its metadata.
        features: of its `info.json`.
        what: the dataset as the subject of a sentence.

    Raises:
        ValueError: it does not say, or another version of the environment made it.
    """
    mark = (features.get(SUCCESS) or {}).get("info") or {}
    try:
        stored = json.loads((root / ORIGIN).read_text())
    except FileNotFoundError:
        stored = mark
    except ValueError as error:
        raise ValueError(f"{root / ORIGIN} cannot be read: {error}") from error
    check_environment_id(stored.get("environment"), what, "record it anew")
    origin = Origin(**{name: stored[name] for name in Origin.__dataclass_fields__ if name in stored})
    if origin.kind not in KINDS:
        raise ValueError(f"{what} is of the kind {origin.kind!r}; valid kinds: {list(KINDS)}")
    for name, value in mark.items():
        if value != getattr(origin, name):
            raise ValueError(f"{what}: {ORIGIN} says {name} {getattr(origin, name)}, info.json says {value}")
    return origin


def check_same(there: Origin, here: Origin, what: str, ignored: tuple[str, ...] = ()) -> None:
    """Check that a dataset may be gone on with.

    Args:
        there: of the dataset.
        here: of what is to be appended.
        what: the dataset as the subject of a sentence.
        ignored: flags that may differ. Those of streams are the business of the run that is resumed.

    Raises:
        ValueError: names what differs.
    """
    if there.kind != here.kind:
        raise ValueError(f"{what} holds {there.kind}, not {here.kind}")
    if there.environment != here.environment:
        raise ValueError(f"{what} was recorded in {there.environment}, not in {here.environment}")
    if there.benchmark != here.benchmark:
        raise ValueError(
            f"{what} was recorded on the benchmark {there.benchmark} ({there.source}), not on {here.benchmark}"
            f" ({here.source}): --env.benchmark chooses"
        )
    if there.kind == DEMONSTRATIONS:
        if not there.flags:
            raise ValueError(f"{what} does not say how it was made: LeRobot's tools have edited it; record anew")
        # As JSON gives them back: a tuple is a list.
        now = json.loads(json.dumps(here.flags))
        differing = [
            f"--{name}={_text(there.flags.get(name))}, not {_text(now.get(name))}"
            for name in sorted(there.flags.keys() | now.keys())
            if name not in ignored and there.flags.get(name) != now.get(name)
        ]
        if differing:
            raise ValueError(f"{what} was recorded with {'; '.join(differing)}: resume it with the same flags")
        if there.start_policy != here.start_policy:
            raise ValueError(
                f"{what} was recorded after the policy {there.start_policy}, not after {here.start_policy}:"
                " --start.policy names another one, or its files have changed"
            )


def _text(value: Any) -> str:
    return json.dumps(value) if not isinstance(value, str) else value
