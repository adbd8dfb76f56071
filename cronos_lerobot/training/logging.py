"""Metrics of a run: one JSON line per update and evaluation, TensorBoard, W&B, a progress bar."""

from __future__ import annotations

import json
import os
import time
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.utils import flatten_dict
from tqdm import tqdm

from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.rollout import Count
from cronos_lerobot.training.run_folder import METRICS, TENSORBOARD


class MetricsFile:
    """A JSON-lines file that a resumed run continues without a line lost or doubled.

    Args:
        path: of the file; made if it is not there.
        offset: bytes to keep of an existing file, those that a checkpoint knows of; None keeps nothing.

    Raises:
        ValueError: the file has fewer bytes than that, or is gone.
    """

    def __init__(self, path: Path, offset: int | None = None) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        size = path.stat().st_size if path.is_file() else 0
        if size < (offset or 0):
            raise ValueError(
                f"{path} has {size} bytes, {offset} when the checkpoint was made: put it back, or begin a new run "
                "with the checkpoint as --policy.path."
            )
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
        state: of `state_dict()` when resuming.
    """

    def __init__(self, config: CronosTrainConfig, loop: LoopState, state: dict[str, Any] | None = None) -> None:
        self.config = config
        self.loop = loop
        output_dir = Path(config.output_dir or "")
        self.metrics = MetricsFile(output_dir / METRICS, (state or {}).get("offset"))
        self._tensorboard = self._open_tensorboard(output_dir) if config.tensorboard else None
        self._wandb = self._open_wandb(output_dir) if config.wandb.enable else None
        self._bar = tqdm(
            total=config.total_steps, initial=loop.n, unit="step", unit_scale=True, disable=None, mininterval=1.0
        )

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Log one record; `kind` is `update`, `evaluation`, `end` and the like. The loop's counters are added."""
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
        if kind == "evaluation":
            self._say(
                "evaluation, {split}: {success:.3f} [{ci95[0]:.3f}, {ci95[1]:.3f}], n = {n}, after "
                "{interaction_steps:,} steps and {interventions:,} interventions".format(**record)
            )
        scalars = _scalars(values | {"interventions": self.loop.b})
        mode = "eval" if kind == "evaluation" else "train"
        if self._tensorboard is not None:
            for name, value in scalars.items():
                self._tensorboard.add_scalar(f"{mode}/{name}", value, self.loop.n)
        if self._wandb is not None:
            self._wandb.log_dict(scalars, step=self.loop.n, mode=mode)

    def _say(self, line: str) -> None:
        """Print a line, above the bar where there is one."""
        # A run whose terminal or pipe is gone continues, and saves.
        with suppress(OSError), self._bar.external_write_mode():
            print(line, flush=True)

    def progress(self, values: dict[str, Any]) -> None:
        """Move the bar, or print a line; `values` has `steps_per_s` and rates, None where unknown."""
        rates = {name.replace("_", " "): rate for name, rate in values.items() if name != "steps_per_s"}
        text = {name: "-" if rate is None else f"{rate:.2f}" for name, rate in rates.items()} | {
            "interventions": self.loop.b,
            "steps/s": f"{values['steps_per_s']:.0f}",
        }
        if self._bar.disable:
            line = ", ".join(f"{name} {value}" for name, value in text.items())
            self._say(f"{self.loop.n}/{self.config.total_steps} steps: {line}")
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

        # Events past the checkpoint that the run resumes from are hidden, those at it are not.
        purge_step = self.loop.n + 1 if self.loop.n else None
        return SummaryWriter(str(output_dir / TENSORBOARD), purge_step=purge_step)

    def _open_wandb(self, output_dir: Path) -> Any:
        from lerobot.common.wandb_utils import WandBLogger

        config = copy(self.config)
        has_folder = (output_dir / "wandb").is_dir()
        # A run that was not logged there before has nothing to resume there.
        config.resume = config.checkpoint_path is not None and (has_folder or config.wandb.run_id is not None)
        return WandBLogger(config)  # ty: ignore[invalid-argument-type]


class SilentLogger:
    """Stands in for RunLogger in every process but the first, and logs nothing."""

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Log nothing."""

    progress = log_checkpoint = lambda self, _: None
    close = lambda self: None  # noqa: E731
    state_dict = lambda self: {}  # noqa: E731


def _jsonable(value: Any) -> Any:
    """Return `value` with NumPy scalars as Python's and numbers that JSON does not know as null."""
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _scalars(values: dict[str, Any]) -> dict[str, float]:
    """The finite numbers in nested records by their paths; a Count becomes its rate."""
    flat = flatten_dict(values)
    numbers = {name: value.rate if isinstance(value, Count) else value for name, value in flat.items()}
    return {
        name: float(value)
        for name, value in numbers.items()
        if isinstance(value, int | float | np.number) and np.isfinite(value)
    }
