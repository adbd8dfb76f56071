"""Hands the steps of the main loop to the StreamRecorder."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.loop_state import Step
from cronos_lerobot.training.config import CronosTrainConfig


class StreamObserver:
    """Records the streams of a run, or nothing at all.

    Args:
        recorder: writes the dataset; None records nothing.
    """

    def __init__(self, recorder: StreamRecorder | None) -> None:
        self._recorder = recorder

    @classmethod
    def open(cls, config: CronosTrainConfig, env: Any, state: dict[str, Any] | None) -> Self:
        """Begin the dataset of a run, or continue it from a checkpoint's `state`."""
        if config.record.repo_id is None:
            return cls(None)
        assert config.output_dir is not None
        recorder = StreamRecorder.open(
            env,
            config.record.repo_id,
            config.record.root or Path(config.output_dir) / "streams",
            segment_length=config.protocol.task_switch_interval,
            streams=config.record.num_streams,  # ty: ignore[invalid-argument-type]
            state=state,
        )
        return cls(recorder)

    def on_step(self, step: Step) -> None:
        """Record one control step of the streams."""
        if self._recorder is None:
            return
        self._recorder.on_step(
            step.observation,
            step.instructions,
            step.action.action,
            step.reward,
            step.success,
            step.action.log_prob,
            step.action.value,
            step.policy_version,
            interventions=step.preceded_by,
            stream_interventions=step.interventions,
            total_interventions=int(step.interventions.sum()),
            steps=np.full(len(step.reward), step.t),
            segments=step.segment,
            segment_ends=step.cut,
        )

    def state_dict(self) -> dict[str, Any] | None:
        """Flush, and return what `open` needs to continue."""
        return None if self._recorder is None else self._recorder.state_dict()

    def close(self) -> None:
        """Finish the dataset."""
        if self._recorder is not None:
            self._recorder.close()
