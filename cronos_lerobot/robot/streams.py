"""A robot as `Streams`: one stream that is really there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from PIL import Image

from cronos_lerobot.robot.judges import Judge
from cronos_lerobot.robot.person import Events
from cronos_lerobot.robot.station import FAULTS, Station, is_done, picture_file

TRAINING, EVALUATION = "training", "evaluation"


class Identity(NamedTuple):
    """See `EnvIdentity`."""

    id: str
    fingerprint: str
    source: str


class RobotStreams:
    """`Streams` with N = 1 over a LeRobot robot. A control step takes the time that it takes.

    A lost camera or bus, and an emergency stop, are `diverged`: nothing is learned from that segment's rest, and
    the scene reset that follows waits for the person.

    Args:
        station: the robot, shared with other streams.
        judge: says whether the task is complete.
        by_whom: the judge in words, for recordings and results.
        purpose: `training` or `evaluation`; the ledger counts them apart.
        told: names of the task's numbers in `agent_pos`; none if the task is not told there.
    """

    num_envs = 1

    def __init__(
        self, station: Station, judge: Judge, by_whom: str, purpose: str, told: Sequence[str] = ()
    ) -> None:
        self.station, self._judge, self.purpose = station, judge, purpose
        setup = station.setup
        self.fps, self.robot_type = station.fps, station.robot.name
        self.tasks, self.reset_tasks = setup.tasks, setup.reset_tasks
        self.num_starts = setup.starts
        self.identity = Identity(f"cronos_robot/{setup.name}-v1", setup.fingerprint, f"{setup.name}, {by_whom}")
        self.state_names, self.action_names = [*station.state_names, *told], station.action_names
        self.single_action_space = spaces.Box(setup.low, setup.high, dtype=np.float32)
        numbers = {"agent_pos": self.state_names, "environment_state": station.other_names}
        shown: dict[str, spaces.Space] = {
            name: spaces.Box(-np.inf, np.inf, (len(names),), np.float32)
            for name, names in numbers.items()
            if names
        }
        if station.cameras:
            pictures: dict[str, Any] = {
                name: spaces.Box(0, 255, shape, np.uint8) for name, shape in station.cameras.items()
            }
            shown["pixels"] = spaces.Dict(pictures)
        self.single_observation_space = spaces.Dict(shown)
        self._task = self.tasks[0]
        self._seen: Mapping[str, Any] = {}
        self._success = False
        self._helping: float | None = None
        self._wanted: tuple[int, str] | None = None
        station.open()

    @property
    def folder(self) -> Path | None:
        """Of the run or evaluation: pictures of the starts, and the ledger."""
        return self.station.person.folder

    @folder.setter
    def folder(self, folder: Path | None) -> None:
        self.station.person.folder = folder

    def set_task(self, ids: Iterable[int], tasks: Sequence[Any]) -> None:
        """A segment begins."""
        self._place()
        self._task, self._success = next(iter(tasks)), False
        self._judge.begin(self._task)
        self.station.person.tell(task=self._task.instruction)
        print(f"Task: {self._task.instruction}", flush=True)
        self._look()
        if self.station.dry_run and self.folder is not None:
            for camera in self.station.cameras:
                Image.fromarray(self._seen[camera]).save(self.folder / f"dry_run_{camera}.png")
        self.station.begin()

    def observe(self, ids: np.ndarray | None = None) -> dict[str, Any]:
        """What was last seen, with one row for each of `ids`."""
        self._place()
        rows = 1 if ids is None else len(ids)
        if not self._seen:
            self._look()
        setup = self.station.setup
        numbers = {**self._seen, **dict(zip(setup.task_names, setup.tell(self._task), strict=True))}
        names = {"agent_pos": self.state_names, "environment_state": self.station.other_names}
        seen: dict[str, Any] = {
            key: np.tile(np.array([numbers[name] for name in some], np.float32), (rows, 1))
            for key, some in names.items()
            if some
        }
        if self.station.cameras:
            seen["pixels"] = {name: np.stack([self._seen[name]] * rows) for name in self.station.cameras}
        return seen

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """See `Streams`: pays 1 for a success and takes it back when it is lost."""
        station = self.station
        events = self._listen()
        action, diverged = np.asarray(actions, np.float32)[0], False
        before = self._success
        try:
            if events.stop:
                raise ConnectionError("Emergency stop")
            if events.takes_over:
                action = self._taken_over()
            action = station.act(action)
            self._seen = station.observe()
        except FAULTS as error:
            station.release(str(error))
            diverged = True
        self._success = not diverged and self._judge.judge(self._seen, events)
        never = np.zeros(1, np.bool_)
        info = {
            "is_success": np.array([self._success]),
            "diverged": np.array([diverged]),
            "executed_action": action[None],
            "intervened": np.array([events.takes_over]),
        }
        reward = np.array([float(self._success) - float(before)], np.float32)
        return self.observe(), reward, never, never.copy(), info

    def scene_reset(self, ids: np.ndarray, starts: np.ndarray, split: str = "train") -> None:
        """Remember the start that is wanted. The person is asked for it once something follows."""
        if len(ids):
            self._wanted = int(starts[0]), split

    def _place(self) -> None:
        """Go home, show the start that is wanted, if any, and wait until the person has built it."""
        if self._wanted is None:
            return
        (start, split), self._wanted = self._wanted, None
        station = self.station
        station.be_ready()
        shown = ""
        if self.folder is not None:
            shown = f", as in {picture_file(self.folder, station.setup, split, start)}"
        # A scripted person acts on this.
        station.person.tell(scene_reset=start, split=split)
        seconds = station.wait(f"Put the objects to start {start} of {split}{shown}, and press Enter.", is_done)
        self._note("scene_reset", seconds, start=start, split=split)
        self._success = False
        self._look()
        station.begin()

    def end_effector_reset(self, ids: np.ndarray) -> None:
        """Go home with the gripper open."""
        if len(ids):
            self.station.be_ready()
            self._look()
            self.station.begin()

    def render_streams(self, ids: np.ndarray) -> np.ndarray:
        """The first camera's picture (k, H, W, 3) uint8."""
        return np.stack([self._seen[next(iter(self.station.cameras))]] * len(ids))

    def close(self) -> None:
        """Go home and disconnect, unless an evaluation or training still uses the robot."""
        self.station.close()

    def _look(self) -> None:
        """Observe; a failure is found by the next step."""
        try:
            self._seen = self.station.observe()
        except FAULTS:
            if not self._seen:
                raise

    def _listen(self) -> Events:
        """What the person does now; a pause lasts until they end it."""
        station, events = self.station, self.station.person.look()
        for kind in ("success", "failure"):
            if getattr(events, kind):
                self._note(kind, task=self._task.instruction)
        if events.stop:
            self._note("emergency_stop")
        if events.pause:
            seconds = station.wait("Paused; p resumes.", lambda now: now.pause)
            self._note("pause", seconds)
            station.begin()
        now = station.clock.time()
        if events.takes_over and self._helping is None:
            self._helping = now
        elif not events.takes_over and self._helping is not None:
            self._note("take_over", now - self._helping, task=self._task.instruction)
            self._helping = None
        return events

    def _taken_over(self) -> np.ndarray:
        """The person's action, if their device has one; otherwise the arm waits."""
        teleop = self.station.person.teleop
        if teleop is None or list(teleop.action_features) != self.action_names:
            return self.station.target
        given = teleop.get_action()
        return np.array([given[name] for name in self.action_names], np.float32)

    def _note(self, kind: str, seconds: float = 0.0, **details: Any) -> None:
        self.station.person.note(kind, seconds, during=self.purpose, **details)
