"""Puts recorded streams back together, from a folder or the Hub, downloaded or streamed.

```python
streams = StreamDataset("me/stream", root="outputs/train/eer/streams")
streams.check()                                           # nothing is missing, nothing is there twice
for segment in streams.segments_of(0):                    # stream 0 from its first step to its last
    print(segment.step, segment.task, segment.event.name, segment.success)
actions = streams.columns(segment, ["action"])["action"]  # (T, 7)
```
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any, cast
from urllib.parse import quote

import fsspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from datasets.exceptions import DatasetsError
from huggingface_hub import HfFileSystem
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE

from cronos_lerobot.data.origin import read_origin
from cronos_lerobot.data.schema import (
    EVENT,
    INTERVENED,
    POLICY_VERSION,
    SEGMENT_COLUMNS,
    SEGMENT_INDEX,
    SEGMENTS_SINCE_RESET,
    STEP,
    STREAM_COLUMNS,
    STREAM_ID,
    SUCCESS,
    SUCCESS_FRAME,
    TRUNCATED,
)
from cronos_lerobot.data.stats import to_array
from cronos_lerobot.data.stream_check import COLUMNS, StreamCheck
from cronos_lerobot.data.video import Clip, read_frames
from cronos_lerobot.dataset_metadata import (
    brief,
    check_files_are_there,
    check_parquet,
    missing_files,
    named_files,
    open_metadata,
)
from cronos_lerobot.protocol.interventions import Intervention


@dataclass(frozen=True)
class Segment:
    """One piece of a stream, one LeRobot episode: contiguous in time, under one instruction."""

    stream: int
    index: int
    """Segments of this stream before it."""
    step: int
    """Control steps of this stream before it."""
    length: int
    """Frames [control steps]."""
    task: str
    """The instruction."""
    event: Intervention
    """What happened between the segment before and this one."""
    position: int
    """Task switches since the last scene reset: 0 for the first segment after it."""
    success_frame: int | None
    """The first frame after which the task was complete; None if it never was."""
    policy_version: int
    """Policy updates before its first action."""
    helped: bool
    """Whether a person or a script acted on any of its frames."""
    episode: int
    """LeRobot's episode index."""
    start: int
    """LeRobot's index of its first frame."""

    @property
    def success(self) -> bool:
        """Whether the task was complete at any step."""
        return self.success_frame is not None

    @property
    def found_complete(self) -> bool:
        """A success for which nothing had to be done: no task can be done in one step."""
        return self.success_frame == 0

    @property
    def frames(self) -> range:
        """LeRobot's indices of its frames."""
        return range(self.start, self.start + self.length)


class StreamDataset:
    """Recorded streams, in order. Without the pixels, reading a segment takes a few milliseconds.

    Args:
        repo_id: the dataset's name, "owner/name".
        root: its folder; None looks where LeRobot keeps its datasets, then on the Hub.
        revision: of the repo on the Hub; what is in a folder has none.
        streaming: read single segments from the files where they are, on the Hub with range requests, without
            downloading the rest; `dataset` is then out of reach.

    Raises:
        ValueError: the dataset has no recorded streams, or no segment of them yet, or another version of the
            environment or of LeRobot made it, or a revision is asked of a folder.
        DatasetFileError: a file of the dataset in `root` is missing; of one that is streamed, of its `meta/`.
    """

    def __init__(
        self,
        repo_id: str,
        root: str | Path | None = None,
        revision: str | None = None,
        *,
        streaming: bool = False,
    ) -> None:
        self.repo_id = repo_id
        try:
            self.meta = open_metadata(repo_id, root, revision)
            if revision is not None and not self._is_snapshot:
                raise ValueError(
                    f"revision={revision} is of the Hub, but {repo_id} is in the folder {self.meta.root}"
                )
            if root is not None and not streaming:
                check_files_are_there(self.meta, Path(root))
            self._dataset = None if streaming else LeRobotDataset(repo_id, root=root, revision=revision)
        except (DatasetsError, pa.ArrowInvalid) as error:
            # What Arrow found is the cause of what `datasets` raises.
            cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
            raise ValueError(f"a file of {repo_id} is damaged: {brief(cause)}") from error
        if lacking := [name for name in (*STREAM_COLUMNS, TRUNCATED) if name not in self.meta.features]:
            raise ValueError(f"{repo_id} has no recorded streams: it lacks the columns {lacking}")
        self.origin = read_origin(self.meta.root, self.meta.features, f"dataset {repo_id}")
        """Where it comes from."""
        if not self.meta.total_episodes:
            raise ValueError(f"{repo_id} in {self.meta.root} has no episode yet")
        self._files: Any = fsspec.filesystem("file") if self.is_local else HfFileSystem()
        # A branch may have a slash.
        there = f"datasets/{repo_id}@{quote(self.meta.revision, safe='')}"
        self._base = str(self.meta.root) if self.is_local else there

    @cached_property
    def is_local(self) -> bool:
        """Whether all of it is on this machine: LeRobot's cache may have the metadata and some of the files."""
        if not self._is_snapshot:
            # A folder that was empty has the metadata alone.
            return (self.meta.root / "data").is_dir()
        return not missing_files(self.meta)

    @property
    def _is_snapshot(self) -> bool:
        """Whether it came from the Hub, into LeRobot's cache."""
        return HF_LEROBOT_HUB_CACHE.resolve() in self.meta.root.resolve().parents

    @property
    def dataset(self) -> LeRobotDataset:
        """LeRobot's own view: `dataset[i]` for `i` in `segment.frames`."""
        if self._dataset is None:
            raise ValueError(f"{self.repo_id} is streamed; open it with streaming=False for LeRobot's own view")
        return self._dataset

    @cached_property
    def rows(self) -> pd.DataFrame:
        """One row per segment, by episode: LeRobot's bookkeeping, SEGMENT_COLUMNS and SUCCESS_FRAME.

        LeRobot's tools drop the last two, or leave nulls where one of two merged datasets lacked them. What is not
        in `meta/episodes` is then read from the frames.
        """
        assert self.meta.episodes is not None
        wanted, ours = (
            ["episode_index", "dataset_from_index", "length", "tasks"],
            [*SEGMENT_COLUMNS, SUCCESS_FRAME],
        )
        there = [name for name in ours if name in self.meta.episodes.column_names]
        table = self.meta.episodes.with_format("arrow").select_columns([*wanted, *there])[
            : self.meta.total_episodes
        ]
        rows = cast(pa.Table, table).to_pandas()
        if len(there) == len(ours) and not rows[ours].isna().any(axis=None):
            return rows
        frames = pd.concat(self.annotations(["episode_index", *SEGMENT_COLUMNS]), ignore_index=True)
        by_episode = frames.groupby("episode_index")
        found = by_episode.first()
        found[[SUCCESS, INTERVENED]] = by_episode[[SUCCESS, INTERVENED]].any()
        first_success = by_episode.cumcount()[frames[SUCCESS]].groupby(frames["episode_index"]).first()
        found[SUCCESS_FRAME] = first_success.reindex(found.index, fill_value=-1)
        return rows[wanted].merge(found, left_on="episode_index", right_index=True)

    @cached_property
    def segments(self) -> list[Segment]:
        """All segments, stream by stream, each stream in the order of time."""
        # In the order of the steps, not of the segments' numbers, which `check` verifies.
        rows = self.rows.sort_values([STREAM_ID, STEP], kind="stable")
        return [_segment(row) for row in rows.to_dict("records")]

    @cached_property
    def streams(self) -> list[int]:
        """The ids of the recorded streams."""
        return sorted({segment.stream for segment in self.segments})

    def segments_of(self, stream: int) -> list[Segment]:
        """One stream, from its first step to its last.

        Raises:
            ValueError: it was not recorded.
        """
        if stream not in self.streams:
            raise ValueError(f"stream {stream} is not in {self.repo_id}; it has {self.streams}")
        return [segment for segment in self.segments if segment.stream == stream]

    def columns(self, segment: Segment, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """Columns of a segment, (T, ...) each; all but pixels if no names are given.

        Raises:
            ValueError: there is no such column.
        """
        stored = [name for name, feature in self.meta.features.items() if feature["dtype"] != "video"]
        if unknown := set(names or []) - set(stored):
            raise ValueError(f"{self.repo_id} has no columns {sorted(unknown)}; it has {stored}")
        table = pq.read_table(
            f"{self._base}/{self.meta.get_data_file_path(segment.episode)}",
            columns=list(names or stored),
            filesystem=self._files,
            filters=[("episode_index", "=", segment.episode)],
        )
        return {name: to_array(table[name]) for name in table.column_names}

    def pixels(self, segment: Segment, camera: str, frames: slice = slice(None)) -> np.ndarray:
        """Pictures of a segment, uint8 (T, H, W, 3).

        Args:
            segment: of this dataset.
            camera: the column, `observation.images.front` say.
            frames: which of its frames, in steps of 1.

        Raises:
            ValueError: there is no such camera.
        """
        if camera not in self.meta.video_keys:
            raise ValueError(f"{self.repo_id} has no pixels {camera!r}; it has {self.meta.video_keys}")
        clip = self.clip(segment, camera)
        start, stop, _ = frames.indices(segment.length)
        with self._files.open(f"{self._base}/{self.meta.get_video_file_path(segment.episode, camera)}") as file:
            return read_frames(cast(IO[bytes], file), clip.start + start, stop - start, self.meta.fps)

    def clip(self, segment: Segment, camera: str) -> Clip:
        """Where the pictures of a segment lie."""
        assert self.meta.episodes is not None
        first = self.meta.episodes[segment.episode][f"videos/{camera}/from_timestamp"]
        path = self.meta.root / self.meta.get_video_file_path(segment.episode, camera)
        return Clip(path, round(first * self.meta.fps), segment.length)

    def annotations(self, names: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Columns of single numbers, of all frames in LeRobot's order, a file at a time."""
        for file in (name for name in named_files(self.meta) if name.startswith("data/")):
            if self.is_local:
                check_parquet(self.meta.root / file, self.meta.root)
            yield pq.read_table(f"{self._base}/{file}", columns=list(names), filesystem=self._files).to_pandas()

    def check(self, *, is_finished: bool = True) -> None:
        """Check that every stream is whole.

        Args:
            is_finished: also that all streams end at the same step, which those of a recording that was killed,
                or continues, need not.

        Raises:
            StreamError: a step is missing or there twice, or an annotation is wrong.
        """
        check = StreamCheck()
        for frames in self.annotations(COLUMNS):
            check.add(frames)
        check.finish(self.meta.total_frames, self.meta.total_episodes, is_finished=is_finished)


def _segment(row: dict[str, Any]) -> Segment:
    return Segment(
        stream=int(row[STREAM_ID]),
        index=int(row[SEGMENT_INDEX]),
        step=int(row[STEP]),
        length=int(row["length"]),
        task=str(row["tasks"][0]),
        event=Intervention(int(row[EVENT])),
        position=int(row[SEGMENTS_SINCE_RESET]),
        success_frame=int(row[SUCCESS_FRAME]) if row[SUCCESS_FRAME] >= 0 else None,
        policy_version=int(row[POLICY_VERSION]),
        helped=bool(row[INTERVENED]),
        episode=int(row["episode_index"]),
        start=int(row["dataset_from_index"]),
    )
