"""Training batches of remembered frames and of demonstrations, as `lerobot-train` would make them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import httpx
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_PREFIX, REWARD
from torch.utils.data import default_collate

from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.agents.imitation.memory import Segment, SegmentMemory
from cronos_lerobot.agents.processing import EMPTY_CAMERA
from cronos_lerobot.dataset_metadata import check_files_are_there, open_metadata


def segment_batch(draws: Sequence[tuple[Segment, int]], config: PreTrainedConfig) -> Batch:
    """Return what a LeRobotDataset, with each segment as an episode, gives a data loader for these frames.

    Args:
        draws: B segments, each with the index of a frame.
        config: of the policy; its delta indices say which frames around are wanted.

    Returns:
        Columns (B, ...), or (B, n, ...) and `<column>_is_pad` (B, n) where the config has n delta indices for it:
        beyond the segment's ends its first and last frames are repeated. Images are (3, H, W) floats in [0, 1].
        `task`, B strings.
    """
    batch: Batch = {"task": [segment.instruction for segment, _ in draws]}
    drawn = np.array([[frame] for _, frame in draws])
    ends = np.array([[len(segment)] for segment, _ in draws])
    for name in draws[0][0].columns:
        deltas = _delta_indices(name, config)
        if name == REWARD and deltas is None:
            continue
        wanted = drawn + np.array(deltas or [0])
        inside = np.clip(wanted, 0, ends - 1)
        parts = [segment.columns[name][rows] for (segment, _), rows in zip(draws, inside, strict=True)]
        column = _tensor(name, np.stack(parts))
        if deltas is None:
            batch[name] = column[:, 0]
            continue
        batch |= {name: column, f"{name}_is_pad": torch.from_numpy(wanted != inside)}
    return batch


class Demonstrations:
    """A LeRobotDataset to draw frames from.

    Of a policy that reads no pictures the columns lie in memory: a LeRobotDataset takes fifty times as long.

    Args:
        config: which one.
        policy: config of the policy that learns from it.

    Raises:
        ValueError: the dataset lacks a column that the policy reads, has it in another shape, cannot be read, or
            lacks a file in the folder that it is in.
        FileNotFoundError: there is no such dataset.
    """

    def __init__(self, config: DemosConfig, policy: PreTrainedConfig) -> None:
        meta = _open_metadata(config)
        if config.root is not None:
            check_files_are_there(meta, config.root)
        wanted = _check_columns(config, policy, meta.features)
        deltas = resolve_delta_timestamps(policy, meta)
        self._dataset = LeRobotDataset(meta.repo_id, root=config.root, delta_timestamps=deltas)
        drop_last = getattr(policy, "drop_n_last_frames", 0) or 0
        assert meta.episodes is not None
        ends = zip(meta.episodes["dataset_from_index"], meta.episodes["dataset_to_index"], strict=True)
        bounds = [(int(begin), int(end)) for begin, end in ends]
        self._frames = np.concatenate([np.arange(begin, max(begin, end - drop_last)) for begin, end in bounds])
        self._begins = np.array([begin for begin, _ in bounds])
        self._policy = policy
        self._episodes: list[Segment] = []
        if not any(name.startswith(OBS_IMAGES) for name in wanted):
            self._episodes = _read_episodes(self._dataset, sorted(wanted), bounds)

    def batch(self, count: int, rng: np.random.Generator) -> Batch:
        """Return `count` frames, drawn uniformly."""
        drawn = rng.choice(self._frames, size=count)
        if not self._episodes:
            return default_collate([self._dataset[int(index)] for index in drawn])
        numbers = np.searchsorted(self._begins, drawn, side="right") - 1
        frames = drawn - self._begins[numbers]
        draws = [(self._episodes[n], int(frame)) for n, frame in zip(numbers, frames, strict=True)]
        return segment_batch(draws, self._policy)


def _open_metadata(config: DemosConfig) -> LeRobotDatasetMetadata:
    assert config.repo_id is not None
    try:
        return open_metadata(config.repo_id, config.root)
    except (OSError, httpx.HTTPError) as error:
        raise FileNotFoundError(
            f"--algorithm.demos.repo_id={config.repo_id}, --algorithm.demos.root={config.root}: there is no "
            f"LeRobotDataset that can be read ({error})."
        ) from error


def _check_columns(config: DemosConfig, policy: PreTrainedConfig, features: Mapping[str, Any]) -> set[str]:
    """The columns that the policy learns from; a ValueError if one is not there, or does not fit.

    Images may have another size than the policy's own: policies scale them.
    """
    # LeRobot adds a camera that no dataset has, and the policy makes its picture.
    inputs = policy.input_features or {}
    taken = {name: feature for name, feature in inputs.items() if not name.startswith(EMPTY_CAMERA)}
    wanted = {*taken, ACTION} | ({REWARD} if policy.reward_delta_indices is not None else set())
    if missing := sorted(wanted - features.keys()):
        raise ValueError(
            f"--algorithm.demos.repo_id={config.repo_id} has no {', '.join(missing)}, which the policy reads; "
            f"it has {sorted(features)}."
        )
    for name, feature in sorted(taken.items()):
        has = tuple(features[name]["shape"])
        if feature is not None and not name.startswith(OBS_IMAGES) and tuple(feature.shape) != has:
            raise ValueError(
                f"--algorithm.demos.repo_id={config.repo_id} has {name} of shape {has}, the policy takes "
                f"{feature.shape}: record the demonstrations with the environment of the run, as with its "
                "--env.scene and --env.task_observation."
            )
    return wanted


def _read_episodes(dataset: LeRobotDataset, names: list[str], bounds: list[tuple[int, int]]) -> list[Segment]:
    """The columns `names` of each episode, which has the rows begin .. end - 1."""
    rows = dataset.hf_dataset.select_columns([*names, "task_index"]).with_format("numpy")[:]
    columns = {name: np.asarray(rows[name]) for name in names}
    assert dataset.meta.tasks is not None
    texts = dataset.meta.tasks.index
    return [
        Segment(
            str(texts[rows["task_index"][begin]]), {name: column[begin:end] for name, column in columns.items()}
        )
        for begin, end in bounds
    ]


def draw_batch(
    memory: SegmentMemory,
    demos: Demonstrations | None,
    demos_share: float,
    size: int,
    rng: np.random.Generator,
    config: PreTrainedConfig,
    weights: np.ndarray | None = None,
    *,
    has_success: bool = True,
) -> Batch | None:
    """Return `size` frames of a memory and, by a share, of demonstrations; None if there is nothing to draw.

    As long as nothing is remembered, or no success, all of them are of the demonstrations.

    Args:
        memory: own segments.
        demos: demonstrations, if there are any.
        demos_share: of the batch.
        size: frames.
        rng: draws them.
        config: of the policy.
        weights: see `SegmentMemory.draw`.
        has_success: whether a success is remembered, by any process.
    """
    num_demos, parts = 0, []
    if demos is not None:
        num_demos = round(demos_share * size) if has_success and len(memory) else size
    if demos is not None and num_demos:
        parts.append(demos.batch(num_demos, rng))
    if num_demos < size and len(memory):
        parts.append(segment_batch(memory.draw(size - num_demos, rng, weights), config))
    if not parts:
        return None
    batch = join_batches(*parts) if len(parts) == 2 else parts[0]
    # Frames that are remembered are no dataset's rows, but LeRobot's TD-MPC counts a batch by their numbers.
    return {"index": torch.arange(size)} | batch


def join_batches(first: Batch, second: Batch) -> Batch:
    """Return two batches as one, with the keys that both have."""
    joined: dict[str, Any] = {}
    for name in first.keys() & second.keys():
        a, b = first[name], second[name]
        joined[name] = torch.cat([a, b]) if isinstance(a, torch.Tensor) else [*a, *b]
    return joined


def _delta_indices(name: str, config: PreTrainedConfig) -> list[int] | None:
    if name.startswith(OBS_PREFIX):
        return config.observation_delta_indices
    return config.action_delta_indices if name == ACTION else config.reward_delta_indices


def _tensor(name: str, column: np.ndarray) -> torch.Tensor:
    tensor = torch.from_numpy(column)
    if name.startswith(OBS_IMAGES):
        return tensor.movedim(-1, -3).float().div_(255)
    return tensor.float()
