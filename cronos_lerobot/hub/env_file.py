"""The environments of this repository's benchmark, for LeRobot's EnvHub.

    from lerobot.envs import make_env

    envs = make_env("<owner>/<repository>@<revision>", n_envs=64, trust_remote_code=True)
    envs["independent_held_out"][0]  # the first task, in 64 environments
    envs["sequential_train"][3]  # the fourth ordering

They are those of the data beside this file, at the same revision, in every suite and split.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from huggingface_hub import snapshot_download

try:
    from lerobot_env_cronos import CronosEnvConfig
except ModuleNotFoundError as error:
    if error.name != "lerobot_env_cronos":
        raise
    # Not a ModuleNotFoundError, of which LeRobot shows the module's name only.
    raise ImportError(
        "the environments of this benchmark need the package lerobot_env_cronos: `pip install"
        " ./envs/lerobot_env_cronos` in a clone of CRONOS for LeRobot, then call make_env again"
    ) from error

CONFIGS = ("configurations", "independent", "sequential")
SUITES, SPLITS = ("independent", "sequential"), ("train", "held_out")
OPTIONS = (
    "suite", "split", "task", "advance", "end_effector_reset", "obs_type", "task_observation", "privileged_state",
    "observation_height", "observation_width", "camera_name", "render_size", "renderer", "num_threads",
)  # fmt: skip
"""Fields of `cfg` that are followed, where it has them; those of `--env.type=cronos`."""


def data_folder() -> Path:
    """The folder of the data.

    LeRobot downloads this file alone, into <cache>/models--<owner>--<repository>/snapshots/<commit>: then the data
    of that commit follow it there. In a clone or a dry run they lie beside it.
    """
    folder = Path(__file__).absolute().parent
    kind, *name = folder.parent.parent.name.split("--")
    if folder.parent.name != "snapshots" or kind not in ("models", "datasets") or not name:
        return folder
    return Path(
        snapshot_download(
            "/".join(name),
            repo_type=kind.removesuffix("s"),
            revision=folder.name,
            cache_dir=folder.parents[2],
            allow_patterns=[f"{config}/*.parquet" for config in CONFIGS],
        )
    )


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> dict[str, dict[int, Any]]:
    """Every suite and split: vector environments by task or ordering, each built when it is first used.

    Args:
        n_envs: environments in each.
        use_async_envs: they are batched and need no processes; ignored.
        cfg: an environment config; its fields in OPTIONS are followed, and `suite` or `split` chooses one.
    """
    given = {name: value for name in OPTIONS if (value := getattr(cfg, name, None)) is not None}
    suites = [given.pop("suite")] if "suite" in given else SUITES
    splits = [given.pop("split")] if "split" in given else SPLITS
    folder, envs = str(data_folder()), {}
    for suite in suites:
        for split in splits:
            config = CronosEnvConfig(benchmark=folder, suite=suite, split=split, **given)
            envs |= config.create_envs(n_envs, use_async_envs)
    return envs
