"""Benchmarks as parquet files: a folder, or a dataset repository on the Hub with the same files.

configurations/{train,held_out}.parquet   one row for each configuration
independent/{train,held_out}.parquet      one row for each episode
sequential/{train,held_out}.parquet       one row for each chain

Files of several parts (`train-00000-of-00002.parquet`), further columns and further files are fine.
"""

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_env_cronos.benchmark.benchmark import SUITES, Benchmark, EpisodeGroup, describe_bodies
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.benchmark.orderings import is_training_cycle
from lerobot_env_cronos.benchmark.poses import find_bad_row, find_shared_row
from lerobot_env_cronos.benchmark.version import check_environment_id, gymnasium_id
from lerobot_env_cronos.scene.scenes import STEPS_PER_TASK, Scene, Task, get_scene

CONFIGURATIONS = "configurations"
CONFIGS = (CONFIGURATIONS, *SUITES)
"""The dataset's configs, in the Hub's sense of the word."""
POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
"""Suffixes of the columns of a body: position [m] and quaternion."""
BODIES_KEY = b"lerobot_env_cronos.bodies"
"""Of the metadata of the schema of `configurations`: what bodies the poses are of, `describe_bodies` as JSON."""
TAG = re.compile("benchmark-([0-9a-f]{16})")
"""Revisions that say which fingerprint they have."""

_INTEGERS = ("configuration", "window_steps", "episode", "task", "chain", "ordering")
_STRINGS = ("environment", "instruction", "object", "receptacle")
_TYPES = dict.fromkeys(_INTEGERS, pa.int32()) | dict.fromkeys(_STRINGS, pa.string())
_TYPES["instructions"] = pa.list_(pa.string())
COLUMNS = {
    CONFIGURATIONS: ("environment", "configuration"),
    "independent": (
        "environment", "episode", "task", "instruction", "object", "receptacle", "configuration", "window_steps"
    ),
    "sequential": ("environment", "chain", "ordering", "instructions", "configuration", "window_steps"),
}  # fmt: skip
"""Columns of each config; `configurations` has `pose_columns` besides."""


class BenchmarkError(ValueError):
    """A benchmark that cannot be used."""


# Writing --------------------------------------------------------------------------------------------------


def pose_columns(body: str) -> list[str]:
    """Names of the seven columns of a body, e.g. `yellow_plate_x_m`."""
    return [f"{body.replace(' ', '_')}_{suffix}" for suffix in POSE]


def make_tables(benchmark: Benchmark) -> dict[tuple[str, str], pa.Table]:
    """The tables of a benchmark, by (config, split)."""
    environment = gymnasium_id(benchmark.scene.name)
    tables = {}
    for split in SPLITS:
        poses = benchmark.configurations[split]
        columns = {"environment": [environment] * len(poses), "configuration": range(len(poses))}
        types = {name: _TYPES[name] for name in columns}
        for body, of_body in zip(benchmark.scene.bodies, poses.transpose(1, 2, 0), strict=True):
            columns |= dict(zip(pose_columns(body), of_body.tolist(), strict=True))
        types |= {name: pa.float64() for name in columns if name not in types}
        metadata = {BODIES_KEY: json.dumps(describe_bodies(benchmark.scene), sort_keys=True)}
        tables[CONFIGURATIONS, split] = pa.table(columns, schema=pa.schema(types, metadata))
        for suite in SUITES:
            rows = list(_episode_rows(benchmark, suite, split))
            schema = pa.schema([(name, _TYPES[name]) for name in COLUMNS[suite]])
            tables[suite, split] = pa.Table.from_pylist(rows, schema=schema)
    return tables


def _episode_rows(benchmark: Benchmark, suite: str, split: str) -> Iterator[dict[str, Any]]:
    number = 0
    for group in benchmark.groups(suite, split):
        for configuration in group.configurations:
            row = {
                "environment": gymnasium_id(benchmark.scene.name),
                "configuration": configuration,
                "window_steps": STEPS_PER_TASK,
            }
            if suite == "independent":
                task = group.tasks[0]
                named = {"instruction": task.instruction, "object": task.object, "receptacle": task.receptacle}
                yield row | named | {"episode": number, "task": group.number}
            else:
                yield row | {"chain": number, "ordering": group.number, "instructions": group.instructions}
            number += 1


def write_benchmark(benchmark: Benchmark, folder: Path) -> None:
    """Write the files of a benchmark into `folder`."""
    for (config, split), table in make_tables(benchmark).items():
        path = folder / config / f"{split}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)


# Reading --------------------------------------------------------------------------------------------------


def fetch_benchmark(name: str, repo_type: str = "dataset") -> tuple[Path, str]:
    """Download a benchmark repository from the Hub, or find it in the cache.

    Args:
        name: `<owner>/<repository>`, with `@<revision>` for another one than `main`.
        repo_type: dataset, or model: LeRobot's EnvHub has them there.

    Returns:
        The folder, and `<repository>@<commit>`.

    Raises:
        BenchmarkError: no such folder, repository or revision, or the Hub cannot be reached.
    """
    import httpx
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import (
        HfHubHTTPError,
        HFValidationError,
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    repo_id, _, revision = name.partition("@")
    hint = f"expected <owner>/<repository>[@<revision>] of a {repo_type} on the Hub, or a folder"
    try:
        patterns = [f"{config}/*.parquet" for config in CONFIGS]
        folder = Path(
            snapshot_download(repo_id, repo_type=repo_type, revision=revision or None, allow_patterns=patterns)
        )
    except HFValidationError as error:
        raise BenchmarkError(f"no benchmark {name!r}: {hint}") from error
    except RevisionNotFoundError as error:
        raise BenchmarkError(f"benchmark {repo_id} has no revision {revision or 'main'!r}") from error
    except RepositoryNotFoundError as error:
        reason = f"no such {repo_type} on the Hub, or it is private and HF_TOKEN gives no access to it"
        raise BenchmarkError(f"no benchmark {name!r}: {reason}; {hint}") from error
    except LocalEntryNotFoundError as error:
        raise BenchmarkError(f"cannot reach the Hub for benchmark {name!r}, and it is not in the cache") from error
    except HfHubHTTPError as error:
        raise BenchmarkError(f"the Hub refused to give out benchmark {name!r}: {error}") from error
    except httpx.TransportError as error:
        why = f"lost the connection to the Hub ({type(error).__name__})"
        raise BenchmarkError(f"{why} while loading benchmark {name!r}: try again") from error
    return folder, f"{repo_id}@{folder.name}"


def read_benchmark(folder: Path, source: str) -> Benchmark:
    """Read and check a benchmark.

    Args:
        folder: with the files.
        source: how errors and results call it.

    Raises:
        BenchmarkError: a file is missing, or a row of one is malformed, of another version, or names what the
            scene does not have; the message says which row and why. Or the scene has other bodies here.
    """
    tables = {(config, split): _read(folder, config, split, source) for config in CONFIGS for split in SPLITS}
    scene = _find_scene(tables)
    placed = {split: tables[CONFIGURATIONS, split] for split in SPLITS}
    poses = {split: _read_poses(table, scene) for split, table in placed.items()}
    groups = {
        suite: {split: _read_groups(tables[suite, split], scene, suite, len(poses[split])) for split in SPLITS}
        for suite in SUITES
    }
    _check_alike(groups, {suite: tables[suite, "held_out"] for suite in SUITES})
    benchmark = Benchmark(scene, poses, groups["independent"], groups["sequential"], source)
    # Before the poses: those of other bodies stand in the table or in the air.
    for table in placed.values():
        _check_same_bodies(table, benchmark)
    _check_poses(placed, benchmark)
    return benchmark


def check_tag(benchmark: Benchmark, name: str) -> Benchmark:
    """The benchmark, whose fingerprint is that of the revision in `name` (see `fetch_benchmark`) if it has one.

    Raises:
        BenchmarkError: it has another fingerprint.
    """
    tag = TAG.fullmatch(name.partition("@")[2])
    if tag and tag[1] != benchmark.fingerprint:
        raise BenchmarkError(
            f"benchmark {name} has the fingerprint {benchmark.fingerprint} here, not {tag[1]}: its scene "
            f"{benchmark.scene.name} has other bodies than where it was published, or the tag was moved"
        )
    return benchmark


class _Table:
    """A table that knows what to call its rows."""

    def __init__(self, table: pa.Table, where: str) -> None:
        self.table, self.where = table, where

    def fail(self, row: int | None, why: str) -> BenchmarkError:
        return BenchmarkError(f"{self.where}{'' if row is None else f', row {row}'}: {why}")

    def column(self, name: str, kind: type) -> list[Any]:
        """Values of a column, each of `kind`; a whole number will do for a float."""
        values = self.table.column(name).to_pylist()
        for i, value in enumerate(values):
            fits = isinstance(value, kind) or (kind is float and isinstance(value, int))
            if not fits or isinstance(value, bool):
                raise self.fail(i, f"{name} must be of type {kind.__name__}, got {value!r}")
        return values


def _read(folder: Path, config: str, split: str, source: str) -> _Table:
    where = f"benchmark {source}, {config}/{split}"
    paths = [folder / config / f"{split}.parquet", *sorted((folder / config).glob(f"{split}-*.parquet"))]
    paths = [path for path in paths if path.is_file()]
    if not paths:
        raise BenchmarkError(f"{where}: there is no {config}/{split}.parquet")
    try:
        table = pa.concat_tables([pq.read_table(path, partitioning=None) for path in paths])
    except pa.ArrowException as error:
        raise BenchmarkError(f"{where}: not a parquet file: {error}") from error
    found = _Table(table, where)
    missing = [name for name in COLUMNS[config] if name not in table.column_names]
    if missing:
        raise found.fail(None, f"columns {missing} are missing; it has {table.column_names}")
    if not table.num_rows:
        raise found.fail(None, "there is no row")
    return found


def _find_scene(tables: dict[tuple[str, str], _Table]) -> Scene:
    """The scene that every row is of."""
    first: str | None = None
    for table in tables.values():
        for i, environment in enumerate(table.column("environment", str)):
            try:
                scene = check_environment_id(environment, f"{table.where}, row {i},", "publish it anew")
            except ValueError as error:
                raise BenchmarkError(str(error)) from None
            try:
                get_scene(scene)
            except ValueError as error:
                raise table.fail(i, str(error)) from None
            first = first or environment
            if environment != first:
                raise table.fail(i, f"environment is {environment}, other rows have {first}")
    return get_scene(scene)


def _read_poses(table: _Table, scene: Scene) -> np.ndarray:
    names = table.table.column_names
    known = [name for body in scene.bodies for name in pose_columns(body)]
    missing = [name for name in known if name not in names]
    if missing:
        raise table.fail(None, f"columns {missing} are missing")
    for name in names:
        if name.endswith(tuple(f"_{suffix}" for suffix in POSE)) and name not in known:
            valid = list(scene.bodies)
            raise table.fail(None, f"column {name!r} is of no body of {scene.name}; its bodies: {valid}")
    for i, number in enumerate(table.column("configuration", int)):
        if number != i:
            raise table.fail(i, f"configuration must be {i}, the number of the row, got {number}")
    values = np.array([table.column(name, float) for name in known]).T
    poses = values.reshape(-1, len(scene.bodies), len(POSE))
    poses.flags.writeable = False
    return poses


def _check_poses(tables: dict[str, _Table], benchmark: Benchmark) -> None:
    """Every configuration can be used, and none is in both splits."""
    poses = benchmark.configurations
    for split, table in tables.items():
        if bad := find_bad_row(benchmark.scene, poses[split]):
            raise table.fail(*bad)
    if shared := find_shared_row(poses["held_out"], poses["train"]):
        raise tables["held_out"].fail(*shared)


def _check_same_bodies(table: _Table, benchmark: Benchmark) -> None:
    """The scene's bodies are those that the benchmark was made with, where the file says which."""
    text = (table.table.schema.metadata or {}).get(BODIES_KEY)
    if text is None:
        return
    try:
        there = {body["name"]: body for body in json.loads(text)}
    except (ValueError, TypeError, KeyError):
        raise table.fail(None, f"{BODIES_KEY.decode()} must be a JSON list of bodies, got {text!r}") from None
    here = {body["name"]: body for body in describe_bodies(benchmark.scene)}
    if list(there.items()) == list(here.items()):
        return
    differing = [
        f"{key} of the {name} is {body.get(key)} here and {there.get(name, {}).get(key)} there"
        for name, body in here.items()
        for key in sorted(body.keys() | there.get(name, {}).keys())
        if body.get(key) != there.get(name, {}).get(key)
    ] or [f"they are {list(here)} here and {list(there)} there"]
    published = benchmark.fingerprint_with(list(there.values()))
    raise table.fail(
        None,
        f"its fingerprint is {published} with the bodies that it was made with, and {benchmark.fingerprint} with "
        f"those of {benchmark.scene.name} here: {'; '.join(differing)}",
    )


def _read_groups(table: _Table, scene: Scene, suite: str, num_configurations: int) -> tuple[EpisodeGroup, ...]:
    tasks: dict[int, tuple[Task, ...]] = {}
    starts: dict[int, list[int]] = {}
    key = "task" if suite == "independent" else "ordering"
    rows = zip(
        table.column(key, int),
        table.column("configuration", int),
        table.column("window_steps", int),
        _instructions(table, suite),
        strict=True,
    )
    for i, (number, configuration, window, instructions) in enumerate(rows):
        if window != STEPS_PER_TASK:
            raise table.fail(i, f"window_steps must be {STEPS_PER_TASK}, got {window}")
        if not 0 <= configuration < num_configurations:
            raise table.fail(i, f"configuration must be 0 to {num_configurations - 1}, got {configuration}")
        named = tuple(_find_task(table, i, scene, instruction) for instruction in instructions)
        if not named:
            raise table.fail(i, "a chain needs a task")
        if tasks.setdefault(number, named) != named:
            before = [task.instruction for task in tasks[number]]
            raise table.fail(i, f"{key} {number} is {list(instructions)} here and {before} in an earlier row")
        length = len(next(iter(tasks.values())))
        if len(named) != length:
            raise table.fail(i, f"a chain of {len(named)} tasks; in earlier rows they have {length}, as all must")
        if configuration in starts.setdefault(number, []):
            raise table.fail(i, f"{key} {number} starts from configuration {configuration} a second time")
        starts[number].append(configuration)
    if sorted(tasks) != list(range(len(tasks))):
        raise table.fail(None, f"{key} must be numbered 0 to {len(tasks) - 1}, got {sorted(tasks)}")
    if suite == "independent":
        _check_bodies(table, scene)
    return tuple(
        EpisodeGroup(
            number, tasks[number], tuple(starts[number]),
            suite == "sequential" and is_training_cycle(tasks[number], scene),
        )
        for number in sorted(tasks)
    )  # fmt: skip


def _check_alike(groups: dict[str, dict[str, tuple[EpisodeGroup, ...]]], held_out: dict[str, _Table]) -> None:
    """Both splits are of the same tasks, each of them once, and their chains are as long."""
    train, other = ([group.instructions for group in groups["independent"][split]] for split in SPLITS)
    if train != other or len({text for (text,) in train}) < len(train):
        raise held_out["independent"].fail(None, f"tasks {other}; those of the training split are {train}")
    train, other = (sorted({len(group.tasks) for group in groups["sequential"][split]}) for split in SPLITS)
    if train != other:
        raise held_out["sequential"].fail(
            None, f"chains of {other} tasks; those of the training split have {train}"
        )


def _instructions(table: _Table, suite: str) -> Iterable[tuple[str, ...]]:
    if suite == "independent":
        return [(instruction,) for instruction in table.column("instruction", str)]
    return [tuple(instructions) for instructions in table.column("instructions", list)]


def _find_task(table: _Table, row: int, scene: Scene, instruction: str) -> Task:
    valid = {task.instruction: task for task in scene.tasks + scene.reset_tasks}
    if instruction not in valid:
        raise table.fail(row, f"unknown task {instruction!r} of {scene.name}; valid tasks: {list(valid)}")
    return valid[instruction]


def _check_bodies(table: _Table, scene: Scene) -> None:
    """`object` and `receptacle` say what the instruction says."""
    columns = [table.table.column(name).to_pylist() for name in ("instruction", "object", "receptacle")]
    for i, (instruction, obj, receptacle) in enumerate(zip(*columns, strict=True)):
        for name, body, valid in (
            ("object", obj, scene.objects),
            ("receptacle", receptacle, (*scene.receptacles, None)),
        ):
            if body not in valid:
                raise table.fail(i, f"unknown {name} {body!r}; valid ones: {list(valid)}")
        if Task(obj, receptacle).instruction != instruction:
            raise table.fail(i, f"instruction is {instruction!r}, but the bodies are {obj!r} and {receptacle!r}")
