"""The repository of a benchmark: parquet files, a card with pictures, `eval.yaml`, and `env.py` that runs it."""

from __future__ import annotations

import shutil
from pathlib import Path

import datasets
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from lerobot_env_cronos import Benchmark, gymnasium_id, load_benchmark
from lerobot_env_cronos.benchmark.benchmark import SUITES, draw_benchmark
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.benchmark.files import CONFIGS, CONFIGURATIONS, make_tables
from lerobot_env_cronos.benchmark.load import benchmark_scene
from lerobot_env_cronos.config import DEFAULT_SCENE
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.simulation.gl import RenderingError

from cronos_lerobot.hub import env_file
from cronos_lerobot.hub.cards import describe_source, is_packaged, render_card
from cronos_lerobot.hub.config import BenchmarkConfig
from cronos_lerobot.hub.pictures import configuration_pictures, configuration_sheet, task_sheet
from cronos_lerobot.hub.push import PublishError
from cronos_lerobot.hub.stage import write_text

FRAMEWORK = "cronos-lerobot"
"""`evaluation_framework` of eval.yaml."""
ENV_FILE = "env.py"
"""What LeRobot's EnvHub runs."""
DATA = "configurations/*.parquet"
"""Files that every benchmark has."""
REPLACES = [f"{config}/*" for config in CONFIGS] + ["pictures/*"]
"""Files of an older version that a new one removes."""


def choose_benchmark(config: BenchmarkConfig) -> Benchmark:
    """The benchmark that the flags name."""
    sizes = {name: getattr(config, name) for name in ("num_configurations", "num_orderings", "chain_length")}
    given = {name: value for name, value in sizes.items() if value is not None}
    if config.seed is None and given:
        raise ValueError(f"{', '.join(f'--{name}' for name in given)} draw a new benchmark: give a --seed")
    if config.seed is not None and config.benchmark is not None:
        raise ValueError("--benchmark publishes an existing benchmark, --seed draws a new one: give one of them")
    scene = config.scene or (benchmark_scene(config.benchmark) if config.benchmark else DEFAULT_SCENE)
    if config.seed is None:
        return load_benchmark(config.benchmark, scene)
    return draw_benchmark(scene, config.seed, **given)


def write_benchmark_repository(config: BenchmarkConfig, folder: Path, benchmark: Benchmark) -> str:
    """Write the tree of the repository of a benchmark into `folder`; returns what it is, in words."""
    try:
        pictures = configuration_pictures(benchmark) if config.pictures else None
    except RenderingError as error:
        raise PublishError(f"{error}. --pictures=false publishes without pictures") from error
    for (name, split), table in make_tables(benchmark).items():
        path = folder / name / f"{split}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        shown = pictures[split] if pictures is not None and name == CONFIGURATIONS else None
        pq.write_table(_describe(table, shown), path)
    if pictures is not None:
        (folder / "pictures").mkdir()
        (folder / "pictures" / "tasks.png").write_bytes(task_sheet(benchmark))
        (folder / "pictures" / "configurations.png").write_bytes(configuration_sheet(pictures))
    title = config.title or f"CRONOS {benchmark.scene.name}"
    shutil.copyfile(env_file.__file__, folder / ENV_FILE)
    write_text(folder / "eval.yaml", _eval_yaml(benchmark, title))
    write_text(folder / "README.md", _card(benchmark, config, title))
    sizes = ", ".join(f"{benchmark.size(suite, 'held_out')} {suite}" for suite in SUITES)
    return f"{benchmark.scene.name} ({sizes} in held_out; fingerprint {benchmark.fingerprint})"


def _describe(table: pa.Table, pictures: list[bytes] | None) -> pa.Table:
    """The table with the Hub's description of its columns, and with a picture in each row."""
    if pictures is not None:
        names = (f"{i}.jpg" for i in range(len(pictures)))
        values = [{"bytes": picture, "path": name} for picture, name in zip(pictures, names, strict=True)]
        image = datasets.Image()
        table = table.add_column(2, pa.field("picture", image.pa_type), pa.array(values, image.pa_type))
    features = datasets.Features.from_arrow_schema(table.schema)
    if pictures is not None:
        features["picture"] = datasets.Image()
    described = features.arrow_schema
    return table.cast(described.with_metadata((table.schema.metadata or {}) | described.metadata))


def _eval_yaml(benchmark: Benchmark, title: str) -> str:
    scene = benchmark.scene
    content = {
        "name": title,
        "description": (
            f"Pick and place ({', '.join(scene.objects)}; {', '.join(scene.receptacles)}) by instruction: single"
            f" tasks, and chains of tasks without a reset, {scene.steps_per_task} control steps for each task"
            f" ({gymnasium_id(scene.name)}, fingerprint {benchmark.fingerprint})."
        ),
        "evaluation_framework": FRAMEWORK,
        "tasks": [
            {"id": task_id(suite, split), "config": suite, "split": split} for suite in SUITES for split in SPLITS
        ],
    }
    return yaml.safe_dump(content, sort_keys=False, width=110)


def task_id(suite: str, split: str) -> str:
    """The name in eval.yaml and in results: `independent_train`, `sequential_held_out`, ..."""
    return f"{suite}_{split}"


def _card(benchmark: Benchmark, config: BenchmarkConfig, title: str) -> str:
    scene = benchmark.scene
    rows = sum(benchmark.size(suite, split) for suite in SUITES for split in SPLITS)
    return render_card(
        "benchmark",
        title=title,
        config=config,
        benchmark=benchmark,
        source=describe_source(benchmark.source),
        environment=gymnasium_id(scene.name),
        bodies=[BODIES[name] for name in scene.bodies],
        window_steps=scene.steps_per_task,
        is_own_scene=not is_packaged(scene.name),
        is_packaged=benchmark.fingerprint == load_benchmark(None, scene.name).fingerprint,
        size_category="n<1K" if rows < 1000 else "1K<n<10K" if rows < 10_000 else "10K<n<100K",
    )
