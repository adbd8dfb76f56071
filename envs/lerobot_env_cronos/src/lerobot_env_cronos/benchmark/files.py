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
from lerobot_env_cronos.scene.scenes import Scene, Task, get_scene

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


MAX_ROWS, MAX_BYTES, MAX_TEXT = 100_000, 2**26, 300
"""The largest file that is read: rows, bytes before and after decompression, and characters of a text."""
_POSE_ENDS = tuple(f"_{suffix}" for suffix in POSE)


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
                "window_steps": benchmark.scene.steps_per_task,
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
    from huggingface_hub import errors, snapshot_download

    repo_id, _, revision = name.partition("@")
    files = [f"{config}/{split}{end}.parquet" for config in CONFIGS for split in SPLITS for end in ("", "-*")]
    try:
        folder = snapshot_download(repo_id, repo_type=repo_type, revision=revision or None, allow_patterns=files)
    except (
        errors.HFValidationError, errors.HfHubHTTPError, errors.LocalEntryNotFoundError, httpx.TransportError
    ) as error:  # fmt: skip
        raise BenchmarkError(
            f"no benchmark {name!r}: expected a folder, or <owner>/<repository>[@<revision>] of a {repo_type} on "
            f"the Hub that is public or that HF_TOKEN gives access to ({_short(error)})"
        ) from error
    return Path(folder), f"{repo_id}@{Path(folder).name}"


def read_benchmark(folder: Path, source: str) -> Benchmark:
    """Read and check a benchmark. It may be a stranger's: nothing in it is executed, and large files are refused.

    Args:
        folder: with the files.
        source: how errors and results call it.

    Raises:
        BenchmarkError: a file is missing, or a row of one is malformed, of another version, or names what the
            scene does not have; the message says which row and why. Or the scene has other bodies here.
    """
    tables = {(config, split): _read(folder, config, split, source) for config in CONFIGS for split in SPLITS}
    scene = _find_scene(tables.values())
    placed = {split: tables[CONFIGURATIONS, split] for split in SPLITS}
    poses = {split: _read_poses(table, scene) for split, table in placed.items()}
    groups = {
        suite: {split: _read_groups(tables[suite, split], scene, suite, len(poses[split])) for split in SPLITS}
        for suite in SUITES
    }
    benchmark = Benchmark(scene, poses, groups["independent"], groups["sequential"], source)
    # Before the poses: those of other bodies stand in the table or in the air.
    for table in placed.values():
        _check_same_bodies(table, scene)
    for split, table in placed.items():
        if bad := find_bad_row(scene, poses[split]):
            raise table.fail(*bad)
    if shared := find_shared_row(poses["held_out"], poses["train"]):
        raise placed["held_out"].fail(*shared)
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

    def column(self, name: str) -> list[Any]:
        """Values of a column, of the type that `make_tables` gives it."""
        if name not in self.table.column_names:
            raise self.fail(None, f"there is no column {name}")
        kind, column = _TYPES.get(name, pa.float64()), self.table.column(name)
        try:
            values = column.cast(kind)
        except pa.ArrowException as error:
            raise self.fail(None, f"{name} must be of type {kind}: {_short(error)}") from None
        if values.null_count or (pa.types.is_list(kind) and values.combine_chunks().flatten().null_count):
            raise self.fail(None, f"{name} must have a value in every row")
        return values.to_pylist()


def _read(folder: Path, config: str, split: str, source: str) -> _Table:
    where = f"benchmark {source}, {config}/{split}"
    paths = [folder / config / f"{split}.parquet", *sorted((folder / config).glob(f"{split}-*.parquet"))]
    paths = [path for path in paths if path.is_file()]
    if not paths:
        raise BenchmarkError(f"{where}: there is no {config}/{split}.parquet")
    try:
        table = _Table(pa.concat_tables([_read_part(path, config) for path in paths]), where)
    except (pa.ArrowException, OSError, BenchmarkError) as error:
        raise BenchmarkError(f"{where}: {_short(error)}") from error
    if not 0 < table.table.num_rows <= MAX_ROWS:
        raise table.fail(None, f"it must have 1 to {MAX_ROWS} rows, got {table.table.num_rows}")
    return table


def _read_part(path: Path, config: str) -> pa.Table:
    """The columns that are needed, after a look at how large they are: a small file may hold gigabytes."""
    if path.stat().st_size > MAX_BYTES:
        raise BenchmarkError(f"{path.name} has more than {MAX_BYTES} bytes")
    limits = {"thrift_string_size_limit": 2**20, "thrift_container_size_limit": 10_000}
    metadata = pq.ParquetFile(path, **limits).metadata

    def is_needed(name: str) -> bool:
        return name in COLUMNS[config] or (config == CONFIGURATIONS and name.endswith(_POSE_ENDS))

    paths = [metadata.schema.column(i).path for i in range(metadata.num_columns)]
    needed = [i for i, column in enumerate(paths) if is_needed(column.partition(".")[0])]
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    size = sum(group.column(i).total_uncompressed_size for group in groups for i in needed)
    values = max((sum(group.column(i).num_values for group in groups) for i in needed), default=0)
    if metadata.num_rows > MAX_ROWS or values > 10 * MAX_ROWS or not 0 <= size <= MAX_BYTES:
        raise BenchmarkError(
            f"{path.name} is too large: {metadata.num_rows} rows, {values} values in a column, {size} bytes"
        )
    texts = [paths[i] for i in needed if metadata.schema.column(i).physical_type == "BYTE_ARRAY"]
    # As a dictionary, what is said in many rows is in memory once.
    file = pq.ParquetFile(path, read_dictionary=texts, **limits)
    table = file.read(columns=sorted({paths[i].partition(".")[0] for i in needed}))
    for column in table.columns:
        _check_texts(column, path)
    return table


def _check_texts(column: pa.ChunkedArray, path: Path) -> None:
    for chunk in column.chunks:
        while pa.types.is_list(chunk.type) or pa.types.is_large_list(chunk.type):
            chunk = chunk.flatten()
        texts = chunk.dictionary if pa.types.is_dictionary(chunk.type) else chunk
        is_text = pa.types.is_string(texts.type) or pa.types.is_large_string(texts.type)
        if is_text and any(text is not None and len(text) > MAX_TEXT for text in texts.to_pylist()):
            raise BenchmarkError(f"{path.name} has a text of more than {MAX_TEXT} characters")


def _short(value: object) -> str:
    """A stranger's value in a message."""
    text = str(value) if isinstance(value, Exception) else repr(value)
    return text if len(text) <= MAX_TEXT else text[:MAX_TEXT] + "..."


def _find_scene(tables: Iterable[_Table]) -> Scene:
    """The scene that every row is of."""
    named: dict[str, str] = {}
    for table in tables:
        for environment in dict.fromkeys(table.column("environment")):
            named.setdefault(environment, table.where)
    if len(named) > 1:
        raise BenchmarkError(
            f"{list(named.values())[1]}: environment must be one in all rows, got {_short(named)}"
        )
    ((environment, where),) = named.items()
    try:
        return get_scene(check_environment_id(environment, "it", "publish it anew"))
    except ValueError as error:
        raise BenchmarkError(f"{where}: {error}") from None


def _read_poses(table: _Table, scene: Scene) -> np.ndarray:
    known = [name for body in scene.bodies for name in pose_columns(body)]
    for name in table.table.column_names:
        if name.endswith(_POSE_ENDS) and name not in known:
            raise table.fail(None, f"column {_short(name)} is of no body of {scene.name}: {list(scene.bodies)}")
    for i, number in enumerate(table.column("configuration")):
        if number != i:
            raise table.fail(i, f"configuration must be {i}, the number of the row, got {number}")
    values = np.array([table.column(name) for name in known]).T
    poses = values.reshape(-1, len(scene.bodies), len(POSE))
    poses.flags.writeable = False
    return poses


def _check_same_bodies(table: _Table, scene: Scene) -> None:
    """The scene's bodies are those that the benchmark was made with, where the file says which."""
    text = (table.table.schema.metadata or {}).get(BODIES_KEY)
    if text is None:
        return
    try:
        there = {body["name"]: body for body in json.loads(text)}
    except (ValueError, TypeError, KeyError, RecursionError):
        raise table.fail(
            None, f"{BODIES_KEY.decode()} must be a JSON list of bodies, got {_short(text)}"
        ) from None
    here = {body["name"]: body for body in describe_bodies(scene)}
    if list(there.items()) == list(here.items()):
        return
    differing = [
        f"{key} of the {name} is {_short(body.get(key))} here and {_short(there.get(name, {}).get(key))} there"
        for name, body in here.items()
        for key in body
        if body[key] != there.get(name, {}).get(key)
    ] or [f"they are {list(here)} here and {_short(list(there))} there"]
    raise table.fail(None, f"it was made with other bodies of {scene.name}: {'; '.join(differing)}")


def _read_groups(table: _Table, scene: Scene, suite: str, num_configurations: int) -> tuple[EpisodeGroup, ...]:
    key, texts = ("task", "instruction") if suite == "independent" else ("ordering", "instructions")
    tasks: dict[int, tuple[Task, ...]] = {}
    starts: dict[int, list[int]] = {}
    valid = {task.instruction: task for task in scene.tasks + scene.reset_tasks}
    rows = zip(*map(table.column, (key, "configuration", "window_steps", texts)), strict=True)
    for i, (number, configuration, window, said) in enumerate(rows):
        instructions = [said] if suite == "independent" else said
        if window != scene.steps_per_task:
            raise table.fail(i, f"window_steps must be {scene.steps_per_task}, got {window}")
        if not 0 <= configuration < num_configurations:
            raise table.fail(i, f"configuration must be 0 to {num_configurations - 1}, got {configuration}")
        if unknown := [text for text in instructions if text not in valid]:
            raise table.fail(i, f"unknown task {_short(unknown[0])} of {scene.name}; valid tasks: {list(valid)}")
        named = tuple(valid[text] for text in instructions)
        if tasks.setdefault(number, named) != named:
            raise table.fail(i, f"{key} {number} has other tasks in an earlier row")
        if configuration in starts.setdefault(number, []):
            raise table.fail(i, f"{key} {number} starts from configuration {configuration} a second time")
        starts[number].append(configuration)
    _check_tasks(table, tasks, suite)
    return tuple(
        EpisodeGroup(
            number, tasks[number], tuple(starts[number]),
            suite == "sequential" and is_training_cycle(tasks[number], scene),
        )
        for number in sorted(tasks)
    )  # fmt: skip


def _check_tasks(table: _Table, tasks: dict[int, tuple[Task, ...]], suite: str) -> None:
    # Results take a number for the place among the tasks.
    if sorted(tasks) != list(range(len(tasks))):
        raise table.fail(None, f"tasks or orderings must be numbered from 0, got {_short(sorted(tasks))}")
    if len(lengths := {len(chain) for chain in tasks.values()}) > 1 or 0 in lengths:
        raise table.fail(None, f"chains must be of one length, at least 1, got {sorted(lengths)}")
    if suite == "independent" and len(set(tasks.values())) < len(tasks):
        raise table.fail(None, "every task must have one number")
