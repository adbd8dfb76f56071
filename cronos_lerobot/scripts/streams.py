"""`cronos-streams`: looks into recorded training streams, checks them, and makes training data of them.

cronos-streams statistics   successes by segment since the scene reset, task, policy version; what they began after
cronos-streams check        that nothing is missing, nothing there twice, every annotation where it belongs
cronos-streams filter       some of the segments as an ordinary LeRobotDataset, for lerobot-train
cronos-streams weights      a weight for every frame, good and bad segments alike, for lerobot-train's RA-BC

examples:
  what happened in a run
      cronos-streams statistics --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams
  is a recording on the Hub whole? (reads only the numbers)
      cronos-streams check --dataset.repo_id=me/stream
  what the policy brought about itself, cut 8 frames after the success, as training data
      cronos-streams filter --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --filter.success=true --filter.found_complete=false --frames_after_success=8 \\
          --output.repo_id=me/successes --output.root=outputs/successes
  the failures of a late policy in scenes that nobody had tidied up
      cronos-streams filter --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --filter.success=false --filter.min_policy_version=10 --filter.interventions='[end_effector_reset]' \\
          --output.repo_id=me/failures --output.root=outputs/failures
  learn from the whole stream with a stock lerobot-train: a frame counts in full if its action chunk led nearer to
  a grasp or a success, not at all if it undid one, by less than half if it changed nothing
      cronos-streams weights --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --output=outputs/progress.parquet --chunk_size=50
      lerobot-train --policy.type=smolvla --policy.load_vlm_weights=true --policy.push_to_hub=false \\
          --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --sample_weighting.type=rabc --sample_weighting.progress_path=outputs/progress.parquet
  the same by PPO's advantages, from the recorded rewards and values
      cronos-streams weights --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --weight_by=advantage --output=outputs/advantage.parquet

`cronos-streams filter --help` has the flags of a command, docs/streams.md the rest.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from lerobot.utils.constants import HF_LEROBOT_HOME
from lerobot.utils.import_utils import register_third_party_plugins
from rich.console import Console

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.stream_statistics import make_tables, statistics
from cronos_lerobot.data.stream_weights import Weighting, count_weights, write_progress
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.scripts.subcommands import run_subcommand


@dataclass
class SourceConfig:
    """A dataset of recorded streams, named as LeRobot does."""

    repo_id: str | None = None
    """Its name, user/name."""
    root: Path | None = None
    """Its folder; null looks where LeRobot keeps its datasets, then on the Hub."""
    revision: str | None = None
    """Branch, tag or commit on the Hub; refused of a dataset that is in a folder."""
    discover_packages_path: str | None = None
    """Module to import first, one that registers the scene of the streams."""

    def open(self, *, streaming: bool) -> StreamDataset:
        """Open it.

        Raises:
            ValueError: no name is given, or it has no recorded streams.
            ImportError: the module cannot be imported.
            FileNotFoundError: there is no dataset in `root`.
        """
        if self.repo_id is None:
            raise ValueError(
                "choose a dataset: --dataset.repo_id=<user/name>, and --dataset.root=<folder> if local"
            )
        if self.discover_packages_path is not None:
            import_module(self.discover_packages_path)
        if self.root is not None and not (self.root / "meta/info.json").is_file():
            raise FileNotFoundError(f"no LeRobotDataset in {self.root}")
        return StreamDataset(self.repo_id, self.root, self.revision, streaming=streaming)


@dataclass
class OutputConfig:
    """The dataset to write."""

    repo_id: str | None = None
    """Its name, user/name."""
    root: Path | None = None
    """Its folder, which must not exist; null is where LeRobot keeps its datasets."""


@dataclass
class CheckConfig:
    """Check that recorded streams are whole."""

    dataset: SourceConfig = field(default_factory=SourceConfig)
    """The streams."""


@dataclass
class StatisticsConfig:
    """Count successes, and what segments began after."""

    dataset: SourceConfig = field(default_factory=SourceConfig)
    """The streams."""
    output: Path | None = None
    """Write the counts to this JSON file, too."""


@dataclass
class FilterConfig:
    """Write some segments as an ordinary LeRobotDataset."""

    dataset: SourceConfig = field(default_factory=SourceConfig)
    """The streams."""
    output: OutputConfig = field(default_factory=OutputConfig)
    """The dataset to write."""
    filter: SegmentFilter = field(default_factory=SegmentFilter)
    """Which segments; everything given must fit."""
    frames_after_success: int | None = None
    """Cut a segment so many frames after the first in which its task was complete; null keeps it whole."""

    def __post_init__(self) -> None:
        if self.frames_after_success is not None and self.frames_after_success < 0:
            raise ValueError(f"frames_after_success must be >= 0 or null, got {self.frames_after_success}")


@dataclass
class WeightsConfig(Weighting):
    """Write what `lerobot-train --sample_weighting.type=rabc` weighs frames by.

    LeRobot's weight of a frame is 1 if progress grows by more than kappa (0.01) over the action chunk that begins
    there, 0 if it falls, and in between by how the difference compares with those of all frames: docs/streams.md.
    """

    dataset: SourceConfig = field(default_factory=SourceConfig)
    """The streams, as recorded or filtered. Train on the same dataset: frames are known by their index."""
    output: Path | None = None
    """The parquet file, for --sample_weighting.progress_path."""
    chunk_size: int | None = None
    """Actions in a chunk of the policy that will be trained: says how many frames get which weight. The file is
    the same for every policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chunk_size is not None and self.chunk_size < 1:
            raise ValueError(f"chunk_size must be >= 1 or null, got {self.chunk_size}")


def print_statistics(config: StatisticsConfig) -> None:
    """`cronos-streams statistics`."""
    result = statistics(config.dataset.open(streaming=True))
    console = Console(width=None if sys.stdout.isatty() else 140)
    for table in make_tables(result):
        console.print(table)
    if config.output is not None:
        config.output.parent.mkdir(parents=True, exist_ok=True)
        partial = config.output.with_name(f".{config.output.name}.partial")
        partial.write_text(json.dumps(result, indent=2))
        partial.replace(config.output)


def check(config: CheckConfig) -> None:
    """`cronos-streams check`."""
    streams = config.dataset.open(streaming=True)
    if streams.is_local:
        check_dataset(streams.meta.root)
    streams.check()
    frames = sum(segment.length for segment in streams.segments)
    print(f"whole: {len(streams.streams)} streams, {len(streams.segments)} segments, {frames} frames")


def filter_segments(config: FilterConfig) -> None:
    """`cronos-streams filter`."""
    if config.output.repo_id is None:
        raise ValueError("name the dataset to write: --output.repo_id=<user/name>, and --output.root=<folder>")
    root = config.output.root or HF_LEROBOT_HOME / config.output.repo_id
    # What is on this machine need not be loaded as a whole.
    streams = config.dataset.open(streaming=config.dataset.root is not None)
    total = len(streams.segments)
    written = filter_streams(
        streams, config.filter, config.output.repo_id, root, frames_after_success=config.frames_after_success
    )
    print(f"{written} of {total} segments in {root}")


def write_weights(config: WeightsConfig) -> None:
    """`cronos-streams weights`."""
    if config.output is None:
        raise ValueError("name the file to write: --output=<file>.parquet")
    streams = config.dataset.open(streaming=True)
    made_with = write_progress(streams, config.output, config)
    how = ", ".join(f"{name}={value}" for name, value in made_with.items() if name != "dataset")
    print(f"{config.output}: {streams.meta.total_frames} frames of {len(streams.segments)} segments, {how}")
    if config.chunk_size is not None:
        counts = count_weights(config.output, config.chunk_size)
        text = ", ".join(f"{n} frames {weight}" for weight, n in counts.items())
        print(f"weights at chunk_size={config.chunk_size}, before each batch is normalised: {text}")


COMMANDS: dict[str, tuple[type, Callable[[Any], None]]] = {
    "statistics": (StatisticsConfig, print_statistics),
    "check": (CheckConfig, check),
    "filter": (FilterConfig, filter_segments),
    "weights": (WeightsConfig, write_weights),
}


def main() -> None:
    """Entry point of `cronos-streams`."""
    # Streams may be of a scene that one of them brings.
    register_third_party_plugins()
    run_subcommand(__doc__ or "", COMMANDS, (ValueError, OSError, ImportError))


if __name__ == "__main__":
    main()
