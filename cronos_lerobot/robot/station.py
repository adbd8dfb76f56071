"""One robot with its person: connecting, moving, and what happens when it fails."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from lerobot.robots import Robot

from cronos_lerobot.robot.person import Clock, Events, Person, WallClock
from cronos_lerobot.robot.safety import Safety
from cronos_lerobot.robot.setups import Setup

FAULTS = (OSError, RuntimeError)
"""What LeRobot's robots and cameras raise when a cable is out (ConnectionError, RuntimeError) or a picture late
(TimeoutError)."""
HOME_S = 2.0
"""Of the way home [s]."""
POLL_S = 0.05
"""Between two looks at the person while the robot waits [s]."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(KeyboardInterrupt):
    """A signal ends the run. The arm is at rest."""


class Station:
    """A LeRobot robot, its person, and its clock, which training and evaluation share.

    Args:
        robot: not connected yet. One that is simulated may have a `clock` of its own.
        teleop: a teleoperator, or None.
        setup: what stands around it.
        fps: control steps a second [Hz].
        max_step: see `Safety`.
        dry_run: never move.
    """

    def __init__(
        self, robot: Robot, teleop: Any, setup: Setup, fps: int, max_step: float | None, dry_run: bool
    ) -> None:
        self.robot, self.setup, self.fps, self.dry_run = robot, setup, fps, dry_run
        self._teleop = teleop
        self.action_names = list(robot.action_features)
        seen = robot.observation_features
        self.cameras = {name: shape for name, shape in seen.items() if isinstance(shape, tuple)}
        numbers = [name for name in seen if name not in self.cameras]
        self.state_names = [name for name in numbers if name in self.action_names]
        self.other_names = [name for name in numbers if name not in self.action_names]
        if setup.action_names is not None and tuple(self.action_names) != tuple(setup.action_names):
            raise ValueError(
                f"--env.tasks is of an arm with the actions {list(setup.action_names)}, and {robot} has "
                f"{self.action_names}"
            )
        self.safety = Safety(setup, max_step)
        self.clock: Clock = getattr(robot, "clock", WallClock())
        self.target = setup.home
        """(A,) the last one that was sent."""
        self.late = 0
        """Control steps that took longer than they have."""
        self.lost: str | None = None
        """What failed, until it is mended."""
        self._next = 0.0
        self._signal: int | None = None
        self._users = self._shown = 0
        self._handlers: dict[int, Any] = {}

    def open(self) -> None:
        """Connect, once for all of its users."""
        self._users += 1
        if self._users > 1:
            return
        # Without a person the arm gets no power.
        self.person = Person(self._teleop, self.clock)
        if not self.robot.is_connected:
            self.robot.connect()
        if self._teleop is not None and not self._teleop.is_connected:
            self._teleop.connect()

    def close(self) -> None:
        """Go home, release the motors and disconnect, once nobody uses it any more."""
        self._users -= 1
        if self._users:
            return
        try:
            if self.lost is None:
                self.go_home()
            self._disconnect()
        except FAULTS as error:
            logging.warning(f"{self.robot} was not disconnected properly: {error}")
        logging.info(
            f"{self.person.summary()}; {self.late} control steps were late, {self.safety.limited} limited"
        )
        self.person.close()

    def wait(self, text: str, is_over: Callable[[Events], bool]) -> float:
        """Say what a person is to do, and wait until they have; returns how long that took [s]."""
        print(text, flush=True)
        start = self.clock.time()
        while True:
            events = self.person.look()
            if events.stop:
                self._stop()
            self._check_signals()
            if is_over(events):
                return self.clock.time() - start
            self.clock.sleep(POLL_S)

    def _check_signals(self) -> None:
        """Stop at once on Ctrl-C and its like, whoever else listens to them: the arm goes home first."""
        for number in SIGNALS:
            if (before := signal.getsignal(number)) != self._note_signal and before != signal.SIG_IGN:
                self._handlers[number] = before
                signal.signal(number, self._note_signal)
        if self._signal is not None:
            if self.lost is None:
                self.go_home()
            raise Stopped(signal.Signals(self._signal).name)

    def _note_signal(self, number: int, frame: FrameType | None) -> None:
        self._signal = number
        if callable(before := self._handlers[number]):
            before(number, frame)

    def observe(self) -> Mapping[str, Any]:
        """What the robot observes now; one of FAULTS if it cannot."""
        return self.robot.get_observation()

    def begin(self) -> None:
        """The next control step begins now, however long ago the last one was."""
        self._next = self.clock.time()

    def act(self, action: np.ndarray) -> np.ndarray:
        """Send an action (A,) as far as it is allowed, and wait for the end of the control step.

        Returns:
            What was sent (A,) float32.
        """
        self._check_signals()
        if self.lost is not None:
            # By an emergency stop while the arm waited.
            raise ConnectionError(self.lost)
        self.target = self._send(self.safety.limit(action, self.target))
        self._wait()
        if self.dry_run:
            self._show(action)
        return self.target

    def _show(self, action: np.ndarray) -> None:
        """Once a second: what was wanted, what is allowed, where the arm is."""
        self._shown += 1
        if self._shown % self.fps == 1:
            columns = zip(self.action_names, action, self.target, self._position(), strict=True)
            for name, wanted, allowed, now in columns:
                print(f"  {name}: wants {wanted:.1f}, may {allowed:.1f}, is {now:.1f}", flush=True)

    def _send(self, action: np.ndarray) -> np.ndarray:
        if self.dry_run:
            return action
        sent = self.robot.send_action(dict(zip(self.action_names, action.tolist(), strict=True)))
        return np.array([sent[name] for name in self.action_names], dtype=np.float32)

    def _wait(self) -> None:
        self._next += 1 / self.fps
        left = self._next - self.clock.time()
        if left > 0:
            self.clock.sleep(left)
        elif left < -1 / self.fps:
            # No hurry to catch up: the steps that follow take their time.
            self.late += 1
            self._next = self.clock.time()

    def go_home(self) -> None:
        """Move to the home pose in a straight line of joint positions."""
        start = self._position()
        steps = max(round(HOME_S * self.fps), self.safety.steps_for(np.abs(self.setup.home - start).max()))
        self.begin()
        for step in range(1, steps + 1):
            if self.person.look().stop:
                self._stop()
                raise ConnectionError(self.lost)
            self.target = self._send(start + (self.setup.home - start) * step / steps)
            self._wait()

    def _position(self) -> np.ndarray:
        seen = self.observe()
        return np.array([seen[name] for name in self.action_names], dtype=np.float32)

    def _stop(self) -> None:
        """The emergency stop, while no policy acts."""
        self.person.note("emergency_stop")
        self.release("Emergency stop")

    def release(self, why: str) -> None:
        """Something failed: torque off, and nothing is sent until `be_ready`."""
        self.lost = why
        logging.warning(f"THE ROBOT STOPPED: {why}")
        try:
            self.robot.bus.disable_torque()  # ty: ignore[missing-attribute]
        except (AttributeError, *FAULTS):
            logging.warning("The motors could not be released: switch the power off.")

    def be_ready(self) -> None:
        """Go home, once what failed is mended."""
        while True:
            if self.lost is not None:
                self._mend()
            try:
                self.go_home()
                return
            except FAULTS as error:
                self.release(str(error))

    def _mend(self) -> None:
        """Wait until a person has mended what failed, and connect anew."""
        why, seconds = self.lost, 0.0
        while self.lost is not None:
            self.person.tell(lost=self.lost)
            seconds += self.wait(
                f"{self.lost}. Mend it, hold the arm, and press Enter: then the motors get power.", is_done
            )
            try:
                self._disconnect()
                self.robot.connect()
                self.target = self._position()
                self.lost = None
            except FAULTS as error:
                self.lost = f"It still fails: {error}"
        self.person.note("mend", seconds, why=why)

    def _disconnect(self) -> None:
        if not self.robot.is_connected:
            return
        try:
            self.robot.disconnect()
        except FAULTS:
            # LeRobot's bus that does not answer closes only without a last word, and its robot then not at all.
            robot: Any = self.robot
            robot.bus.disconnect(disable_torque=False)
            for camera in robot.cameras.values():
                camera.disconnect()


def is_done(events: Events) -> bool:
    """Whether a person has done what they were asked for."""
    return events.done


def picture_file(folder: Path, setup: Setup, split: str, number: int) -> Path:
    """The picture of a start, written if it is not there."""
    file = folder / "starts" / f"{split}_{number:03d}.png"
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        setup.picture(split, number).save(file)
    return file
