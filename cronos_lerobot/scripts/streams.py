"""`cronos-streams`: look into recorded training streams, check them, and make training data of them.

cronos-streams statistics   successes by segment since the scene reset, task, policy version; what they began after
cronos-streams check        that nothing is missing, nothing is there twice, every annotation is right
cronos-streams filter       some of the segments as an ordinary LeRobotDataset, for lerobot-train
cronos-streams weights      a weight for every frame, good and bad segments alike, for lerobot-train's RA-BC

examples:
  what happened in a run
      cronos-streams statistics --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams
  is a recording on the Hub whole? (reads only the numbers)
      cronos-streams check --dataset.repo_id=me/stream
  what the policy did itself, cut 8 frames after the success, merged with demonstrations as training data
      cronos-streams filter --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --filter.success=true --filter.found_complete=false --frames_after_success=8 \\
          --output.repo_id=me/successes --output.root=outputs/successes
      lerobot-edit-dataset --operation.type merge --operation.repo_ids "['me/demos', 'me/successes']" \\
          --operation.roots "['outputs/demos', 'outputs/successes']" \\
          --new_repo_id me/both --new_root outputs/both
  the failures of a late policy in scenes that nobody had tidied up, with all columns of a stream
      cronos-streams filter --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --filter.success=false --filter.min_policy_version=10 --filter.events='[end_effector_reset]' \\
          --schema=streams --output.repo_id=me/failures --output.root=outputs/failures
  learn from the whole stream with a stock lerobot-train: a frame counts in full if its action chunk led nearer to
  a grasp or a success, not at all if it undid one, by less than half if it changed nothing
      cronos-streams weights --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --output=outputs/progress.parquet
      lerobot-train --policy.type=smolvla --policy.load_vlm_weights=true --policy.push_to_hub=false \\
          --dataset.repo_id=me/stream --dataset.root=outputs/train/eer/streams \\
          --sample_weighting.type=rabc --sample_weighting.progress_path=outputs/progress.parquet

`cronos-streams filter --help` has the flags of a command, docs/datasets.md explains them.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.utils.constants import HF_LEROBOT_HOME
from lerobot.utils.import_utils import register_third_party_plugins

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.stream_check import COLUMNS, StreamCheck
from cronos_lerobot.data.stream_filter import SCHEMAS, SegmentFilter, filter_streams
from cronos_lerobot.data.stream_statistics import make_tables, statistics
from cronos_lerobot.data.stream_weights import GAMMA, write_progress
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.ranges import check_ranges, ranged
from cronos_lerobot.scripts.subcommands import run_subcommand
from cronos_lerobot.whole_files import written_whole


@dataclass
class SourceConfig:
    """A dataset of recorded streams, named as LeRobot does."""

    repo_id: str | None = None
    """Its name, user/name."""
    root: Path | None = None
    """Its folder; null looks where LeRobot keeps its datasets, then on the Hub."""
    revision: str | None = None
    """Branch, tag or commit on the Hub."""
    discover_packages_path: str | None = None
    """Module to import first, one that registers the scene of the streams."""

    def open(self, *, streaming: bool) -> StreamDataset:
        """Open it.

        Raises:
            ValueError: no name is given, or it has no recorded streams.
            FileNotFoundError: there is no dataset in `root`.
        """
        if self.repo_id is None:
            raise ValueError("--dataset.repo_id=<user/name> is required, and --dataset.root=<folder> if local")
        if self.root is not None and not (self.root / "meta/info.json").is_file():
            raise FileNotFoundError(f"no LeRobotDataset in --dataset.root={self.root}")
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
class StatisticsConfig(CheckConfig):
    """Count successes, and what segments began after."""

    output: Path | None = None
    """Write the counts to this JSON file, too."""


@dataclass
class FilterConfig(CheckConfig):
    """Write some segments as an ordinary LeRobotDataset."""

    output: OutputConfig = field(default_factory=OutputConfig)
    """The dataset to write."""
    filter: SegmentFilter = field(default_factory=SegmentFilter)
    """Which segments; everything given must fit."""
    schema: str = ranged("demonstrations", choices=SCHEMAS)
    """Columns to write: `demonstrations`, so that LeRobot can merge the two; `streams` keeps all, as
    `cronos-streams` needs them."""
    frames_after_success: int | None = ranged(None, minimum=0)
    """Cut a segment this many frames after the first in which its task was complete; null keeps it whole."""
    success_as_reward: bool = False
    """Write rewards of 1 where a frame's pictures show the task complete and 0 elsewhere, as LeRobot's reward
    classifier learns them."""

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass
class WeightsConfig:
    """Write what `lerobot-train --sample_weighting.type=rabc` weighs frames by.

    LeRobot's weight of a frame is 1 if progress grows by more than kappa (0.01) over the action chunk that begins
    there, 0 if it falls, and in between by how the difference compares with those of all frames: docs/datasets.md.
    """

    dataset: SourceConfig = field(default_factory=SourceConfig)
    """The streams, as recorded or filtered with --schema=streams. Train on the same dataset: frames are known by
    their index."""
    output: Path | None = None
    """The parquet file, for --sample_weighting.progress_path."""
    gamma: float = ranged(GAMMA, minimum=0, maximum=1)
    """Discount per control step, from 0 to 1."""

    def __post_init__(self) -> None:
        check_ranges(self)


def print_statistics(config: StatisticsConfig) -> None:
    """`cronos-streams statistics`."""
    result = statistics(config.dataset.open(streaming=True))
    print(f"{result['streams']} streams, {result['segments']} segments, {result['frames']} frames")
    for table in make_tables(result):
        print(table.to_string(index=False), end="\n\n")
    if config.output is not None:
        with written_whole(config.output) as file:
            json.dump(result, file, indent=2)


def check(config: CheckConfig) -> None:
    """`cronos-streams check`."""
    streams = config.dataset.open(streaming=True)
    meta = streams.meta
    if streams.is_local:
        # Files and streams at once: most of the time goes into reading.
        whole = StreamCheck()
        check_dataset(meta.root, lambda rows: whole.add(rows.select(COLUMNS).to_pandas()))
        whole.finish(meta.total_frames, meta.total_episodes)
    else:
        streams.check()
    print(f"whole: {len(streams.streams)} streams, {meta.total_episodes} segments, {meta.total_frames} frames")


def filter_segments(config: FilterConfig) -> None:
    """`cronos-streams filter`."""
    if config.output.repo_id is None:
        raise ValueError("--output.repo_id=<user/name> is required, and --output.root=<folder> says where")
    root = config.output.root or HF_LEROBOT_HOME / config.output.repo_id
    # What is on this machine need not be loaded as a whole.
    streams = config.dataset.open(streaming=config.dataset.root is not None)
    written = filter_streams(
        streams,
        config.filter,
        config.output.repo_id,
        root,
        schema=config.schema,
        frames_after_success=config.frames_after_success,
        success_as_reward=config.success_as_reward,
    )
    print(f"{written} of {len(streams.segments)} segments in {root}")


def write_weights(config: WeightsConfig) -> None:
    """`cronos-streams weights`."""
    if config.output is None or config.output.is_dir():
        raise ValueError(f"--output=<file>.parquet must name a file, got {config.output}")
    streams = config.dataset.open(streaming=True)
    write_progress(streams, config.output, config.gamma)
    print(f"{config.output}: {streams.meta.total_frames} frames of {streams.meta.total_episodes} segments")


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
    run_subcommand(COMMANDS)
