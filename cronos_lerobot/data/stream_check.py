"""Checks that recorded streams are whole: every step once, every annotation where it belongs."""

import numpy as np
import pandas as pd
from lerobot.utils.constants import DONE

from cronos_lerobot.data.schema import (
    EXPERT,
    INTERVENTION,
    POSITION,
    SEGMENT_INDEX,
    STEP,
    STREAM_ID,
    STREAM_INTERVENTIONS,
    TOTAL_INTERVENTIONS,
    TRUNCATED,
)
from cronos_lerobot.protocol.config import COUNTED_INTERVENTIONS
from cronos_lerobot.protocol.interventions import Intervention

COLUMNS = (
    "index", "episode_index", "frame_index", STREAM_ID, STEP, SEGMENT_INDEX, POSITION, INTERVENTION,
    STREAM_INTERVENTIONS, TOTAL_INTERVENTIONS, DONE, TRUNCATED,
)  # fmt: skip
"""What a check reads of every frame, beside EXPERT where it was recorded."""


SCENE_RESETS = (Intervention.INITIAL, Intervention.SCENE_RESET, Intervention.DIVERGENCE)
"""After these the whole scene is new."""


class StreamError(ValueError):
    """A recorded stream is not whole."""


def check(frames: pd.DataFrame, total_frames: int, total_episodes: int, *, is_finished: bool = True) -> None:
    """Check every frame's place in its stream.

    - LeRobot's indices count frames and episodes without a gap, and an episode is one segment of one stream.
    - The steps of each stream go from 0 up by 1, its segments too.
    - An intervention stands on the first frame of every segment and on no other, INITIAL on step 0 alone.
    - The counts of interventions never fall, and rise where one that counts stands or an expert takes over.
    - An expert did all of a segment or nothing of it.
    - The last frame of a segment that another one follows is truncated, no other is, and none is done.
    - The position is 0 after a scene reset and rises by 1 at every other segment.
    - All streams of a finished recording end at the same step: they step together.

    Args:
        frames: the columns `COLUMNS` and perhaps EXPERT of a whole recording, in LeRobot's order; a filtered one
            has gaps.
        total_frames: as `info.json` counts them.
        total_episodes: the same.
        is_finished: whether the recording was not killed and does not go on.

    Raises:
        StreamError: names the stream, the step and what is wrong there.
    """
    if len(frames) != total_frames:
        raise StreamError(f"the data files hold {len(frames)} frames, info.json counts {total_frames}")
    if EXPERT not in frames:
        frames = frames.assign(**{EXPERT: False})
    _expect(frames, frames["index"] == np.arange(len(frames)), "its index is not its row, {index}")
    _check_episodes(frames, total_episodes)
    ids = frames[STREAM_ID].unique()
    if missing := sorted(set(range(int(ids.max()) + 1)) - set(ids.tolist())):
        raise StreamError(f"the streams {missing} are missing; recorded are the first ones up to {ids.max()}")
    for _, stream in frames.groupby(STREAM_ID, sort=True):
        _check_stream(stream.sort_values(STEP, kind="stable").reset_index(drop=True))
    if is_finished:
        _check_ends(frames)


def _check_episodes(frames: pd.DataFrame, total: int) -> None:
    first = frames["frame_index"] == 0
    _expect(frames, frames["episode_index"] == first.cumsum() - 1, "it is in episode {episode_index}")
    if (count := int(first.sum())) != total:
        raise StreamError(f"the data files hold {count} episodes, info.json counts {total}")
    same = frames[[STREAM_ID, SEGMENT_INDEX]].diff().eq(0).all(axis=1)
    _expect(frames, first | same, "segment {cronos.segment_index} begins inside episode {episode_index}")
    follows = frames[STEP].diff().eq(1) & frames["frame_index"].diff().eq(1)
    _expect(frames, first | follows, "it does not follow the frame before it in episode {episode_index}")


def _check_stream(frames: pd.DataFrame) -> None:
    step, before = frames[STEP].to_numpy(), np.arange(len(frames))
    twice = np.flatnonzero(np.diff(step) == 0)
    if len(twice):
        raise StreamError(f"{_place(frames, twice[0] + 1)}: it is there twice")
    if (gaps := np.flatnonzero(step != before)).size:
        at = int(gaps[0])
        missing = f"{at}" if step[at] == at + 1 else f"{at} to {step[at] - 1}"
        raise StreamError(f"stream {frames[STREAM_ID][0]}: step {missing} is missing")
    first = frames["frame_index"] == 0
    _expect(frames, frames[SEGMENT_INDEX] == first.cumsum() - 1, "it is in segment {cronos.segment_index}")
    kind = frames[INTERVENTION]
    _expect(
        frames, (kind != Intervention.NONE) == first, "intervention {cronos.intervention} on frame {frame_index}"
    )
    _expect(frames, (kind == Intervention.INITIAL) == (before == 0), "intervention {cronos.intervention}")
    last = first.shift(-1, fill_value=False)
    # The recording may end with a segment or inside one.
    is_cut = frames[TRUNCATED].astype(bool)
    _expect(frames, (is_cut == last) | (before == len(frames) - 1), "next.truncated is {next.truncated}")
    _expect(frames, ~frames[DONE].astype(bool), "next.done is {next.done}, a stream never ends")
    new = kind.isin(SCENE_RESETS)
    rise = frames[POSITION].diff()
    holds = new & (frames[POSITION] == 0) | ~new & ((rise == 1) & first | (rise == 0) & ~first)
    _expect(frames, holds, "cronos.position is {cronos.position}")
    expert = frames[EXPERT].astype(bool)
    _expect(frames, first | (expert == expert.shift(fill_value=False)), "intervention is {intervention}")
    # A scene that broke down inside a takeover begins another piece of it, not another takeover.
    least = kind.isin(COUNTED_INTERVENTIONS).astype(int) + (first & expert & (kind != Intervention.DIVERGENCE))
    for name in (STREAM_INTERVENTIONS, TOTAL_INTERVENTIONS):
        rise = frames[name].diff().fillna(0)
        # Several kinds may come together; the frame carries the strongest. Other streams count at any time.
        may_rise = first | (name == TOTAL_INTERVENTIONS)
        holds = (rise >= least) & (may_rise | (rise == 0))
        _expect(frames, holds, f"{name} is {{{name}}}, not what the interventions add up to")


def _check_ends(frames: pd.DataFrame) -> None:
    # A flush writes the segments that have ended by then, of some streams one more than of others.
    steps = frames.groupby(STREAM_ID).size()
    shortest, longest = steps.idxmin(), steps.idxmax()
    if steps[shortest] < steps[longest]:
        raise StreamError(
            f"stream {shortest} ends after {steps[shortest]} steps, stream {longest} after {steps[longest]}: the"
            " recording broke off, goes on or was filtered"
        )


def _expect(frames: pd.DataFrame, holds: pd.Series, message: str) -> None:
    """Raise a StreamError about the first frame where something does not hold."""
    wrong = np.flatnonzero(~holds.to_numpy(bool))
    if len(wrong):
        values = {name: frames[name].iloc[wrong[0]] for name in frames.columns}
        text = message
        for name, value in values.items():
            text = text.replace("{" + name + "}", str(value))
        raise StreamError(f"{_place(frames, wrong[0])}: {text}")


def _place(frames: pd.DataFrame, row: int) -> str:
    return f"stream {frames[STREAM_ID].iloc[row]}, step {frames[STEP].iloc[row]}"
