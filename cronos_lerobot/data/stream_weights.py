"""Progress of every recorded frame, as LeRobot's `--sample_weighting.type=rabc` reads it from a parquet file.

RA-BC (Chen et al., SARM, 2025, https://arxiv.org/abs/2509.25358, equations 8 and 9) weighs a frame's loss by how
much progress grows over the action chunk that begins there. LeRobot takes the *difference* of two rows of one
episode, `progress[min(t + chunk_size, T - 1)] - progress[t]`. An episode of ours is a segment, so no difference
reaches across a task switch, a reset or a divergence.

A row stands for the moment before the frame's action, so that the difference is what the chunk's actions did. Only
the last row stands for the moment after it: its own difference is 0 whatever it holds, and the others would never
see what the last action brought.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.utils.constants import REWARD
from lerobot_env_cronos.vector_env import GRASP_REWARD, SUCCESS_REWARD

from cronos_lerobot.data.schema import STEP, STREAM_ID, SUCCESS
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.whole_files import written_whole

GAMMA = 0.98
"""One step nearer to the success is 0.02 of progress: more than LeRobot's kappa, which 1 - 0.99 is not."""
COLUMN = "progress_sparse"
"""What LeRobot reads unless `--sample_weighting.head_mode` says otherwise."""
INDICES = ("index", "episode_index", "frame_index")
"""LeRobot's, which are in the file beside the progress."""
MADE_WITH = b"cronos"
"""Key of the file's metadata: how it was made, as JSON."""


def write_progress(streams: StreamDataset, output: Path, gamma: float = GAMMA) -> None:
    """Write the parquet that LeRobot's RA-BC reads: `index`, `episode_index`, `frame_index`, `progress_sparse`.

    Its metadata says how it was made: `dataset` and `gamma`.

    Args:
        streams: a recording, whole or filtered, here or on the Hub.
        output: the file, which appears when it is whole; one that is there is replaced.
        gamma: discount per control step.

    Raises:
        ValueError: rewards that do not fit the successes.
    """
    names = [*INDICES, STREAM_ID, STEP, REWARD, SUCCESS]
    frames = pd.concat(streams.annotations(names)).sort_values("index", kind="stable")
    # What is not said is the default of `cronos-train`: LeRobot's tools drop it.
    rows = _progress_rows(frames, streams.origin.flags.get("protocol.reward", "difference"), gamma)
    columns = {name: frames[name].to_numpy(np.int64) for name in INDICES}
    columns[COLUMN] = np.concatenate(rows).astype(np.float32)
    made_with = json.dumps({"dataset": streams.repo_id, "gamma": gamma})
    table = pa.table(columns).replace_schema_metadata({MADE_WITH: made_with.encode()})
    with written_whole(output, "wb") as file:
        pq.write_table(table, file)


def _progress_rows(frames: pd.DataFrame, reward: str, gamma: float) -> list[np.ndarray]:
    rows = []
    for rewards, successes, streams, steps in _segments(frames, REWARD, SUCCESS, STREAM_ID, STEP):
        levels = reward_levels(rewards.astype(np.float64), successes.astype(np.bool_), reward)
        if levels is None:
            raise ValueError(
                f"stream {streams[0]}, step {steps[0]}: the rewards are not those of --protocol.reward={reward}"
                f" ({GRASP_REWARD} grasped, {SUCCESS_REWARD} complete)"
            )
        rows.append(progress(levels, gamma))
    return rows


def _segments(frames: pd.DataFrame, *names: str) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns of one episode after the other."""
    begins = np.flatnonzero(np.diff(frames["episode_index"].to_numpy())) + 1
    return zip(*(np.split(frames[name].to_numpy(), begins) for name in names), strict=True)


def reward_levels(rewards: np.ndarray, successes: np.ndarray, reward: str) -> np.ndarray | None:
    """The reward level at every moment of a segment: before each action, and after the last one.

    Args:
        rewards: (T,) of each action.
        successes: (T,) bool, the task was complete after it.
        reward: `difference` or `level`, as `--protocol.reward`.

    Returns:
        (T + 1,) of 0, 0.1 (grasped) and 1 (complete), or None if there are no such levels. A grasp that a segment
        began with and kept to its end shows in no difference of levels, and counts as none.
    """
    if reward == "level":
        before, after = 0.0, rewards
    else:
        gained = np.cumsum(rewards)
        before = SUCCESS_REWARD - gained[successes.argmax()] if successes.any() else _lowest_start(gained)
        after = before + gained
    levels = np.round([before, *after], 1)
    is_level = np.isin(levels, np.round([0, GRASP_REWARD, SUCCESS_REWARD], 1))
    if not is_level.all() or ((levels[1:] == SUCCESS_REWARD) != successes).any():
        return None
    if successes[0]:
        # Found complete: no task can be done in one step.
        levels[0] = SUCCESS_REWARD
    return levels


def _lowest_start(gained: np.ndarray) -> float:
    """The lowest level from which what a segment without success gained leads to levels alone; 0 if none does."""
    starts = (0.0, GRASP_REWARD, SUCCESS_REWARD)
    valid = [start for start in starts if np.isin(np.round(start + gained, 1), np.round(starts, 1)).all()]
    return valid[0] if valid else 0.0


def progress(levels: np.ndarray, gamma: float) -> np.ndarray:
    """How near a segment's frames are to what it reaches later: max over u >= t of gamma^(u - t) levels[u].

    Args:
        levels: (T + 1,) of `reward_levels`.
        gamma: discount per control step.

    Returns:
        (T,) in [0, 1]: 1 while the task is complete, gamma^n at n actions before that, the same times 0.1 for a
        grasp with no success after it, 0 where neither follows. The last row is the level after the last action.
    """
    nearness = levels.copy()
    for t in reversed(range(len(nearness) - 1)):
        nearness[t] = max(levels[t], gamma * nearness[t + 1])
    # The row before the last action is left out.
    return np.append(nearness[:-2], nearness[-1])
