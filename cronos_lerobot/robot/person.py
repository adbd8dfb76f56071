"""The person beside a robot: keys, a LeRobot teleoperator, and a ledger of all that they do."""

from __future__ import annotations

import json
import os
import select
import sys
import termios
import time
import tty
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.robot_utils import precise_sleep

LEDGER = "interventions.jsonl"
KEYS = {
    "s": "success",
    "f": "failure",
    " ": "takes_over",
    "p": "pause",
    "\n": "done",
    "q": "stop",
}
HELP = "keys: s success, f failure, space take over or give back, p pause or resume, Enter done, q emergency stop"


class Clock(Protocol):
    """The time that a robot lives in; a simulated one may have its own."""

    def time(self) -> float:
        """Seconds."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        ...


class WallClock:
    """That of the room."""

    time = staticmethod(time.perf_counter)
    sleep = staticmethod(precise_sleep)


@dataclass
class Events:
    """What the person does now."""

    success: bool = False
    failure: bool = False
    takes_over: bool = False
    """They move the arm; True as long as they do."""
    pause: bool = False
    """Begins or ends a pause."""
    done: bool = False
    """They have done what they were asked for."""
    stop: bool = False
    """Emergency."""


class Terminal:
    """The keys of the terminal that the program runs in, read without waiting; none without a terminal."""

    def __init__(self) -> None:
        self._before = termios.tcgetattr(sys.stdin) if sys.stdin.isatty() else None
        if self._before is not None:
            # Ctrl-C still interrupts.
            tty.setcbreak(sys.stdin)
            print(HELP, flush=True)

    @property
    def is_there(self) -> bool:
        """Whether there is a terminal."""
        return self._before is not None

    def read(self) -> str:
        """The keys pressed since the last time."""
        if self._before is None or not select.select([sys.stdin], [], [], 0)[0]:
            return ""
        # Not by Python's buffer, which select does not see.
        return os.read(sys.stdin.fileno(), 64).decode(errors="ignore")

    def close(self) -> None:
        """Give the terminal back as it was."""
        if self._before is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)


class Person:
    """Asks for what a person does, and writes it down.

    Each action is a line of `interventions.jsonl` in `folder`: its kind, when it began and how long it took [s].

    Args:
        teleop: LeRobot's, connected, or None. Its `get_teleop_events`, if it has one, may have besides LeRobot's
            events the words `scene_reset` (done), `pause` and `emergency_stop`. It is told what it says in its
            `feedback_features` that it understands: `task`, `scene_reset`, `split`, `lost`.
        clock: of the robot.
        keys: where keys are read; the terminal's by default.
    """

    def __init__(self, teleop: Any, clock: Clock, keys: Any = None) -> None:
        self.teleop, self.clock = teleop, clock
        self.folder: Path | None = None
        """Where the ledger is; None keeps none."""
        self.counts: dict[str, int] = {}
        """Actions so far by kind."""
        self.seconds: dict[str, float] = {}
        """What they took by kind [s]."""
        self._keys = Terminal() if keys is None else keys
        self._takes_over = False
        self._events = getattr(teleop, "get_teleop_events", None) or dict
        if self._events is dict and not self._keys.is_there:
            raise ValueError("nobody is beside the robot: run in a terminal, or give an --env.teleop with events")

    def look(self) -> Events:
        """What the person does now. Keys are noted here; what takes time when it is over."""
        events = Events()
        for key in self._keys.read():
            if (kind := KEYS.get(key)) == "takes_over":
                self._takes_over = not self._takes_over
            elif kind is not None:
                setattr(events, kind, True)
        said = self._events()
        events.takes_over = self._takes_over or bool(said.get(TeleopEvents.IS_INTERVENTION))
        events.success |= bool(said.get(TeleopEvents.SUCCESS))
        events.failure |= bool(said.get(TeleopEvents.FAILURE))
        events.done |= bool(said.get("scene_reset"))
        events.pause |= bool(said.get("pause"))
        events.stop |= bool(said.get("emergency_stop"))
        return events

    def tell(self, **feedback: Any) -> None:
        """Say something to a teleoperator that understands it."""
        known = {} if self.teleop is None else self.teleop.feedback_features
        if wanted := {name: value for name, value in feedback.items() if name in known}:
            self.teleop.send_feedback(wanted)

    def note(self, kind: str, seconds: float = 0.0, **details: Any) -> None:
        """Write an action down that took so long and is over now."""
        self.counts[kind] = self.counts.get(kind, 0) + 1
        self.seconds[kind] = self.seconds.get(kind, 0.0) + seconds
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        record = {"kind": kind, "seconds": round(seconds, 3), "robot_time": round(self.clock.time(), 3)}
        with (self.folder / LEDGER).open("a") as file:
            file.write(json.dumps(record | {"time": time.time()} | details) + "\n")

    def summary(self) -> str:
        """All actions in words."""
        parts = [f"{count} {kind} ({self.seconds[kind]:.0f} s)" for kind, count in sorted(self.counts.items())]
        return f"the person acted {sum(self.counts.values())} times: {', '.join(parts) or 'nothing'}"

    def close(self) -> None:
        """Let go of the keys and the teleoperator."""
        self._keys.close()
        if self.teleop is not None and self.teleop.is_connected:
            self.teleop.disconnect()
