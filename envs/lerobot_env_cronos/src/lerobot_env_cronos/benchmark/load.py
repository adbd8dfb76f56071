"""The benchmark that `--env.benchmark` names: of this package, of a folder, or of the Hub."""

from functools import cache
from pathlib import Path

from lerobot_env_cronos.benchmark.benchmark import Benchmark, packaged_benchmark
from lerobot_env_cronos.scene.scenes import get_scene


def load_benchmark(name: str | None, scene_name: str) -> Benchmark:
    """The benchmark that `--env.benchmark` names, or the package's if it is None.

    Args:
        name: `<owner>/<repository>` or `<owner>/<repository>@<revision>` of a dataset on the Hub, or a folder. It
            is read once in a process.
        scene_name: the scene that it has to be of.

    Raises:
        ValueError: it is of another scene, cannot be loaded, or is malformed; the message says where and why.
    """
    if name is None:
        return packaged_benchmark(scene_name)
    benchmark = _load(name)
    if benchmark.scene != get_scene(scene_name):
        raise ValueError(
            f"benchmark {name} is of {benchmark.scene.name}, not of {scene_name}: --env.scene chooses"
        )
    return benchmark


def benchmark_scene(name: str) -> str:
    """The scene that a benchmark is of; see `load_benchmark`."""
    return _load(name).scene.name


@cache
def _load(name: str) -> Benchmark:
    # Brings pyarrow, which the packaged benchmarks do not need.
    from lerobot_env_cronos.benchmark.files import check_tag, fetch_benchmark, read_benchmark

    if Path(name).is_dir():
        return read_benchmark(Path(name), source=name)
    return check_tag(read_benchmark(*fetch_benchmark(name)), name)
