"""Hands the steps of the main loop to the StreamRecorder; a recording that fails does not stop the run."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.envs.utils import parse_camera_names
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.data.origin import flags_of
from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.writer import LateCamera, RecordingError
from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.training.sharding import FILM

if TYPE_CHECKING:
    from cronos_lerobot.training.run import Run

MADE_WITH = ("env", "num_envs", "seed", "protocol", "algorithm", "policy")
"""Parts of the run's config that its datasets repeat."""


class FilmedEnv:
    """An environment whose observations also hold the states of its first streams, to draw them from later.

    Args:
        env: the streams.
        num_streams: how many of them to film.
    """

    def __init__(self, env: Any, num_streams: int) -> None:
        self._env = env
        self._streams = np.arange(num_streams)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def observe(self) -> dict[str, Any]:
        """The observation of all streams, and the states."""
        return self._film(self._env.observe())

    def step(self, actions: np.ndarray) -> tuple:
        """Step all streams, see `CronosVectorEnv.step`."""
        observation, *outcome = self._env.step(actions)
        return (self._film(observation), *outcome)

    def _film(self, observation: dict[str, Any]) -> dict[str, Any]:
        return observation | {FILM: self._env.positions(self._streams)}


class StreamObserver:
    """Records the streams of a run, in its first process, or nothing at all.

    When writing fails (a full disk, say) that recording ends where it was last flushed, and the run goes on.

    Args:
        run: whose streams they are.
        state: of `state_dict` in the checkpoint that the run resumes from; None begins the datasets.
        report: called with the name and the reason when a recording ends early.

    Raises:
        ValueError: a recording is of another run, or shorter than the checkpoint left it.
        OSError: it cannot be written, or another process has it.
    """

    def __init__(self, run: Run, state: dict[str, Any] | None, report: Callable[[dict[str, str]], None]) -> None:
        record, state = run.config.record, state or {}
        self._recorders: dict[str, StreamRecorder] = {}
        self._stopped = dict(state.get("stopped", {}))
        self._report = report
        if record.repo_id is None or not run.ranks.is_main:
            return
        root = Path(record.root or Path(run.config.output_dir or "") / "streams")
        datasets: dict[str, tuple[str, dict[str, Any]]] = {
            "streams": ("", {"streams": record.count(run.config.num_envs)})
        }
        if record.filmed_streams:
            datasets[FILM] = self._film(run)
        for name, (suffix, options) in datasets.items():
            if name in self._stopped:
                logging.warning(
                    f"The recording {name!r} ended before the checkpoint and is not resumed: {self._stopped[name]}"
                )
                continue
            self._recorders[name] = StreamRecorder.open(
                run.env,
                record.repo_id + suffix,
                root.with_name(root.name + suffix),
                segment_length=run.config.protocol.task_switch_interval,
                describes=run.agent.describes,
                state=state.get(name),
                flags=flags_of(run.config, only=MADE_WITH),
                flush_interval_s=record.flush_interval_s,
                **options,
            )

    def _film(self, run: Run) -> tuple[str, dict[str, Any]]:
        """What the filmed dataset's name ends with, and how it is recorded."""
        env = run.config.env
        assert isinstance(env, CronosEnvConfig)
        height, width = env.render_size
        self._camera = parse_camera_names(env.camera_name)[0]
        num_positions = run.env.positions(np.arange(1)).shape[1]
        camera = LateCamera(height, width, num_positions, run.env.render_positions)
        options = {"streams": run.config.record.filmed_streams, "cameras": {self._camera: camera}}
        return f"_{width}x{height}", options

    def on_step(self, step: Step) -> None:
        """Record one control step of the streams."""
        for name in list(self._recorders):
            self._try(name, lambda recorder, name=name: self._record(recorder, name, step))

    def state_dict(self) -> dict[str, Any]:
        """Flush, and return what `open` needs to continue."""
        states = {name: self._try(name, StreamRecorder.state_dict) for name in list(self._recorders)}
        return {name: states[name] for name in self._recorders} | {"stopped": self._stopped}

    def close(self) -> None:
        """Finish the datasets."""
        for name in list(self._recorders):
            self._try(name, StreamRecorder.close)
        for name, reason in self._stopped.items():
            logging.warning(f"The recording {name!r} of this run is not complete: {reason}")

    def _record(self, recorder: StreamRecorder, name: str, step: Step) -> None:
        if name == FILM:
            observation = {key: value for key, value in step.observation.items() if key not in ("pixels", FILM)}
            observation["pixels"] = {self._camera: step.observation[FILM]}
            step = replace(step, observation=observation)
        recorder.on_step(step)

    def _try(self, name: str, use: Callable[[StreamRecorder], Any]) -> Any:
        """Use a recorder; if it fails, do without it from now on."""
        try:
            return use(self._recorders[name])
        except RecordingError as error:
            recorder = self._recorders.pop(name)
            reason = f"{error}; {recorder.writer.num_episodes} segments are safe"
            self._stopped[name] = reason
            logging.warning(f"RECORDING STOPPED, the training goes on without it: {reason}")
            self._report({"recording": name, "reason": reason})
            return None
