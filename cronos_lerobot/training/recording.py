"""Hands the steps of the main loop to the StreamRecorder; a recording that fails does not stop the run."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from lerobot.envs.utils import parse_camera_names
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.data.origin import flags_of
from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.writer import LateCamera, RecordingError
from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.training.config import CronosTrainConfig

MADE_WITH = ("env", "num_envs", "seed", "protocol", "algorithm", "policy")
"""Parts of the run's config that its datasets repeat."""
FILM = "film"
"""Key of the filmed streams' states in an observation, from which the writer draws; policies never see it."""


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
    """Records the streams of a run, or nothing at all.

    When writing fails (a full disk, say) that recording ends where it was last flushed, and the run goes on.

    Args:
        recorders: write the datasets, by name; the name FILM takes the filmed streams. None records nothing.
        camera: what the filmed camera is called.
        stopped: why recordings have ended early, by name.
        report: called with the name and the reason when a recording ends early.
    """

    def __init__(
        self,
        recorders: dict[str, StreamRecorder] | None,
        camera: str = "",
        stopped: dict[str, str] | None = None,
        report: Callable[[dict[str, str]], None] | None = None,
    ) -> None:
        self._recorders = recorders or {}
        self._camera = camera
        self._stopped = dict(stopped or {})
        self._report = report
        for name, reason in self._stopped.items():
            logging.warning(f"The recording {name!r} ended before the checkpoint and is not resumed: {reason}")

    @classmethod
    def open(
        cls,
        config: CronosTrainConfig,
        env: Any,
        state: dict[str, Any] | None,
        report: Callable[[dict[str, str]], None] | None = None,
        describes: tuple[str, ...] = (),
    ) -> Self:
        """Begin the datasets of a run, or continue them from a checkpoint's `state`.

        `describes` names what the agent says of its actions, see `LearningAgent`.
        """
        record, state = config.record, state or {}
        if record.repo_id is None:
            return cls(None)
        assert config.output_dir is not None
        root = record.root_in(Path(config.output_dir))
        num_recorded = record.count(config.num_envs)
        stopped = state.get("stopped", {})
        recorders = {}
        common: dict[str, Any] = {
            "segment_length": config.protocol.task_switch_interval,
            "describes": describes,
            "flush_interval_s": record.flush_interval_s,
            "flags": flags_of(config, only=MADE_WITH),
        }
        camera = ""
        if "streams" not in stopped:
            recorders["streams"] = StreamRecorder.open(
                env, record.repo_id, root, streams=num_recorded, state=state.get("streams"), **common
            )
        if record.filmed_streams and FILM not in stopped:
            assert isinstance(config.env, CronosEnvConfig)
            camera = parse_camera_names(config.env.camera_name)[0]
            height, width = config.env.render_size
            num_positions = env.positions(np.arange(1)).shape[1]
            suffix = record.film_suffix(config.env.render_size)
            recorders[FILM] = StreamRecorder.open(
                env,
                record.repo_id + suffix,
                root.with_name(root.name + suffix),
                streams=record.filmed_streams,
                cameras={camera: LateCamera(height, width, num_positions, env.render_positions)},
                state=state.get(FILM),
                **common,
            )
        return cls(recorders, camera, stopped, report)

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
            if self._report is not None:
                self._report({"recording": name, "reason": reason})
            return None
