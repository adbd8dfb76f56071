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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from lerobot.utils.constants import REWARD
from lerobot_env_cronos.vector_env import GRASP_REWARD, SUCCESS_REWARD

from cronos_lerobot.agents.ppo.gae import compute_gae
from cronos_lerobot.data.origin import Origin
from cronos_lerobot.data.schema import STEP, STREAM_ID, SUCCESS, VALUE
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.ranges import check_ranges, ranged
from cronos_lerobot.whole_files import written_whole

PROGRESS, ADVANTAGE = "progress", "advantage"
WEIGHT_BY = (PROGRESS, ADVANTAGE)
"""What a weight comes from: how near a level of the reward is, or PPO's advantages."""
PROGRESS_GAMMA = 0.98
"""One step nearer to the success is 0.02 of progress: more than LeRobot's kappa, which 1 - 0.99 is not."""
ADVANTAGE_GAMMA, ADVANTAGE_LAMBDA = 0.99, 0.9
"""Where a recording does not say what its values were learned with: the defaults of `cronos-train`."""
COLUMN = "progress_sparse"
"""What LeRobot reads unless `--sample_weighting.head_mode` says otherwise."""
INDICES = ("index", "episode_index", "frame_index")
"""LeRobot's, which are in the file beside the progress."""
MADE_WITH = b"cronos"
"""Key of the file's metadata: how it was made, as JSON."""


@dataclass
class Weighting:
    """How progress is computed."""

    weight_by: str = ranged(PROGRESS, choices=WEIGHT_BY)
    """`progress`: how near the segment came to grasp and success; `advantage`: GAE of its rewards and values."""
    gamma: float | None = ranged(None, minimum=0, maximum=1)
    """Discount per control step, from 0 to 1; null is 0.98 for progress, and the run's for advantage."""
    gae_lambda: float | None = ranged(None, minimum=0, maximum=1)
    """Weight of the longer returns in an advantage, from 0 to 1; null is the run's."""

    def __post_init__(self) -> None:
        check_ranges(self)

    def discounts(self, origin: Origin) -> tuple[float, float]:
        """gamma and gae_lambda with numbers instead of null.

        Args:
            origin: of the recording.
        """
        if self.weight_by == PROGRESS:
            return PROGRESS_GAMMA if self.gamma is None else self.gamma, 0.0
        found = []
        for name, default in (("gamma", ADVANTAGE_GAMMA), ("gae_lambda", ADVANTAGE_LAMBDA)):
            given = getattr(self, name)
            found.append(float(origin.flags.get(f"algorithm.{name}", default)) if given is None else given)
        return found[0], found[1]


def write_progress(streams: StreamDataset, output: Path, weighting: Weighting) -> dict[str, Any]:
    """Write the parquet that LeRobot's RA-BC reads: `index`, `episode_index`, `frame_index`, `progress_sparse`.

    Args:
        streams: a recording, whole or filtered, here or on the Hub.
        output: the file, which appears when it is whole; one that is there is replaced.
        weighting: how.

    Returns:
        How it was made, which the file's metadata repeats: `dataset`, `weight_by`, `gamma` and, of advantages,
        `gae_lambda`.

    Raises:
        ValueError: rewards that do not fit the successes, or no value for every frame.
    """
    gamma, gae_lambda = weighting.discounts(streams.origin)
    made_with: dict[str, Any] = {"dataset": streams.repo_id, "weight_by": weighting.weight_by, "gamma": gamma}
    is_progress = weighting.weight_by == PROGRESS
    if not is_progress and VALUE not in streams.meta.features:
        raise ValueError(
            f"{streams.repo_id} has no {VALUE}: its agent has no critic; --weight_by={PROGRESS} needs none"
        )
    names = [*INDICES, STREAM_ID, STEP, REWARD, SUCCESS, *(() if is_progress else (VALUE,))]
    frames = pd.concat(streams.annotations(names)).sort_values("index", kind="stable")
    if is_progress:
        # What is not said is the default of `cronos-train`: LeRobot's tools drop it.
        rows = _progress_rows(frames, streams.origin.flags.get("protocol.reward", "difference"), gamma)
    else:
        made_with["gae_lambda"] = gae_lambda
        _check_values(frames)
        rows = [
            summed_advantages(rewards.astype(np.float64), values.astype(np.float64), gamma, gae_lambda)
            for rewards, values in _segments(frames, REWARD, VALUE)
        ]
    columns = {name: frames[name].to_numpy(np.int64) for name in INDICES}
    columns[COLUMN] = np.concatenate(rows).astype(np.float32)
    table = pa.table(columns).replace_schema_metadata({MADE_WITH: json.dumps(made_with).encode()})
    with written_whole(output, "wb") as file:
        pq.write_table(table, file)
    return made_with


def _progress_rows(frames: pd.DataFrame, reward: str, gamma: float) -> list[np.ndarray]:
    rows = []
    for rewards, successes, streams, steps in _segments(frames, REWARD, SUCCESS, STREAM_ID, STEP):
        levels = reward_levels(rewards.astype(np.float64), successes.astype(np.bool_), reward)
        if levels is None:
            raise ValueError(
                f"stream {streams[0]}, step {steps[0]}: the rewards are not those of --protocol.reward={reward}"
                f" ({GRASP_REWARD} grasped, {SUCCESS_REWARD} complete); --weight_by={ADVANTAGE} takes any reward"
            )
        rows.append(progress(levels, gamma))
    return rows


def _segments(frames: pd.DataFrame, *names: str) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns of one episode after the other."""
    begins = np.flatnonzero(np.diff(frames["episode_index"].to_numpy())) + 1
    return zip(*(np.split(frames[name].to_numpy(), begins) for name in names), strict=True)


def _check_values(frames: pd.DataFrame) -> None:
    values, episodes = frames[VALUE].to_numpy(), frames["episode_index"].to_numpy()
    instead = f"; --weight_by={PROGRESS} needs none"
    if bad := int((~np.isfinite(values)).sum()):
        raise ValueError(f"{VALUE} is not finite in {bad} of {len(values)} frames{instead}")
    # The value of a decision is recorded with each of its actions: two a decision repeat half of them. The flags
    # need not tell, as those of your own policy, and are lost with LeRobot's tools.
    # Before the first update a critic may say 0 of everything.
    within = (episodes[1:] == episodes[:-1]) & (values[1:] != 0)
    repeated = int((within & (values[1:] == values[:-1])).sum())
    if repeated > within.sum() / 3:
        raise ValueError(
            f"{VALUE} is that of the frame before in {repeated} of {within.sum()} frames: the policy played "
            f"several actions a decision, and advantages need a value of every frame{instead}"
        )


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
    """How near a segment's frames are to what it goes on to reach: max over u >= t of gamma^(u - t) levels[u].

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
    return _with_last_action(nearness)


def summed_advantages(rewards: np.ndarray, values: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """The advantages of a segment's actions before each frame, summed: a difference is those of a chunk's actions.

    The observation after the segment is not recorded, so its end is bootstrapped from the value of its last one,
    as PPO does at a divergence.

    Args:
        rewards: (T,) of each action.
        values: (T,) of each observation.
        gamma: discount per control step.
        gae_lambda: weight of the longer returns.

    Returns:
        (T,) in units of the reward; the last row is the sum with the last action's.
    """
    ends = np.zeros((len(rewards), 1), np.bool_)
    ends[-1] = True
    advantages, _ = compute_gae(rewards[:, None], values[:, None], ends, values[:, None], gamma, gae_lambda)
    return _with_last_action(np.concatenate([[0.0], np.cumsum(advantages[:, 0], dtype=np.float64)]))


def _with_last_action(moments: np.ndarray) -> np.ndarray:
    """Rows (T,) of the moments (T + 1,) of a segment: that before the last action is left out."""
    return np.append(moments[:-2], moments[-1])


def count_weights(path: Path, chunk_size: int) -> dict[str, int]:
    """How many frames get which weight, by LeRobot's own class with its default settings.

    Args:
        path: of `write_progress`.
        chunk_size: of the policy, in frames.

    Returns:
        Frames by weight, as text: 1, 0, and those between with their mean.
    """
    # Here, because it is slow to import and nothing else needs it.
    from lerobot.rewards.sarm.rabc import RABCWeights

    index = pq.read_table(path, columns=["index"])["index"].to_numpy()
    weighter = RABCWeights(path, chunk_size, device=torch.device("cpu"))
    _, stats = weighter.compute_batch_weights({"index": index})
    full, zero = stats["num_full_weight"], stats["num_zero_weight"]
    between = len(index) - full - zero
    mean = (stats["mean_weight"] * len(index) - full) / max(between, 1)
    return {"of weight 1": full, "of weight 0": zero, f"between, {mean:.2f} on average": between}
