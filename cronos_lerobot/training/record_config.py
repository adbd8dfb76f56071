"""What a training run records of its streams, `--record.*`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.scenes import CONTROL_HZ

from cronos_lerobot.data.video import MAX_FILE_DURATION_S, check_video_size
from cronos_lerobot.data.writer import FLUSH_INTERVAL_S
from cronos_lerobot.ranges import ranged


@dataclass
class RecordConfig:
    """Record training streams as a LeRobotDataset."""

    repo_id: str | None = None
    """Name of the dataset, user/name; null records nothing."""
    root: Path | None = None
    """Folder of the dataset; <output_dir>/streams by default."""
    streams: str = "1"
    """How many of the streams to record, the first N: a number or `all`."""
    filmed_streams: int = ranged(0, minimum=0)
    """Record the first N streams once more, with pictures of env.render_size (480 x 640) instead of the
    observation's: a dataset of its own, repo_id and root with _640x480 at the end."""
    flush_interval_s: float = ranged(FLUSH_INTERVAL_S, above=0)
    """The longest that a finished segment waits to be written [s]; a killed run loses what waits."""

    def count(self, num_envs: int) -> int:
        """Recorded streams of `num_envs`.

        Raises:
            ValueError: `streams` is neither `all` nor a number from 1 to `num_envs`.
        """
        number = str(num_envs) if self.streams == "all" else str(self.streams)
        if not (number.isdigit() and 1 <= int(number) <= num_envs):
            raise ValueError(f"--record.streams must be `all` or 1 to {num_envs}, got {self.streams!r}.")
        return int(number)

    def root_in(self, output_dir: Path) -> Path:
        """The folder of the dataset of a run in `output_dir`."""
        return Path(self.root or output_dir / "streams")

    @staticmethod
    def film_suffix(render_size: Sequence[int]) -> str:
        """What the filmed streams' repo_id and root end with; `render_size` is (height, width) [px]."""
        height, width = render_size
        return f"_{width}x{height}"

    def check(self, num_envs: int, env: CronosEnvConfig, segment_length: int) -> None:
        """Find at the start what the writer would stumble over after hours.

        Args:
            num_envs: streams of the run.
            env: their environment.
            segment_length: control steps of a segment.

        Raises:
            ValueError: there are fewer streams than asked for, or a video cannot hold a picture or a segment.
        """
        if self.repo_id is None:
            return
        self.count(num_envs)
        if segment_length > (longest := int(MAX_FILE_DURATION_S * CONTROL_HZ)):
            raise ValueError(
                f"--protocol.task_switch_interval must be <= {longest} to be recorded (a video of "
                f"{MAX_FILE_DURATION_S:.0f} s), got {segment_length}."
            )
        if env.obs_type == "pixels_agent_pos":
            size = (env.observation_height, env.observation_width)
            check_video_size("--env.observation_height and --env.observation_width", size)
        if self.filmed_streams:
            check_video_size("--env.render_size", env.render_size)
