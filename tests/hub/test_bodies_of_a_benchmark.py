"""A published benchmark of a scene of one's own is run with the bodies that it was published with, or refused."""

from dataclasses import replace

import pytest
from hub_repositories import Repository
from lerobot_env_cronos import SCENES, Body, Scene, gymnasium_id, load_benchmark
from lerobot_env_cronos.benchmark import load as load_module
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark
from lerobot_env_cronos.benchmark.files import BODIES_KEY, BenchmarkError, write_benchmark
from lerobot_env_cronos.config import CronosHubEnvConfig
from lerobot_env_cronos.scene.scenes import BODIES
from pyarrow import parquet

from cronos_lerobot.hub.benchmark import write_benchmark_repository
from cronos_lerobot.hub.config import BenchmarkConfig, ResultsConfig
from cronos_lerobot.hub.results import _load

NAME = "me/own_bodies"
SCENE = Scene("own_bodies", ("eraser",), ("cloth",))
ERASER = Body("eraser", (0.03, 0.06, 0.02), 600, "box")


@pytest.fixture
def published(here, monkeypatch, tmp_path):
    """A benchmark as `cronos-publish benchmark` writes it: its files, and its repositories with their tag."""
    monkeypatch.setitem(SCENES, SCENE.name, SCENE)
    monkeypatch.setitem(BODIES, ERASER.name, ERASER)
    load_module._load.cache_clear()
    benchmark = draw_benchmark(SCENE.name, seed=1, num_configurations=2, num_orderings=1)
    (tmp_path / "files").mkdir()
    config = BenchmarkConfig(repo_id=NAME, pictures=False)
    write_benchmark_repository(config, tmp_path / "files", benchmark)
    push(here, tmp_path / "files", benchmark.fingerprint)
    return benchmark, tmp_path / "files"


def push(hub, folder, fingerprint):
    for kind in ("datasets", "models"):
        repository = hub.repositories[kind, NAME] = Repository(kind, NAME)
        repository.tags[f"benchmark-{fingerprint}"] = repository.commit_folder(folder).oid


def make_heavier(monkeypatch):
    """The eraser, as in another process, where nothing has been read yet."""
    monkeypatch.setitem(BODIES, ERASER.name, replace(ERASER, density=700))
    load_module._load.cache_clear()


def test_files_that_are_published_say_their_bodies(published, monkeypatch):
    benchmark, folder = published
    table = parquet.read_table(folder / "configurations/train.parquet")
    assert {b"huggingface", BODIES_KEY} <= table.schema.metadata.keys()
    fingerprint = benchmark.fingerprint
    assert load_benchmark(NAME, SCENE.name).fingerprint == fingerprint
    make_heavier(monkeypatch)
    with pytest.raises(BenchmarkError, match="density of the eraser is 700 here and 600 there"):
        load_benchmark(NAME, SCENE.name)


def test_results_with_other_bodies_are_not_published(published, monkeypatch):
    benchmark, _ = published
    about = {"environment": gymnasium_id(SCENE.name), "source": NAME}
    results = {"scene": SCENE.name, "benchmark": about | {"fingerprint": benchmark.fingerprint}}
    assert _load(ResultsConfig(repo_id="me/policy"), results).fingerprint == benchmark.fingerprint
    make_heavier(monkeypatch)
    results["benchmark"]["fingerprint"] = benchmark.fingerprint
    with pytest.raises(ValueError, match="density of the eraser is 700 here and 600 there"):
        _load(ResultsConfig(repo_id="me/policy"), results)


def test_a_revision_that_names_the_fingerprint_is_held_to_it(here, published, monkeypatch, tmp_path):
    """Of files that do not say their bodies, as those of earlier versions."""
    benchmark, _ = published
    fingerprint = benchmark.fingerprint
    write_benchmark(benchmark, tmp_path / "old")
    for path in (tmp_path / "old/configurations").iterdir():
        parquet.write_table(parquet.read_table(path).replace_schema_metadata(None), path)
    push(here, tmp_path / "old", fingerprint)
    name = f"{NAME}@benchmark-{fingerprint}"
    assert load_benchmark(name, SCENE.name).fingerprint == fingerprint
    assert CronosHubEnvConfig(hub_path=name).scene == SCENE.name
    make_heavier(monkeypatch)
    message = (
        f"benchmark {name} has the fingerprint {benchmark.fingerprint} here, not {fingerprint}: its scene own_bo"
    )
    with pytest.raises(BenchmarkError, match=message):
        load_benchmark(name, SCENE.name)
    with pytest.raises(BenchmarkError, match=message):
        CronosHubEnvConfig(hub_path=name)
    load_benchmark(NAME, SCENE.name)
