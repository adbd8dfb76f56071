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

COLUMNS = (
    "index", "episode_index", "frame_index", STREAM_ID, STEP, SEGMENT_INDEX, SEGMENTS_SINCE_RESET, EVENT,
    STREAM_INTERVENTIONS, TOTAL_INTERVENTIONS, INTERVENED, DONE, TRUNCATED,
)  # fmt: skip
"""What a check reads of every frame."""
SCENE_RESETS = (Intervention.INITIAL, Intervention.SCENE_RESET, Intervention.DIVERGENCE)
"""After these the whole scene is new."""


class StreamError(ValueError):
    """A recorded stream is not whole."""


def check(frames: pd.DataFrame, total_frames: int, total_episodes: int, *, is_finished: bool = True) -> None:
    """Check every frame's place in its stream.

    - LeRobot's indices count frames and episodes without a gap, and an episode is one segment of one stream.
    - The steps of each stream go from 0 up by 1, its segments too.
    - An event stands on the first frame of every segment and on no other, INITIAL on step 0 alone.
    - The counts of interventions never fall. They rise where one that counts happens, or help begins.
    - The last frame of a segment that another one follows is truncated, no other is, and none is done.
    - The task switches since the scene reset are 0 after one and rise by 1 at every other segment.
    - All streams of a finished recording end at the same step: they step together.

    Args:
        frames: the columns `COLUMNS` of a whole recording, in LeRobot's order; a filtered one has gaps.
        total_frames: as `info.json` counts them.
        total_episodes: the same.
        is_finished: whether the recording was not killed and does not go on.

    Raises:
        StreamError: names the stream, the step and what is wrong there.
    """
    if len(frames) != total_frames:
        raise StreamError(f"the data files hold {len(frames)} frames, info.json counts {total_frames}")
    _expect(frames, frames["index"] == np.arange(len(frames)), "index")
    _check_episodes(frames, total_episodes)
    steps = frames.groupby(STREAM_ID).size()
    if missing := sorted(set(range(min(int(steps.index.max()), len(steps)) + 1)) - set(steps.index)):
        raise StreamError(f"stream {missing[0]} is missing; recorded are the first ones up to {steps.index.max()}")
    _check_streams(frames.sort_values([STREAM_ID, STEP], kind="stable").reset_index(drop=True))
    shortest, longest = steps.idxmin(), steps.idxmax()
    # A flush writes the segments that have ended by then, of some streams one more than of others.
    if is_finished and steps[shortest] < steps[longest]:
        raise StreamError(
            f"stream {shortest} ends after {steps[shortest]} steps, stream {longest} after {steps[longest]}: the"
            " recording broke off, goes on or was filtered"
        )


def _check_episodes(frames: pd.DataFrame, total: int) -> None:
    first = frames["frame_index"] == 0
    _expect(frames, frames["episode_index"] == first.cumsum() - 1, "episode_index")
    if (count := int(first.sum())) != total:
        raise StreamError(f"the data files hold {count} episodes, info.json counts {total}")
    for name in (STREAM_ID, SEGMENT_INDEX):
        _expect(frames, first | (frames[name].diff() == 0), name)
    for name in ("frame_index", STEP):
        _expect(frames, first | (frames[name].diff() == 1), name)


def _check_streams(frames: pd.DataFrame) -> None:
    """Check all streams, one after the other, each in the order of its steps."""
    begins = frames[STREAM_ID].diff() != 0
    ends = begins.shift(-1, fill_value=True)
    first = frames["frame_index"] == 0
    step = frames[STEP].diff()
    twice, gap = ~begins & (step == 0), (begins & (frames[STEP] != 0)) | (~begins & (step != 1))
    _expect(frames, ~twice, STEP, "is there twice")
    if gap.any():
        at = int(np.flatnonzero(gap)[0])
        low = 0 if begins[at] else frames[STEP][at - 1] + 1
        raise StreamError(f"stream {frames[STREAM_ID][at]}: steps {low} to {frames[STEP][at] - 1} are missing")
    segment = first.groupby(frames[STREAM_ID]).cumsum() - 1
    _expect(frames, frames[SEGMENT_INDEX] == segment, SEGMENT_INDEX)
    event = frames[EVENT]
    _expect(frames, (event != Intervention.NONE) == first, EVENT)
    _expect(frames, (event == Intervention.INITIAL) == begins, EVENT)
    # The recording may end with a segment or inside one.
    cut = first.shift(-1, fill_value=False)
    _expect(frames, (frames[TRUNCATED].astype(bool) == cut) | ends, TRUNCATED)
    _expect(frames, ~frames[DONE].astype(bool), DONE, "is True, but a stream never ends")
    new, rise = event.isin(SCENE_RESETS), frames[SEGMENTS_SINCE_RESET].diff()
    _expect(frames, (new & (frames[SEGMENTS_SINCE_RESET] == 0)) | (~new & (rise == first)), SEGMENTS_SINCE_RESET)
    helped = frames[INTERVENED].astype(bool)
    help_begins = helped & (begins | ~helped.shift(fill_value=False))
    least = event.isin(COUNTED_INTERVENTIONS).astype(int) + help_begins
    for name in (STREAM_INTERVENTIONS, TOTAL_INTERVENTIONS):
        rise = frames[name].diff().where(~begins, least)
        # Several kinds may come together; the frame carries the strongest. Other streams count at any time.
        may_rise = first | help_begins | (name == TOTAL_INTERVENTIONS)
        _expect(
            frames, (rise >= least) & (may_rise | (rise == 0)), name, "is not what the interventions add up to"
        )


def _expect(frames: pd.DataFrame, holds: pd.Series, name: str, what: str = "is wrong") -> None:
    """Raise a StreamError about the first frame where a column is not as it should be."""
    wrong = np.flatnonzero(~holds.to_numpy(bool))
    if len(wrong):
        row = frames.iloc[wrong[0]]
        raise StreamError(f"stream {row[STREAM_ID]}, step {row[STEP]}: {name} {what} ({row[name]})")
