"""Hands the steps of the main loop to the StreamRecorder; a recording that fails does not stop the run."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cronos_lerobot.data.origin import flags_of
from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.writer import RecordingError
from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.training.run_folder import STREAMS

if TYPE_CHECKING:
    from cronos_lerobot.training.run import Run

MADE_WITH = ("env", "num_envs", "seed", "protocol", "algorithm", "policy")
"""Parts of the run's config that its recording repeats."""


class StreamObserver:
    """Records the streams of a run, in its first process, or nothing at all.

    When writing fails (a full disk, say) the recording ends where it was last flushed, and the run continues.

    Args:
        run: whose streams they are.
        state: of `state_dict` in the checkpoint that the run resumes from; None begins the dataset.
        report: called with the reason when the recording ends early.

    Raises:
        ValueError: the recording is of another run, or shorter than the checkpoint left it.
        OSError: it cannot be written, or another process has it.
    """

    def __init__(self, run: Run, state: dict[str, Any] | None, report: Callable[[str], None]) -> None:
        record, state = run.config.record, state or {}
        self._recorder: StreamRecorder | None = None
        self._stopped: str = state.get("stopped", "")
        self._report = report
        if record.repo_id is None or not run.ranks.is_main:
            return
        if self._stopped:
            logging.warning(f"The recording ended before the checkpoint and is not resumed: {self._stopped}")
            return
        self._recorder = StreamRecorder.open(
            run.env,
            record.repo_id,
            record.root or Path(run.config.output_dir or "") / STREAMS,
            segment_length=run.config.protocol.task_switch_interval,
            streams=record.count(run.config.num_envs),
            describes=run.agent.describes,
            state=state.get(STREAMS),
            flags=flags_of(run.config, only=MADE_WITH),
            flush_interval_s=record.flush_interval_s,
        )

    def on_step(self, step: Step) -> None:
        """Record one control step of the streams."""
        self._try(lambda recorder: recorder.on_step(step))

    def state_dict(self) -> dict[str, Any]:
        """Flush, and return what `open` needs to continue."""
        state = self._try(StreamRecorder.state_dict)
        return ({} if state is None else {STREAMS: state}) | {"stopped": self._stopped}

    def close(self) -> None:
        """Finish the dataset."""
        self._try(StreamRecorder.close)
        if self._stopped:
            logging.warning(f"The recording of this run is not complete: {self._stopped}")

    def _try(self, use: Callable[[StreamRecorder], Any]) -> Any:
        """Use the recorder, if there is one; if it fails, do without it from now on."""
        if self._recorder is None:
            return None
        try:
            return use(self._recorder)
        except RecordingError as error:
            self._stopped = f"{error}; {self._recorder.writer.num_episodes} segments are safe"
            self._recorder = None
            logging.warning(f"RECORDING STOPPED, the training continues without it: {self._stopped}")
            self._report(self._stopped)
            return None
