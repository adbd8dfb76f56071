"""What a training run records of its streams, `--record.*`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.scenes import CONTROL_HZ

from cronos_lerobot.data.video import MAX_FILE_DURATION_S, check_video_size
from cronos_lerobot.data.writer import FLUSH_INTERVAL_S
from cronos_lerobot.dataset_metadata import check_path


@dataclass
class RecordConfig:
    """Record training streams as a LeRobotDataset."""

    repo_id: str | None = None
    """Name of the dataset, user/name; null records nothing."""
    root: Path | None = None
    """Folder of the dataset; <output_dir>/streams by default."""
    streams: str = "1"
    """How many of the streams to record, the first ones: a number or `all`."""
    filmed_streams: int = 0
    """Record the first so many streams once more, with pictures of env.render_size (480 x 640) in place of the
    observation's: a dataset of its own, repo_id and root with _640x480 at the end."""
    flush_interval_s: float = FLUSH_INTERVAL_S
    """The longest that a finished segment waits to be written [s]; a killed run loses what waits."""

    def __post_init__(self) -> None:
        _ = self.num_streams
        if self.filmed_streams < 0:
            raise ValueError(f"record.filmed_streams must be >= 0, got {self.filmed_streams}.")
        if self.flush_interval_s <= 0:
            raise ValueError(f"record.flush_interval_s must be > 0, got {self.flush_interval_s}.")

    @property
    def num_streams(self) -> int | str:
        """`streams` as a number, or "all".

        Raises:
            ValueError: it is neither.
        """
        if self.streams == "all" or str(self.streams).isdigit():
            return "all" if self.streams == "all" else int(self.streams)
        raise ValueError(f"record.streams must be a number or 'all', got {self.streams!r}.")

    def check_filmed(self, num_own: int) -> None:
        """Check that the streams to be filmed are the first process's, which has `num_own`.

        Raises:
            ValueError: there are more of them.
        """
        if self.repo_id is not None and self.filmed_streams > num_own:
            raise ValueError(
                f"record.filmed_streams must be at most {num_own}, the streams of the first process, which films, "
                f"got {self.filmed_streams}."
            )

    def root_in(self, output_dir: Path) -> Path:
        """The folder of the dataset of a run in `output_dir`."""
        return Path(self.root or output_dir / "streams")

    @staticmethod
    def film_suffix(render_size: Sequence[int]) -> str:
        """What the filmed streams' repo_id and root end with; `render_size` is (height, width) [px]."""
        height, width = render_size
        return f"_{width}x{height}"

    def check(
        self, output_dir: Path, num_envs: int, env: CronosEnvConfig, segment_length: int, *, resume: bool
    ) -> None:
        """Tell now what recording would stumble over later.

        Raises:
            ValueError: more streams are to be recorded than there are, or none; pictures that no video has, or
                more in a segment than one has; into a folder in which LeRobot cannot read them; or how is said,
                but not what.
            OSError: a dataset cannot be made: it exists, or its folder cannot be written to.
        """
        if self.repo_id is None:
            # A resumed run keeps to what it began with, which once may have been this.
            if not resume:
                self._check_nothing_is_asked()
            return
        for name, number in (("streams", self.num_streams), ("filmed_streams", self.filmed_streams)):
            if isinstance(number, int) and number > num_envs:
                raise ValueError(f"record.{name} must be at most num_envs={num_envs}, got {number}.")
        if self.num_streams == 0:
            raise ValueError(
                "record.streams=0 records nothing: give a number from 1, or leave record.repo_id out."
            )
        if segment_length > (longest := int(MAX_FILE_DURATION_S * CONTROL_HZ)):
            raise ValueError(
                f"protocol.task_switch_interval must be at most {longest} to be recorded, a video's "
                f"{MAX_FILE_DURATION_S:.0f} s, got {segment_length}."
            )
        if resume:
            # Only the checkpoint knows whether there is one to go on with, or it had stopped.
            return
        root = self.root_in(output_dir)
        # Filmed streams lie beside it, under its name with a size.
        check_path(root)
        if env.obs_type == "pixels_agent_pos":
            size = (env.observation_height, env.observation_width)
            check_video_size("--env.observation_height and --env.observation_width", size)
        if self.filmed_streams:
            check_video_size("--env.render_size", env.render_size)
        film = root.with_name(root.name + self.film_suffix(env.render_size))
        for folder in (root, film) if self.filmed_streams else (root,):
            if folder.exists():
                raise FileExistsError(f"{folder} exists; choose another --record.root.")
        parent = next(folder for folder in root.absolute().parents if folder.exists())
        try:
            tempfile.TemporaryDirectory(dir=parent).cleanup()
        except OSError as error:
            raise OSError(f"cannot record to {root}: {error}") from error

    def _check_nothing_is_asked(self) -> None:
        for field_ in fields(self):
            if (value := getattr(self, field_.name)) != field_.default:
                raise ValueError(
                    f"--record.{field_.name}={value} records nothing without --record.repo_id=<user>/<name>."
                )
