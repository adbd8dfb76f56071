"""Checks that recorded streams are whole: every step once, every annotation where it belongs."""

import numpy as np
import pandas as pd
from lerobot.utils.constants import DONE

from cronos_lerobot.data.schema import (
    EVENT,
    INTERVENED,
    SEGMENT_INDEX,
    SEGMENTS_SINCE_RESET,
    STEP,
    STREAM_ID,
    STREAM_INTERVENTIONS,
    TOTAL_INTERVENTIONS,
    TRUNCATED,
)
from cronos_lerobot.protocol.interventions import COUNTED_INTERVENTIONS, Intervention

COLUMNS = [
    "index", "episode_index", "frame_index", STREAM_ID, STEP, SEGMENT_INDEX, SEGMENTS_SINCE_RESET, EVENT,
    STREAM_INTERVENTIONS, TOTAL_INTERVENTIONS, INTERVENED, DONE, TRUNCATED,
]  # fmt: skip
"""What a check reads of every frame."""
SCENE_RESETS = (Intervention.INITIAL, Intervention.SCENE_RESET, Intervention.DIVERGENCE)
"""After these the whole scene is new."""
COUNTS = (STREAM_INTERVENTIONS, TOTAL_INTERVENTIONS)


class StreamError(ValueError):
    """A recorded stream is not whole."""


class StreamCheck:
    """Checks every frame's place in its stream, a file at a time.

    - LeRobot's indices count frames and episodes without a gap, and an episode is one segment of one stream.
    - The steps of each stream go from 0 up by 1, its segments too.
    - An event stands on the first frame of every segment and on no other, INITIAL on step 0.
    - The counts of interventions never fall. They rise where one that counts happens, or help begins.
    - The last frame of a segment that another one follows is truncated, no other is, and none is done.
    - The task switches since the scene reset are 0 after one and rise by 1 at every other segment.
    - All streams of a finished recording end at the same step: they step together.
    """

    def __init__(self) -> None:
        self._num_frames, self._num_episodes = 0, 0
        self._firsts: list[pd.DataFrame] = []
        self._lasts: list[pd.DataFrame] = []

    def add(self, frames: pd.DataFrame) -> None:
        """Take the columns `COLUMNS` of the next file, which has whole episodes.

        Raises:
            StreamError: names the stream, the step and what is wrong there.
        """
        _expect(frames, frames["index"] == np.arange(len(frames)) + self._num_frames, "index")
        first = frames["frame_index"] == 0
        _expect(frames, frames["episode_index"] == first.cumsum() - 1 + self._num_episodes, "episode_index")
        _check_within(frames, first)
        self._firsts.append(frames[first])
        self._lasts.append(frames[first.shift(-1, fill_value=True)])
        self._num_frames += len(frames)
        self._num_episodes += int(first.sum())

    def finish(self, total_frames: int, total_episodes: int, *, is_finished: bool = True) -> None:
        """Check what only the whole recording tells; a filtered one has gaps.

        Args:
            total_frames: as `info.json` counts them.
            total_episodes: the same.
            is_finished: whether the recording was not killed and does not go on.

        Raises:
            StreamError: names the stream, the step and what is wrong there.
        """
        for name, count, total in (
            ("frames", self._num_frames, total_frames),
            ("episodes", self._num_episodes, total_episodes),
        ):
            if count != total:
                raise StreamError(f"the data files hold {count} {name}, info.json counts {total}")
        segments = pd.concat(self._firsts, ignore_index=True).sort_values([STREAM_ID, STEP], kind="stable")
        ends = pd.concat(self._lasts, ignore_index=True).loc[segments.index].reset_index(drop=True)
        _check_between(segments.reset_index(drop=True), ends)
        steps = ends.groupby(STREAM_ID)[STEP].max() + 1
        shortest, longest = steps.idxmin(), steps.idxmax()
        # A flush writes the segments that have ended by then, of some streams one more than of others.
        if is_finished and steps[shortest] < steps[longest]:
            raise StreamError(
                f"stream {shortest} ends after {steps[shortest]} steps, stream {longest} after {steps[longest]}:"
                " the recording broke off, continues or was filtered"
            )


def _check_within(frames: pd.DataFrame, first: pd.Series) -> None:
    """Check frames after frames of their own segment, and what is true of every frame."""
    rise = frames[[STREAM_ID, SEGMENT_INDEX, SEGMENTS_SINCE_RESET, "frame_index", STEP, *COUNTS]].diff()
    for name in (STREAM_ID, SEGMENT_INDEX, SEGMENTS_SINCE_RESET):
        _expect(frames, first | (rise[name] == 0), name)
    for name in ("frame_index", STEP):
        _expect(frames, first | (rise[name] == 1), name)
    _expect(frames, (frames[EVENT] != Intervention.NONE) == first, EVENT)
    _expect(frames, ~frames[TRUNCATED].astype(bool) | first.shift(-1, fill_value=True), TRUNCATED)
    _expect(frames, ~frames[DONE].astype(bool), DONE, "is True, but a stream never ends")
    helped = frames[INTERVENED].astype(bool)
    help_begins = helped & ~helped.shift(fill_value=False)
    _check_counts(frames[~first], rise[~first], help_begins[~first].astype(int), help_begins[~first])


def _check_between(segments: pd.DataFrame, ends: pd.DataFrame) -> None:
    """Check the first frames of all segments, stream by stream and in order, after the last frames before them.

    Args:
        segments: their first frames.
        ends: their last frames.
    """
    there = set(segments[STREAM_ID])
    if missing := sorted(set(range(min(max(there), len(there)) + 1)) - there):
        raise StreamError(f"stream {missing[0]} is missing; recorded are the first ones up to {max(there)}")
    before = ends.shift()
    begins = segments[STREAM_ID] != before[STREAM_ID]
    due = (before[STEP] + 1).where(~begins, 0)
    _expect(segments, segments[STEP] >= due, STEP, "is there twice")
    if (gap := segments[STEP] > due).any():
        at = int(np.flatnonzero(gap)[0])
        stream, step = segments[STREAM_ID][at], segments[STEP][at]
        raise StreamError(f"stream {stream}: steps {int(due[at])} to {step - 1} are missing")
    _expect(segments, segments[SEGMENT_INDEX] == segments.groupby(STREAM_ID).cumcount(), SEGMENT_INDEX)
    event = segments[EVENT]
    # A run that resumes in a world that keeps no state begins with a new placement.
    _expect(segments, (event == Intervention.INITIAL) | ~begins, EVENT)
    # The recording may end with a segment or inside one.
    is_last = begins.shift(-1, fill_value=True)
    _expect(ends, ends[TRUNCATED].astype(bool) | is_last, TRUNCATED)
    switches = (before[SEGMENTS_SINCE_RESET] + 1).where(~event.isin(SCENE_RESETS), 0)
    _expect(segments, segments[SEGMENTS_SINCE_RESET] == switches, SEGMENTS_SINCE_RESET)
    help_begins = segments[INTERVENED].astype(bool) & ~ends[INTERVENED].astype(bool).shift(fill_value=False)
    least = event.isin(COUNTED_INTERVENTIONS).astype(int) + help_begins
    rise = segments[[*COUNTS]] - before[[*COUNTS]]
    _check_counts(segments[~begins], rise[~begins], least[~begins], ~begins[~begins])


def _check_counts(frames: pd.DataFrame, rise: pd.DataFrame, least: pd.Series, may_rise: pd.Series) -> None:
    """Check how much the counts of interventions rise at frames: by `least` at least."""
    for name in COUNTS:
        # Several kinds may come together; the frame carries the strongest. Other streams count at any time.
        fits = (rise[name] >= least) & (may_rise | (rise[name] == 0) | (name == TOTAL_INTERVENTIONS))
        _expect(frames, fits, name, "is not what the interventions add up to")


def _expect(frames: pd.DataFrame, holds: pd.Series, name: str, what: str = "is wrong") -> None:
    """Raise a StreamError about the first frame where a column is not as it should be."""
    wrong = np.flatnonzero(~holds.to_numpy(bool))
    if len(wrong):
        row = frames.iloc[wrong[0]]
        raise StreamError(f"stream {row[STREAM_ID]}, step {row[STEP]}: {name} {what} ({row[name]})")
