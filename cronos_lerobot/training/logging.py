"""Metrics of a run: one JSON line per update and evaluation, TensorBoard, W&B, a progress bar, a manifest."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cronos_lerobot.protocol.loop_state import Event, LoopState, SegmentEnd, Step
from cronos_lerobot.provenance import git_commit, package_versions
from cronos_lerobot.training.config import CronosTrainConfig

METRICS = "metrics.jsonl"
MANIFEST = "manifest.json"


class RolloutStatistics:
    """Success and reward of the streams between two policy updates.

    Args:
        instructions: of the task set, in the order of its indices.
        num_tasks: how many of them are evaluated, the first ones; the rest are reset tasks. None is all.
    """

    def __init__(self, instructions: Sequence[str], num_tasks: int | None = None) -> None:
        self.instructions = list(instructions)
        self.num_tasks = len(self.instructions) if num_tasks is None else num_tasks
        self._clear()

    def on_event(self, event: Event) -> None:
        """Take in a Step or the end of a segment."""
        if isinstance(event, Step):
            self._reward += float(event.reward.sum())
            self._transitions += len(event.reward)
            self._diverged += int(event.diverged.sum())
        elif isinstance(event, SegmentEnd):
            segments = zip(event.task, event.position, event.success, event.found_complete, strict=True)
            for task, position, success, found in segments:
                self._count(self._by_task, self.instructions[task], success)
                if task < self.num_tasks:
                    self._count(self._by_position, str(position), success)
                    self._count(self._found_by_position, str(position), found)

    def pop(self) -> dict[str, Any]:
        """Return the statistics since the last `pop`, and begin anew.

        `success_by_segment` has one [successes, n] for each number of task switches since the scene reset,
        `success_by_task` one for each instruction. Learned reset tasks are in the latter only.
        `found_complete_by_segment` has [successes for which nothing had to be done, n].
        """
        segments = np.array(list(self._by_position.values()) or [[0, 0]]).sum(axis=0)
        all_segments = sum(n for _, n in self._by_task.values())
        positions = sorted(self._by_position.items(), key=lambda item: int(item[0]))
        statistics = {
            "success": float(segments[0] / segments[1]) if segments[1] else None,
            "segments": int(segments[1]),
            "success_by_segment": dict(positions),
            "found_complete_by_segment": {
                position: self._found_by_position[position] for position, _ in positions
            },
            "success_by_task": {task: self._by_task[task] for task in self.instructions if task in self._by_task},
            "reward_per_segment": self._reward / all_segments if all_segments else None,
            "diverged": self._diverged,
        }
        self._clear()
        return statistics

    def _clear(self) -> None:
        self._reward = 0.0
        self._transitions = 0
        self._diverged = 0
        self._by_task: dict[str, list[int]] = {}
        self._by_position: dict[str, list[int]] = {}
        self._found_by_position: dict[str, list[int]] = {}

    @staticmethod
    def _count(table: dict[str, list[int]], key: str, success: bool) -> None:
        counts = table.setdefault(key, [0, 0])
        counts[0] += int(success)
        counts[1] += 1


class MetricsFile:
    """A JSON-lines file that a resumed run continues without a line lost or doubled.

    Args:
        path: of the file; made if it is not there.
        offset: bytes to keep of an existing file, those that a checkpoint knows of; None keeps nothing.
    """

    def __init__(self, path: Path, offset: int | None = None) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab")
        self._file.truncate(offset or 0)
        self._file.seek(0, os.SEEK_END)

    def write(self, record: dict[str, Any]) -> None:
        """Append a line and hand it to the operating system."""
        self._file.write(json.dumps(_jsonable(record), allow_nan=False).encode() + b"\n")
        self._file.flush()

    def position(self) -> int:
        """Return the bytes written so far, on disk once this returns."""
        os.fsync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class RunLogger:
    """Sends records to metrics.jsonl, TensorBoard and W&B, and keeps the progress bar.

    Args:
        config: of the run; `output_dir` is set.
        loop: of the run, read for the counters.
        offset: of `state_dict()` when resuming.
    """

    def __init__(self, config: CronosTrainConfig, loop: LoopState, offset: int | None = None) -> None:
        assert config.output_dir is not None
        self.config = config
        self.loop = loop
        self.metrics = MetricsFile(Path(config.output_dir) / METRICS, offset)
        self._tensorboard = self._open_tensorboard(Path(config.output_dir)) if config.tensorboard else None
        self._wandb = self._open_wandb() if config.wandb.enable else None
        self._bar = tqdm(
            total=config.total_steps, initial=loop.n, unit="step", unit_scale=True, disable=None, mininterval=1.0
        )

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Log one record; `kind` is `update` or `evaluation`. The counters of the loop are added."""
        interventions = self.loop.interventions_by_kind()
        record = {
            "kind": kind,
            "interaction_steps": self.loop.n,
            "interventions": self.loop.b,
            "updates": self.loop.updates,
            "interventions_by_kind": interventions,
            "interventions_by_stream": self.loop.stream_interventions.tolist(),
            "time": time.time(),
        } | values
        self.metrics.write(record)
        scalars = _scalars(values | {"interventions": self.loop.b})
        mode = "eval" if kind == "evaluation" else "train"
        if self._tensorboard is not None:
            for name, value in scalars.items():
                self._tensorboard.add_scalar(f"{mode}/{name}", value, self.loop.n)
        if self._wandb is not None:
            self._wandb.log_dict(scalars, step=self.loop.n, mode=mode)

    def progress(self, values: dict[str, Any]) -> None:
        """Move the bar; `values` has `success` and `steps_per_s`. Without a terminal, print a line."""
        success = values.get("success")
        text = {
            "success": "-" if success is None else f"{success:.2f}",
            "interventions": self.loop.b,
            "steps/s": f"{values['steps_per_s']:.0f}",
        }
        if self._bar.disable:
            line = ", ".join(f"{name} {value}" for name, value in text.items())
            print(f"{self.loop.n}/{self.config.total_steps} steps: {line}", flush=True)
            return
        self._bar.set_postfix(text, refresh=False)
        self._bar.update(self.loop.n - self._bar.n)

    def log_checkpoint(self, folder: Path) -> None:
        """Send the policy to W&B, if that is on."""
        if self._wandb is not None:
            self._wandb.log_policy(folder)

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed run needs: the length of metrics.jsonl [bytes]."""
        return {"offset": self.metrics.position()}

    def close(self) -> None:
        """Close every sink."""
        self._bar.close()
        self.metrics.close()
        if self._tensorboard is not None:
            self._tensorboard.close()

    def _open_tensorboard(self, output_dir: Path) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        # Events past the checkpoint that the run resumes from are hidden.
        return SummaryWriter(str(output_dir / "tensorboard"), purge_step=self.loop.n or None)

    def _open_wandb(self) -> Any:
        from lerobot.common.wandb_utils import WandBLogger

        return WandBLogger(self.config)  # ty: ignore[invalid-argument-type]


class SilentLogger:
    """Stands in for RunLogger in every process but the first."""

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Log nothing."""

    def progress(self, values: dict[str, Any]) -> None:
        """Show nothing."""

    def log_checkpoint(self, folder: Path) -> None:
        """Send nothing."""

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: a checkpoint has the first process's."""
        return {}

    def close(self) -> None:
        """Nothing is open."""


def write_manifest(config: CronosTrainConfig, num_processes: int = 1) -> None:
    """Write what is needed to tell this run from another, once for each start, into manifest.json.

    A resumed run appends to `starts`, so that a change of machine or version in between is on record.
    """
    assert config.output_dir is not None
    path = Path(config.output_dir) / MANIFEST
    path.parent.mkdir(parents=True, exist_ok=True)
    starts = json.loads(path.read_text())["starts"] if path.exists() else []
    start = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seed": config.seed,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": {"python": platform.python_version()} | package_versions(),
        "git_commit": git_commit(),
        "machine": {"platform": platform.platform(), "cpu_count": os.cpu_count()},
        "num_processes": num_processes,
        "renderer": os.environ.get("MUJOCO_GL"),
        "policy_device": config.policy.device if config.policy else None,
        "config": config.to_dict(),
    }
    path.write_text(json.dumps({"starts": [*starts, start]}, indent=2))


def _jsonable(value: Any) -> Any:
    """Return `value` with NumPy scalars as Python's and numbers that JSON does not know as null."""
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _scalars(values: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Flatten nested records to the finite numbers in them; [successes, n] becomes a rate."""
    scalars: dict[str, float] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        if isinstance(value, dict):
            scalars |= _scalars(value, f"{key}/")
        elif isinstance(value, list) and "_by_" in prefix and value[1]:
            scalars[key] = value[0] / value[1]
        elif isinstance(value, int | float | np.number) and np.isfinite(value):
            scalars[key] = float(value)
    return scalars
