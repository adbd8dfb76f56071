"""`cronos-record-demos`: let the scripted expert demonstrate every task, into a LeRobotDataset.

Example:
    cronos-record-demos --env.type=cronos --env.scene=kitchen_2x2 \\
        --dataset.repo_id=me/kitchen_demos --dataset.num_episodes=500
"""

import logging
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot.datasets.utils import INFO_PATH
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import HF_LEROBOT_HOME
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging
from lerobot_env_cronos import CronosVectorEnv, get_scene
from lerobot_env_cronos.config import CronosEnvConfig, is_of_this_package
from lerobot_env_cronos.episodic import find_task
from lerobot_env_cronos.simulation.gl import RenderingError
from tqdm import tqdm

from cronos_lerobot.command_line import parse_command_line
from cronos_lerobot.data.demo_starts import check_starts
from cronos_lerobot.data.demos import DemoCollector, DemoConfig, ExpertError, check_arm, tasks_of
from cronos_lerobot.data.origin import DEMONSTRATIONS, flags_of, origin_of
from cronos_lerobot.data.schema import demonstration_features
from cronos_lerobot.data.writer import RecordingError, SegmentWriter
from cronos_lerobot.dataset_metadata import check_path
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.ranges import check_ranges, ranged
from cronos_lerobot.scripts.errors import error_line, stop

MAY_DIFFER = (
    "resume", "num_envs", "env.num_threads", "dataset.repo_id", "dataset.num_episodes", "dataset.overwrite",
)  # fmt: skip
"""Flags that need not be those of the dataset that is resumed."""


@dataclass
class DemoDatasetConfig:
    """The dataset to write."""

    repo_id: str = ""
    """Its name, "owner/name"."""
    root: Path | None = None
    """Its folder; LeRobot's cache (`$HF_LEROBOT_HOME/<repo_id>`) when null."""
    num_episodes: int = ranged(500, minimum=1)
    """Episodes to have in the end, all tasks together."""
    video: bool = True
    """Store pixels as mp4; with `false` as PNG in the data files: exact, about twice as large, and faster for
    `lerobot-train` to read at random (docs/datasets.md)."""
    overwrite: bool = False
    """Delete a dataset that is already there."""


@dataclass
class RecordDemosConfig(DemoConfig):
    """Flags of `cronos-record-demos`, besides those of `DemoConfig`."""

    env: EnvConfig = field(default_factory=CronosEnvConfig)
    """Scene and observations; `--env.task` restricts the demonstrations to one task."""
    dataset: DemoDatasetConfig = field(default_factory=DemoDatasetConfig)
    seed: int = ranged(0, minimum=0)
    """Decides layouts, noise, misses and starts."""
    num_envs: int = ranged(32, minimum=1)
    """Streams that the expert acts in at once."""
    resume: bool = False
    """Add to a dataset that is already there, until it has `dataset.num_episodes`."""

    def __post_init__(self) -> None:
        """Check what draccus cannot."""
        check_ranges(self)
        if not is_of_this_package(self.env):
            raise ValueError(f"the scripted expert needs --env.type=cronos, got {self.env.type!r}")
        if not self.dataset.repo_id:
            raise ValueError("--dataset.repo_id is required, e.g. --dataset.repo_id=me/kitchen_demos")
        if self.resume and self.dataset.overwrite:
            raise ValueError("--resume=true and --dataset.overwrite=true exclude each other")
        if self.dataset.root is None:
            self.dataset.root = HF_LEROBOT_HOME / self.dataset.repo_id


def record_demos(cfg: RecordDemosConfig) -> None:
    """Record the demonstrations; Ctrl-C ends early and keeps what is there.

    Raises:
        ExpertError: the expert cannot do what was asked for.
        RecordingError: the dataset can no longer be written.
        OSError: see `open_writer`.
        ValueError: see `open_writer`.
    """
    _collect(cfg, *_open(cfg))


def _open(cfg: RecordDemosConfig) -> tuple[SegmentWriter, DemoCollector]:
    """The dataset, and who fills it."""
    from lerobot_env_cronos.expert.expert import ScriptedExpert

    assert isinstance(cfg.env, CronosEnvConfig)
    scene = get_scene(cfg.env.scene)
    task = find_task(scene.name, cfg.env.task)
    tasks = tasks_of(cfg, scene) if task is None else [task]
    env = cfg.env.create_streams(cfg.num_envs)
    check_starts(cfg.start, scene, tasks)
    check_arm(cfg, scene)
    # Before there is a dataset: whether pictures can be drawn here.
    env.observe(np.arange(1))
    writer = open_writer(cfg, env)
    return writer, DemoCollector(env, ScriptedExpert(env), writer, cfg, seed=cfg.seed, tasks=tasks)


def _collect(cfg: RecordDemosConfig, writer: SegmentWriter, collector: DemoCollector) -> None:
    before, total = writer.num_episodes, cfg.dataset.num_episodes
    try:
        with writer, tqdm(total=total, initial=before, unit="episode") as bar:
            collector.collect(total - before, lambda _: bar.update())
    except KeyboardInterrupt:
        logging.warning("interrupted: keeping the episodes recorded so far")
    finally:
        collector.env.close()
    rate = collector.successes / max(collector.finished, 1)
    logging.info(
        f"{writer.num_episodes} episodes, {writer.num_frames} frames in {writer.root};"
        f" the expert succeeded in {rate:.1%} of {collector.finished} attempts"
    )


def open_writer(cfg: RecordDemosConfig, env: CronosVectorEnv) -> SegmentWriter:
    """A new dataset, or the one that is there if `resume` or `overwrite` says what to do with it.

    Args:
        cfg: of the command.
        env: to record in.

    Raises:
        FileExistsError: the folder exists and neither flag is set.
        FileNotFoundError: there is nothing to resume.
        FolderInUseError: another process writes to it.
        ValueError: the dataset to resume was recorded in another scene or with other flags, or LeRobot could not
            read what is in a folder of this path.
    """
    root = cfg.dataset.root
    assert root is not None
    # Before anything is deleted: what cannot be recorded raises here.
    check_path(root)
    features = demonstration_features(env, video=cfg.dataset.video)
    if root.exists() and not cfg.resume:
        if not cfg.dataset.overwrite:
            raise FileExistsError(f"{root} exists: --resume=true adds to it, --dataset.overwrite=true replaces it")
        if any(root.iterdir()) and not (root / INFO_PATH).is_file():
            raise FileExistsError(f"{root} exists and is not a LeRobotDataset: not overwriting it")
        with FolderLock(root):
            shutil.rmtree(root)
    writer = SegmentWriter(
        cfg.dataset.repo_id,
        root,
        features,
        round(env.fps),
        robot_type=env.robot_type,
        resume=-1 if cfg.resume else None,
        origin=origin_of(env, DEMONSTRATIONS, flags_of(cfg)),
        may_differ=MAY_DIFFER,
    )
    if writer.num_episodes > cfg.dataset.num_episodes:
        writer.finalize()
        raise ValueError(
            f"--dataset.num_episodes={cfg.dataset.num_episodes}, but {root} has {writer.num_episodes} already"
        )
    return writer


def main() -> None:
    """Entry point of `cronos-record-demos`."""
    init_logging()
    with error_line(RenderingError):
        register_third_party_plugins()
        cfg = parse_command_line(RecordDemosConfig)
        opened = _open(cfg)
    try:
        _collect(cfg, *opened)
    except (ExpertError, RecordingError) as error:
        stop(error)


if __name__ == "__main__":
    main()
